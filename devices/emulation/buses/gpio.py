"""Wires of an emulated bus as GPIO lines, for `devices.recovery.bus_recovery`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from devices.clock import Clock
from devices.emulation.buses.i2c import EmulatedI2cAdapter
from devices.emulation.fault_timing import FaultTiming

_CLOCKS_LEFT = 6
"""Clocks until a hanging slave has sent the rest of its byte and the acknowledge."""


class EmulatedWire:
    """SCL or SDA as a GPIO line; low while driven low, or while a fault holds it."""

    def __init__(
        self, adapter: EmulatedI2cAdapter, clock: Clock, holding_fault: FaultTiming
    ) -> None:
        self._adapter = adapter
        self._clock = clock
        self._holding_fault = holding_fault
        self._low = False

    def drive(self, *, low: bool) -> None:
        """Pull the line low, or release it."""
        self._low = low

    def is_high(self) -> bool:
        """Return whether the line is high: no device pulls it low."""
        return not self._low and not self._holding_fault(self._clock.now_ns())


class EmulatedScl(EmulatedWire):
    """SCL as a GPIO line. A slave that holds SDA releases it after the rest of its byte."""

    def __init__(self, adapter: EmulatedI2cAdapter, clock: Clock) -> None:
        super().__init__(adapter, clock, adapter.line.scl_low)
        self._clocks = 0

    def drive(self, *, low: bool) -> None:
        """Pull the line low, or release it; a rising edge is a clock."""
        if self._low and not low and not self._holding_fault(self._clock.now_ns()):
            self._clocks += 1
            if self._clocks >= _CLOCKS_LEFT:
                self._adapter.line.sda_low.end_at(self._clock.now_ns())
        super().drive(low=low)


class EmulatedReset:
    """RESET of all multiplexers. It does not free a slave that holds SDA, which needs clocks."""

    def __init__(self, adapter: EmulatedI2cAdapter) -> None:
        self._adapter = adapter

    def drive(self, *, low: bool) -> None:
        """Drive RESET; low deselects all channels."""
        if low:
            self._adapter.reset_muxes()

    def is_high(self) -> bool:
        """Return True: no other device pulls the line."""
        return True


class EmulatedGpioLines:
    """GPIO lines of one emulated bus."""

    def __init__(self, adapter: EmulatedI2cAdapter, clock: Clock) -> None:
        self._adapter = adapter
        self._clock = clock

    @contextmanager
    def request_scl_sda(self) -> Iterator[tuple[EmulatedScl, EmulatedWire]]:
        """Request SCL and SDA while the block runs."""
        sda = EmulatedWire(self._adapter, self._clock, self._adapter.line.sda_low)
        yield EmulatedScl(self._adapter, self._clock), sda

    @contextmanager
    def request_reset(self) -> Iterator[EmulatedReset]:
        """Request RESET while the block runs."""
        yield EmulatedReset(self._adapter)
