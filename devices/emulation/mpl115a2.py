"""MPL115A2 at register level: what the two wires show of one part.

Source: MPL115A2 data sheet Rev. 10 and hardware.md 1. What is not documented there is either left
undefined to the driver (the pointer after a read) or offered as a mode (a read in a conversion).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from devices.scene import ReadDuringConversion

_CONVERT = 0x12
_REGISTERS = 0x80
_SAMPLE_QUARTER = 4

Sense = Callable[[int], tuple[int, int]]
"""Sample instant in ns -> the 10-bit words `padc`, `tadc` of a conversion that samples then."""


def _never(t_ns: int) -> bool:
    return False


@dataclass
class _Conversion:
    p_ready_ns: int
    done_ns: int
    words: tuple[int, int]


class EmulatedMpl115a2:
    """One part: sixteen bytes of registers, a command, and a conversion that takes its time.

    Registers are zero after power-up and keep the previous result until a conversion ends, a
    conversion being started by the STOP of a CONVERT. A CONVERT during a conversion starts it anew.
    """

    address = 0x60
    """The same for every part; the general call is not acknowledged (DS 2)."""

    def __init__(
        self,
        coefficient_words: tuple[int, int, int, int],
        conversion_ns: int,
        sense: Sense,
        read_during_conversion: ReadDuringConversion = "stale",
    ) -> None:
        self._registers = bytearray(_REGISTERS)
        self._registers[0x04:0x0C] = struct.pack(">4H", *coefficient_words)
        self._conversion_ns = conversion_ns
        self._sense = sense
        self._mode = read_during_conversion
        self._pointer = 0
        self._expects_register = False
        self._convert_at_stop = False
        self._conversion: _Conversion | None = None
        self.silent: Callable[[int], bool] = _never
        """Fault hook: does the part fail to acknowledge at this time?"""
        self.frozen: Callable[[int], bool] = _never
        """Fault hook: does a conversion started at this time never end?"""

    def start(self, reading: bool, t_ns: int) -> bool:
        """Acknowledge, unless the part is silent."""
        if self.silent(t_ns):
            return False
        self._settle(t_ns)
        if reading:
            self._disturb(t_ns)
        self._expects_register = not reading
        return True

    def write(self, value: int) -> bool:
        """Take the register address, then data; only CONVERT heeds its data, whatever it is."""
        if self._expects_register:
            self._pointer = value & 0x7F  # the top bit is "don't care" (DS 8.4)
            self._expects_register = False
        else:
            self._convert_at_stop |= self._pointer == _CONVERT
            self._pointer = (self._pointer + 1) % _REGISTERS
        return True

    def read(self, count: int) -> bytes:
        """Give the bytes from the pointer on, which moves with them."""
        begin = self._pointer
        self._pointer = (begin + count) % _REGISTERS
        if begin + count <= _REGISTERS:
            return bytes(self._registers[begin : begin + count])
        return bytes(self._registers[(begin + i) % _REGISTERS] for i in range(count))

    def stop(self, t_ns: int) -> None:
        """Start the conversion that the transaction asked for."""
        if self._convert_at_stop:
            self._convert_at_stop = False
            self._settle(t_ns)
            self._conversion = None
            if not self.frozen(t_ns):
                tc = self._conversion_ns
                self._conversion = _Conversion(
                    p_ready_ns=t_ns + tc // 2,
                    done_ns=t_ns + tc,
                    words=self._sense(t_ns + tc // _SAMPLE_QUARTER),
                )

    def _settle(self, t_ns: int) -> None:
        conversion = self._conversion
        if conversion is not None and t_ns >= conversion.done_ns:
            self._load(*conversion.words)
            self._conversion = None

    def _disturb(self, t_ns: int) -> None:
        """A read while converting: undocumented, so three behaviours are on offer."""
        conversion = self._conversion
        if conversion is None or self._mode == "stale":
            return
        if self._mode == "abort":
            self._conversion = None
        elif t_ns >= conversion.p_ready_ns:  # torn: the new pressure beside the old temperature
            self._registers[0:2] = struct.pack(">H", conversion.words[0] << 6)

    def _load(self, padc: int, tadc: int) -> None:
        self._registers[0:4] = struct.pack(">2H", padc << 6, tadc << 6)
