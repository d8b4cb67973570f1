"""Emulated I2C bus at the level of bits, and the GPIO lines on its wires.

The adapter accepts the same `i2c_msg` objects as `smbus2.SMBus.i2c_rdwr`, raises bare `OSError`
with the Raspberry Pi's errno, and refuses the same transfers as the Pi's bcm2835 adapter
(hardware.md 3.2). The wires are open-drain: an acknowledge or a data bit is low if *any* device
pulls it low. Time on the bus is counted in SCL periods as in `devices.array.schedules`: START,
repeated START and STOP one each, nine per byte.
"""

from __future__ import annotations

import ctypes
import errno
import os
import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial, reduce
from operator import and_
from typing import Protocol

from devices.buses.i2c import i2c_msg
from devices.chips.pressure_chip import Counts, Registers
from devices.clock import Clock
from devices.emulation.fault_timing import FaultTiming, SceneFaults

I2C_RDWR_IOCTL_MAX_MSGS = 42  # include/uapi/linux/i2c-dev.h
MESSAGE_BYTES_MAX = 8192  # the kernel's limit of one message
_FLAG_READ = 0x0001  # I2C_M_RD, include/uapi/linux/i2c.h
_TIMEOUT_UNIT_NS = 10_000_000  # of the ioctl I2C_TIMEOUT
_TIMEOUT_DEFAULT = 100  # the i2c core's default, 1 s
_FAILING_TRANSFERS = 3
_UDEV_NS = 300_000_000  # assumed
_NOT_ACKNOWLEDGED_BITS = 11  # START, address with direction and missing acknowledge, STOP


class I2cDevice(Protocol):
    """Chip on the bus. Times are of the clock, at the end of the respective bits."""

    @property
    def address(self) -> int:
        """7-bit address."""

    def on_address(self, reading: bool, t_ns: int) -> bool:
        """Handle the chip's address; return True to acknowledge and expect bytes."""

    def receive_byte(self, value: int) -> bool:
        """Receive one byte; return True to acknowledge."""

    def send_bytes(self, count: int) -> bytes:
        """Send `count` bytes."""

    def on_stop(self, t_ns: int) -> None:
        """Handle the STOP of an acknowledged transaction; called once for each acknowledge."""

    def interrupt_supply(self) -> None:
        """Interrupt the supply for a moment."""


OnConversion = Callable[[int, Counts, Registers], None]
"""Callback for every conversion: instant of its CONVERT's STOP, its counts, and the part's
registers. Only for judging drivers."""


class EmulatedChip(I2cDevice, Protocol):
    """Emulated pressure chip on the bus."""

    on_conversion: OnConversion | None

    @property
    def sample_delay_ns(self) -> int:
        """Delay of a sample after the instant that drivers assume."""


class MuxDevice(I2cDevice, Protocol):
    """Device that connects further segments of the bus."""

    @property
    def connected_mask(self) -> int:
        """Connected channels, one bit each."""

    def get_connected_devices(self) -> Iterable[I2cDevice]:
        """Return the devices on the connected channels."""

    def apply_faults(self, t_ns: int) -> None:
        """Apply faults since the last call."""

    def reset(self) -> None:
        """Reset as by the RESET line."""


_NO_DEVICE: Sequence[I2cDevice] = ()


