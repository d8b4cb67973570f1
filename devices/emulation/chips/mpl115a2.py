"""MPL115A2 at register level: what the two wires show of one part.

Source: MPL115A2 data sheet Rev. 10 and hardware.md 1. What is not documented there is either left
undefined to the driver (the pointer after a read) or offered as a mode (a read in a conversion).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from devices.emulation.faults import Fault, Faults
from devices.scene.emulated import ReadDuringConversion

_CONVERT = 0x12
_REGISTERS = 0x80
_SAMPLE_QUARTER = 4  # as the driver assumes (hardware.md 1.4)
_SLOW_NS = 2_900_000  # slower than any healthy part, within the data sheet's 3 ms

Sense = Callable[[int], tuple[int, int]]
"""Sample instant in ns -> the 10-bit words `padc`, `tadc` of a conversion that samples then."""

OnConversion = Callable[[int, tuple[int, int], tuple[int, int, int, int]], None]
"""Told of every conversion: the instant of its CONVERT's STOP, its words, and the coefficients of
the part that made it. Only to judge a driver by; no driver has it."""


@dataclass
class PartFaults:
    """What may be wrong with one part.

    `no_answer`: it does not acknowledge, as with RST low; its registers and conversion go on.
    `unplugged`: it has no supply; plugged in again its registers are zero. `replaced`: the same,
    and what is plugged in again is another part. `stale`: a conversion never ends. `slow`: it takes
    2.9 ms, still within the data sheet. `all_ones`: it is lost between address and data, so that
    the line floats high.
    """

    no_answer: Fault = field(default_factory=Fault)
    unplugged: Fault = field(default_factory=Fault)
    replaced: Fault = field(default_factory=Fault)
    stale: Fault = field(default_factory=Fault)
    slow: Fault = field(default_factory=Fault)
    all_ones: Fault = field(default_factory=Fault)
    scene: Faults | None = None
    """All faults of the scene; while none of them is possible, none of these is asked."""


@dataclass(frozen=True)
class Silicon:
    """What is soldered in: fixed for one part."""

    coefficient_words: tuple[int, int, int, int]
    conversion_ns: int
    sense: Sense
    late_ns: int = 0
    """How much later than after a quarter of a conversion it samples, below zero earlier."""


@dataclass
class _Conversion:
    p_ready_ns: int
    done_ns: int
    words: tuple[int, int]


class EmulatedMpl115a2:
    """One part: sixteen bytes of registers, a command, and a conversion that takes its time.

    Registers are zero after power-up and keep the previous result until a conversion ends, a
    conversion being started by the STOP of a CONVERT. A CONVERT during a conversion restarts it.
    """

    address = 0x60
    """The same for every part; the general call is not acknowledged (DS 2)."""

    def __init__(
        self,
        silicon: Silicon,
        read_during_conversion: ReadDuringConversion = "stale",
        faults: PartFaults | None = None,
        spare: Callable[[], Silicon] | None = None,
    ) -> None:
        self.on_conversion: OnConversion | None = None
        self._silicon = silicon
        self._mode = read_during_conversion
        self._faults = faults if faults is not None else PartFaults()
        self._spare = spare
        self._scene_faults = self._faults.scene
        self._seen_ns = 0
        self._t_ns = 0
        self.lose_supply()

    def lose_supply(self) -> None:
        """Begin anew: all registers but the coefficients are zero, nothing converts."""
        self._registers = bytearray(_REGISTERS)
        self._registers[0x04:0x0C] = struct.pack(">4H", *self._silicon.coefficient_words)
        self._pointer = 0
        self._expects_register = False
        self._convert_at_stop = False
        self._conversion: _Conversion | None = None

    def start(self, reading: bool, t_ns: int) -> bool:
        """Acknowledge, unless the part is silent."""
        if (self._scene_faults is None or self._scene_faults.possible) and not self._lives(t_ns):
            return False
        self._t_ns = t_ns
        if self._conversion is not None:
            self._settle(t_ns)
            if reading:
                self._disturb(t_ns)
        self._expects_register = not reading
        return True

    def _lives(self, t_ns: int) -> bool:
        """Does it acknowledge? What happened to it since it was last called is applied first."""
        since_ns, self._seen_ns = self._seen_ns, t_ns
        faults = self._faults
        if faults.replaced.possible and faults.replaced.struck(since_ns, t_ns):
            if self._spare is not None:
                self._silicon, self._spare = self._spare(), None
            self.lose_supply()
        if faults.unplugged.possible and faults.unplugged.struck(since_ns, t_ns):
            self.lose_supply()
        return not (faults.no_answer(t_ns) or faults.unplugged(t_ns) or faults.replaced(t_ns))

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
        if self._faults.all_ones.possible and self._faults.all_ones(self._t_ns):
            return b"\xff" * count
        if begin + count <= _REGISTERS:
            return bytes(self._registers[begin : begin + count])
        return bytes(self._registers[(begin + i) % _REGISTERS] for i in range(count))

    def stop(self, t_ns: int) -> None:
        """Start the conversion that the transaction asked for."""
        if self._convert_at_stop:
            self._convert_at_stop = False
            self._settle(t_ns)
            self._conversion = None
            silicon = self._silicon
            after_ns = silicon.conversion_ns // _SAMPLE_QUARTER + silicon.late_ns
            words = silicon.sense(t_ns + after_ns)
            if self.on_conversion is not None:
                self.on_conversion(t_ns, words, self._silicon.coefficient_words)
            if not self._faults.stale(t_ns):
                slow = self._faults.slow(t_ns)
                tc = _SLOW_NS if slow else self._silicon.conversion_ns
                self._conversion = _Conversion(
                    p_ready_ns=t_ns + tc // 2, done_ns=t_ns + tc, words=words
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
