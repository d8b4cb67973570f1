"""An emulated servo that can be made to fail. Each fault lasts as long as its context."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

from devices.chips.dynamixel.protocol import ErrorFlag, Packet
from devices.clock import Clock
from devices.emulation.chips.dynamixel import EmulatedServo

HARDWARE_ERROR = 70
"""Address in the control table of Protocol 2.0."""


class FaultyServo(EmulatedServo):
    """Faults may be set from any thread."""

    def __init__(self, position: Callable[[int], int], clock: Clock, **options: Any) -> None:
        self._is_silent = self._corrupts = False
        self._garbage = b""
        self._late_s = 0.0
        super().__init__(position, clock, **options)

    def write_table(self, address: int, data: bytes) -> None:
        """Set registers, as with the maker's own tool."""
        self._firmware.control_table[address : address + len(data)] = data

    def silent(self) -> contextlib.AbstractContextManager[None]:
        """Answer nothing, as without power or with the plug pulled; but its state survives."""
        return self._with("_is_silent", True)

    def garbage_before_reply(self, garbage: bytes) -> contextlib.AbstractContextManager[None]:
        """Send `garbage` before every answer. Unrealistic: it is always the same."""
        return self._with("_garbage", garbage)

    def late(self, late_s: float) -> contextlib.AbstractContextManager[None]:
        """Answer so much later, as if the machine that asks had been busy elsewhere."""
        return self._with("_late_s", late_s)

    def corrupt_crc(self) -> contextlib.AbstractContextManager[None]:
        """Invert the last byte of every answer, which is of its CRC or checksum.

        Unrealistic: a bad line hits any bit, now and then.
        """
        return self._with("_corrupts", True)

    @contextlib.contextmanager
    def alert(self) -> Iterator[None]:
        """Report an input voltage error. Unrealistic at its end: silicon keeps it until reboot."""
        self._complain(True)
        try:
            yield
        finally:
            self._complain(False)

    def _complain(self, of_voltage: bool) -> None:
        if self._firmware.version == 1:
            self._firmware.error_bits = ErrorFlag.VOLTAGE if of_voltage else ErrorFlag(0)
        else:
            self._firmware.control_table[HARDWARE_ERROR] = int(of_voltage)

    @contextlib.contextmanager
    def _with(self, name: str, value: object) -> Iterator[None]:
        before = getattr(self, name)
        setattr(self, name, value)
        try:
            yield
        finally:
            setattr(self, name, before)

    def _answer(self, packet: Packet, received_ns: int) -> None:
        if not self._is_silent:
            super()._answer(packet, received_ns)

    def _reply(self, packet: Packet, t_ns: int) -> bytes:
        time.sleep(self._late_s)
        reply = super()._reply(packet, t_ns)
        if self._corrupts:
            reply = reply[:-1] + bytes([reply[-1] ^ 0xFF])
        return self._garbage + reply