class EmulatedI2cAdapter:
    """Bus of an emulated Raspberry Pi: multiplexers on the trunk, chips behind them."""

    def __init__(
        self,
        muxes: Sequence[MuxDevice],
        clock: Clock,
        scl_hz: float,
        line: FaultyWires | None = None,
    ) -> None:
        self.line = line if line is not None else FaultyWires(SceneFaults(()), "")
        self._muxes = muxes
        self._mux_addresses = frozenset(mux.address for mux in muxes)
        self._clock = clock
        self._ns_per_bit = 1e9 / scl_hz
        self._timeout_ns = _TIMEOUT_DEFAULT * _TIMEOUT_UNIT_NS
        self._is_dead = False
        self._refused = 0
        self._opened_ns = clock.now_ns()
        self._devices_by_routing: dict[tuple[int, ...], dict[int, list[I2cDevice]]] = {}
        self._present_devices = self._devices_by_address()
        self._disturbed: FaultyWires | None = None

    def set_timeout(self, units_10ms: int) -> None:
        """Set the timeout of a wedged transfer, as by the ioctl I2C_TIMEOUT, and open the adapter.

        Its device file is absent while unplugged, and belongs to root for a moment after plugging,
        until udev changes its group. The chips on its wires lose their supply with the adapter.

        Raises:
            OSError: ENOENT, EACCES.
        """
        now_ns = self._clock.now_ns()
        if self._was_unplugged(now_ns):
            unplugged = self.line.adapter_unplugged
            if unplugged(now_ns):
                raise _make_os_error(errno.ENOENT)
            if unplugged.was_active_between(now_ns - _UDEV_NS, now_ns):
                raise _make_os_error(errno.EACCES)
            for mux in self._muxes:
                mux.interrupt_supply()
            self._present_devices = self._devices_by_address()
            self._is_dead = False
        self._refused = 0
        self._opened_ns = now_ns
        self._timeout_ns = units_10ms * _TIMEOUT_UNIT_NS

    def _was_unplugged(self, now_ns: int) -> bool:
        """Return whether the adapter was unplugged since it was opened: its open file fails."""
        unplugged = self.line.adapter_unplugged
        if unplugged.is_possible and unplugged.was_active_between(self._opened_ns, now_ns):
            self._is_dead = True
        return self._is_dead

    def reset_muxes(self) -> None:
        """Pulse the RESET line of all multiplexers."""
        for mux in self._muxes:
            mux.reset()
        self._present_devices = self._devices_by_address()

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        """Run one transaction, like the ioctl I2C_RDWR on a Pi.

        Raises:
            OSError: EINVAL and EOPNOTSUPP for transfers that the kernel or the adapter refuses,
                EREMOTEIO for a missing acknowledge, ETIMEDOUT if SCL is stuck.
        """
        _check_supported(i2c_msgs)
        begin_ns = self._clock.now_ns()
        if not self.line.is_healthy and self._was_unplugged(begin_ns):
            # First the USB transfers in flight fail, then the device is gone.
            self._refused += 1
            raise _make_os_error(errno.EIO if self._refused <= _FAILING_TRANSFERS else errno.ENODEV)
        self.begin_transaction()
        if self._disturbed is not None and self._run_on_stuck_wires(i2c_msgs, begin_ns):
            return
        try:
            for message in i2c_msgs:
                self.run_message(message)
        finally:
            self.stop_transaction()

    def begin_transaction(self) -> None:
        """Begin a transaction of messages that are known one by one, as a USB adapter gets them."""
        self._begin_ns = self._clock.now_ns()
        self._bits = 0
        self._addressed: list[I2cDevice] = []
        self._disturbed = None if self.line.is_healthy else self.line
        self._is_routed = self._disturbed is not None
        if self._is_routed:
            for mux in self._muxes:
                mux.apply_faults(self._begin_ns)
            self._present_devices = self._devices_by_address()

    def run_message(self, message: i2c_msg) -> None:
        """Run a START, or a repeated one, and the bytes of a message.

        Raises:
            OSError: EREMOTEIO for a missing acknowledge.
        """
        self._bits += 10  # START or repeated START, address with direction, acknowledge
        address, length, disturbed = message.addr, message.len, self._disturbed
        reading = bool(message.flags & _FLAG_READ)
        t_ns = self._begin_ns + round(self._bits * self._ns_per_bit)
        listeners = self._present_devices.get(address, _NO_DEVICE)
        if disturbed is not None:
            listeners = self._find_addressed(address, reading, t_ns, disturbed)
        if len(listeners) == 1:
            if not listeners[0].on_address(reading, t_ns):
                listeners = _NO_DEVICE
        else:
            listeners = [device for device in listeners if device.on_address(reading, t_ns)]
        self._addressed += listeners
        if address in self._mux_addresses:
            self._is_routed = True
        if not listeners or (disturbed is not None and disturbed.draw_lost_acknowledge(t_ns)):
            raise _make_os_error(errno.EREMOTEIO)
        if reading:
            self._bits += 9 * length
            _read(message, listeners, t_ns, disturbed)
            return
        acknowledged = _write(message, listeners, t_ns, disturbed)
        self._bits += 9 * length
        if acknowledged < length:
            self._bits -= 9 * (length - acknowledged - 1)
            raise _make_os_error(errno.EREMOTEIO)

    def stop_transaction(self) -> None:
        """Run the STOP, and wait until all bits have passed."""
        stop_ns = self._begin_ns + round((self._bits + 1) * self._ns_per_bit)
        for device in self._addressed:
            device.on_stop(stop_ns)
        # Routing changes only at STOP, and only if a mux was addressed.
        if self._is_routed:
            self._present_devices = self._devices_by_address()
        self._clock.sleep_until_ns(stop_ns)

    def _find_addressed(
        self, address: int, reading: bool, t_ns: int, disturbed: FaultyWires
    ) -> Sequence[I2cDevice]:
        """Return the devices whose address matches the address byte, which may be disturbed."""
        received = disturbed.add_bit_error(address << 1 | reading, t_ns)
        if received & 1 != reading:
            return _NO_DEVICE  # both sides would read, or both write
        return self._present_devices.get(received >> 1, _NO_DEVICE)

    def _run_on_stuck_wires(self, messages: Sequence[i2c_msg], begin_ns: int) -> bool:
        """Run a transaction on stuck wires; return True if it looks like success."""
        if self.line.is_wedged(begin_ns):
            self._clock.sleep_until_ns(begin_ns + self._timeout_ns)
            raise _make_os_error(errno.ETIMEDOUT)
        if self.line.sda_high(begin_ns):
            self._wait_bits(begin_ns, _NOT_ACKNOWLEDGED_BITS)
            raise _make_os_error(errno.EREMOTEIO)
        if self.line.sda_low(begin_ns):
            for message in messages:
                if message.flags & _FLAG_READ:
                    ctypes.memset(message.buf, 0, message.len)
            self._wait_bits(begin_ns, sum(10 + 9 * message.len for message in messages) + 1)
            return True
        return False

    def _wait_bits(self, begin_ns: int, bits: int) -> None:
        self._clock.sleep_until_ns(begin_ns + round(bits * self._ns_per_bit))

    def close(self) -> None:
        """Close the adapter; it has no resources."""

    def _devices_by_address(self) -> dict[int, list[I2cDevice]]:
        routing = tuple([mux.connected_mask for mux in self._muxes])
        if routing in self._devices_by_routing:
            return self._devices_by_routing[routing]
        wire = self._devices_by_routing[routing] = {}
        for mux in self._muxes:
            for device in (mux, *mux.get_connected_devices()):
                wire.setdefault(device.address, []).append(device)
        return wire


