"""An I2C adapter and its wires, at the level of bits: what a driver sees of emulated silicon.

The adapter takes the very `i2c_msg` objects that `smbus2.SMBus.i2c_rdwr` takes, raises bare
`OSError` with the Raspberry Pi's errno, and refuses what the Pi's bcm2835 adapter refuses
(hardware.md 3.2). The wires are open-drain: an acknowledge is low if *anybody* pulls it low, a data
bit is low if *anybody* pulls it low. Time on the bus is counted in SCL periods as bus_budget.py
does: START, repeated START and STOP one each, nine per byte.
"""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Iterable, Sequence
from functools import partial, reduce
from operator import and_
from typing import Protocol

from devices.clock import Clock
from devices.i2c import i2c_msg

I2C_RDWR_IOCTL_MAX_MSGS = 42
MESSAGE_BYTES_MAX = 8192
_FLAG_READ = 0x0001


class I2cDevice(Protocol):
    """A chip on the wires. Times are the clock's, at the end of the bits in question."""

    @property
    def address(self) -> int:
        """Its 7-bit address."""

    def start(self, reading: bool, t_ns: int) -> bool:
        """Its address was called: True to acknowledge and expect bytes."""

    def write(self, value: int) -> bool:
        """Take one byte; True to acknowledge."""

    def read(self, count: int) -> bytes:
        """Give `count` bytes."""

    def stop(self, t_ns: int) -> None:
        """STOP of a transaction in which it acknowledged, told once for each time it did."""


class MuxDevice(I2cDevice, Protocol):
    """A device that connects further segments of wire."""

    @property
    def mask(self) -> int:
        """Channels that are in force now, one bit each."""

    def connected(self) -> Iterable[I2cDevice]:
        """Devices on the channels that are in force now."""


class EmulatedI2cAdapter:
    """The bus of an emulated Raspberry Pi: multiplexers on the trunk, chips behind them."""

    def __init__(self, muxes: Sequence[MuxDevice], clock: Clock, scl_hz: float) -> None:
        self._muxes = muxes
        self._clock = clock
        self._ns_per_bit = 1e9 / scl_hz
        self._wires: dict[tuple[int, ...], dict[int, list[I2cDevice]]] = {}
        self._wire = self._devices_by_address()

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        """One transaction, as the ioctl I2C_RDWR on a Pi would carry it out.

        Raises:
            OSError: EINVAL and EOPNOTSUPP for what the kernel or the adapter refuses before it
                touches the bus, EREMOTEIO for a missing acknowledge.
        """
        _refuse_unsupported(i2c_msgs)
        begin_ns = self._clock.now_ns()
        addressed: list[I2cDevice] = []
        bits = 0
        try:
            for message in i2c_msgs:
                bits += 10  # START or repeated START, address with direction, acknowledge
                reading = bool(message.flags & _FLAG_READ)
                t_ns = begin_ns + round(bits * self._ns_per_bit)
                called = self._wire.get(message.addr, ())
                listeners = [device for device in called if device.start(reading, t_ns)]
                if not listeners:
                    raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
                addressed += listeners
                if reading:
                    bits += 9 * message.len
                    _read(message, listeners)
                else:
                    for value in bytes(message):
                        bits += 9
                        acknowledges = [device.write(value) for device in listeners]
                        if True not in acknowledges:
                            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        finally:
            stop_ns = begin_ns + round((bits + 1) * self._ns_per_bit)
            for device in addressed:
                device.stop(stop_ns)
            # Routing changes at STOP and at no other time.
            self._wire = self._devices_by_address()
            self._clock.sleep_until_ns(stop_ns)

    def close(self) -> None:
        """Nothing to release."""

    def _devices_by_address(self) -> dict[int, list[I2cDevice]]:
        routing = tuple([mux.mask for mux in self._muxes])
        if routing in self._wires:
            return self._wires[routing]
        wire = self._wires[routing] = {}
        for mux in self._muxes:
            for device in (mux, *mux.connected()):
                wire.setdefault(device.address, []).append(device)
        return wire


def _refuse_unsupported(messages: Sequence[i2c_msg]) -> None:
    if not 1 <= len(messages) <= I2C_RDWR_IOCTL_MAX_MSGS:
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
    for index, message in enumerate(messages, start=1):
        if message.len > MESSAGE_BYTES_MAX:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        # drivers/i2c/busses/i2c-bcm2835.c: "only one read message supported, has to be last"
        if message.flags & _FLAG_READ and index < len(messages):
            raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))


def _read(message: i2c_msg, listeners: list[I2cDevice]) -> None:
    given = [device.read(message.len) for device in listeners]
    # Open drain: a bit is low if anybody pulls it low.
    values = (
        given[0] if len(given) == 1 else bytes(map(partial(reduce, and_), zip(*given, strict=True)))
    )
    ctypes.memmove(message.buf, values, message.len)
