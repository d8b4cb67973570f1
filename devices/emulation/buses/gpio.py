"""The wires of an emulated bus as GPIO lines: what `devices.recovery.recovery` moves by hand."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from devices.clock import Clock
from devices.emulation.buses.i2c import EmulatedI2cAdapter
from devices.emulation.faults import Fault

_CLOCKS_LEFT = 6
"""Bits of its byte, and the acknowledge, that a hanging slave still has to send."""


class EmulatedWire:
    """SCL or SDA by hand; low while we pull it, or while the fault that holds it is there."""

    def __init__(self, adapter: EmulatedI2cAdapter, clock: Clock, held: Fault) -> None:
        self._adapter = adapter
        self._clock = clock
        self._held = held
        self._low = False

    def drive(self, *, low: bool) -> None:
        """Pull low, or let go."""
        self._low = low

    def high(self) -> bool:
        """Is it high, that is, does no device pull it low?"""
        return not self._low and not self._held(self._clock.now_ns())


class EmulatedScl(EmulatedWire):
    """SCL by hand. A slave that holds SDA lets go after the clocks that its byte still needs."""

    def __init__(self, adapter: EmulatedI2cAdapter, clock: Clock) -> None:
        super().__init__(adapter, clock, adapter.line.scl_low)
        self._clocks = 0

    def drive(self, *, low: bool) -> None:
        """Pull low, or let go; a rising edge is a clock."""
        if self._low and not low and not self._held(self._clock.now_ns()):
            self._clocks += 1
            if self._clocks >= _CLOCKS_LEFT:
                self._adapter.line.sda_low.clear(self._clock.now_ns())
        super().drive(low=low)


class EmulatedReset:
    """RESET of all multiplexers. A slave that holds SDA needs clocks: it is not freed for good."""

    def __init__(self, adapter: EmulatedI2cAdapter) -> None:
        self._adapter = adapter

    def drive(self, *, low: bool) -> None:
        """Low deselects all channels."""
        if low:
            self._adapter.reset_muxes()

    def high(self) -> bool:
        """Nothing else pulls it."""
        return True


class EmulatedLines:
    """All lines of one emulated bus."""

    def __init__(self, adapter: EmulatedI2cAdapter, clock: Clock) -> None:
        self._adapter = adapter
        self._clock = clock

    @contextmanager
    def bus(self) -> Iterator[tuple[EmulatedScl, EmulatedWire]]:
        """SCL and SDA while the block runs."""
        sda = EmulatedWire(self._adapter, self._clock, self._adapter.line.sda_low)
        yield EmulatedScl(self._adapter, self._clock), sda

    @contextmanager
    def reset(self) -> Iterator[EmulatedReset]:
        """RESET while the block runs."""
        yield EmulatedReset(self._adapter)