def _make_os_error(number: int) -> OSError:
    return OSError(number, os.strerror(number))


def _check_supported(messages: Sequence[i2c_msg]) -> None:
    last = len(messages) - 1
    if not 0 <= last < I2C_RDWR_IOCTL_MAX_MSGS:
        raise _make_os_error(errno.EINVAL)
    for index, message in enumerate(messages):
        if message.len > MESSAGE_BYTES_MAX:
            raise _make_os_error(errno.EINVAL)
        # drivers/i2c/busses/i2c-bcm2835.c: "only one read message supported, has to be last"
        if index < last and message.flags & _FLAG_READ:
            raise _make_os_error(errno.EOPNOTSUPP)


def _write(
    message: i2c_msg, listeners: Sequence[I2cDevice], t_ns: int, disturbed: FaultyWires | None
) -> int:
    """Send a message's bytes to the addressed devices; return the number of acknowledged bytes."""
    sent = ctypes.string_at(message.buf, message.len)
    if disturbed is None and len(listeners) == 1:
        write = listeners[0].receive_byte
        for count, value in enumerate(sent, start=1):
            if not write(value):
                return count - 1
        return len(sent)
    for count, value in enumerate(sent, start=1):
        received = value if disturbed is None else disturbed.add_bit_error(value, t_ns)
        acknowledged = True in [device.receive_byte(received) for device in listeners]
        if not acknowledged or (disturbed is not None and disturbed.draw_lost_acknowledge(t_ns)):
            return count - 1
    return len(sent)


def _read(
    message: i2c_msg, listeners: Sequence[I2cDevice], t_ns: int, disturbed: FaultyWires | None
) -> None:
    if len(listeners) == 1:
        values = listeners[0].send_bytes(message.len)
    else:  # open drain: a bit is low if any device pulls it low
        each = [device.send_bytes(message.len) for device in listeners]
        values = bytes(map(partial(reduce, and_), zip(*each, strict=True)))
    if disturbed is not None:
        values = bytes([disturbed.add_bit_error(value, t_ns) for value in values])
    ctypes.memmove(message.buf, values, message.len)


_ADDRESS_BITS = 8


class FaultyWires:
    """SDA and SCL with their `faults`; `label` seeds random faults."""

    def __init__(self, faults: SceneFaults, label: str) -> None:
        self.sda_low = faults.get_fault("sda_low")
        self.sda_high = faults.get_fault("sda_high")
        self.scl_low = faults.get_fault("scl_low")
        self.adapter_unplugged = faults.get_fault("adapter_unplugged")
        self.adapter_timeout = faults.get_fault("adapter_timeout")
        self._nack_storm = faults.get_fault("nack_storm")
        self._bit_errors = faults.get_fault("bit_errors")
        self._faults = faults
        # Not numpy's: a draw for every byte has to be cheap. A text seeds it the same way on every
        # machine.
        self._rng = random.Random(label)  # noqa: S311  # no secret

    @property
    def is_healthy(self) -> bool:
        """True if no fault of the scene is possible, now or later."""
        return not self._faults.is_any_possible

    def is_wedged(self, t_ns: int) -> bool:
        """Return whether a transfer that begins now ends in the adapter's timeout."""
        if self.scl_low(t_ns):
            return True
        return self._draw_fault(self.adapter_timeout, t_ns)

    def draw_lost_acknowledge(self, t_ns: int) -> bool:
        """Draw whether an acknowledge is lost."""
        return self._draw_fault(self._nack_storm, t_ns)

    def add_bit_error(self, value: int, t_ns: int) -> int:
        """Return the received byte: sometimes with one flipped bit."""
        if self._draw_fault(self._bit_errors, t_ns):
            return value ^ 1 << self._rng.randrange(_ADDRESS_BITS)
        return value

    def _draw_fault(self, fault: FaultTiming, t_ns: int) -> bool:
        rate = fault.get_rate(t_ns)
        return rate > 0.0 and self._rng.random() < rate


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
