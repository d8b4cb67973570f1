"""Emulated MPL115A2 at register level.

Source: MPL115A2 data sheet Rev. 10 and hardware.md 1. Undocumented behaviour is either undefined
for the driver (the pointer after a read) or a choice of modes (a read in a conversion).
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
"""Function of a conversion's sample instant in ns that returns the 10-bit words `padc`, `tadc`."""

OnConversion = Callable[[int, tuple[int, int], tuple[int, int, int, int]], None]
"""Callback for every conversion: instant of its CONVERT's STOP, its words, and the part's
coefficients. Only for judging drivers."""


@dataclass
class PartFaults:
    """Faults of one part.

    `no_answer`: no acknowledge, as with RST low; registers and conversion go on. `unplugged`: no
    supply; afterwards its registers are zero. `replaced`: unplugged, then another part in its
    place. `stale`: conversions never end. `slow`: they take 2.9 ms, still within the data sheet.
    `all_ones`: the part is lost between address and data, so that the line floats high.
    """

    no_answer: Fault = field(default_factory=Fault)
    unplugged: Fault = field(default_factory=Fault)
    replaced: Fault = field(default_factory=Fault)
    stale: Fault = field(default_factory=Fault)
    slow: Fault = field(default_factory=Fault)
    all_ones: Fault = field(default_factory=Fault)
    scene: Faults | None = None
    """All faults of the scene; while none is possible, the others are not evaluated."""


@dataclass(frozen=True)
class Silicon:
    """Fixed properties of one part."""

    coefficient_words: tuple[int, int, int, int]
    conversion_ns: int
    sense: Sense
    late_ns: int = 0
    """Delay of the sample instant after a quarter of the conversion; negative: earlier."""


@dataclass
class _Conversion:
    p_ready_ns: int
    done_ns: int
    words: tuple[int, int]


class EmulatedMpl115a2:
    """Emulated part: registers, CONVERT command, and conversions that take time.

    Registers are zero after power-up and hold the previous result until a conversion ends. The STOP
    of a CONVERT starts a conversion; a CONVERT during a conversion restarts it.
    """

    address = 0x60
    """I2C address of every part; the general call is not acknowledged (DS 2)."""

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
        """Reset: all registers but the coefficients are zero, no conversion runs."""
        self._registers = bytearray(_REGISTERS)
        self._registers[0x04:0x0C] = struct.pack(">4H", *self._silicon.coefficient_words)
        self._pointer = 0
        self._expects_register = False
        self._convert_at_stop = False
        self._conversion: _Conversion | None = None

    def start(self, reading: bool, t_ns: int) -> bool:
        """Handle the part's address; return the acknowledge, False if the part is silent."""
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
        """Apply faults since the last call; return whether the part acknowledges."""
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
        """Receive the register address, then data, which matter for CONVERT only, in any value."""
        if self._expects_register:
            self._pointer = value & 0x7F  # the top bit is "don't care" (DS 8.4)
            self._expects_register = False
        else:
            self._convert_at_stop |= self._pointer == _CONVERT
            self._pointer = (self._pointer + 1) % _REGISTERS
        return True

    def read(self, count: int) -> bytes:
        """Send bytes from the pointer on, and advance it."""
        begin = self._pointer
        self._pointer = (begin + count) % _REGISTERS
        if self._faults.all_ones.possible and self._faults.all_ones(self._t_ns):
            return b"\xff" * count
        if begin + count <= _REGISTERS:
            return bytes(self._registers[begin : begin + count])
        return bytes(self._registers[(begin + i) % _REGISTERS] for i in range(count))

    def stop(self, t_ns: int) -> None:
        """Start a conversion if the transaction contained CONVERT."""
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
        """Apply the effect of a read during a conversion: undocumented, so one of three modes."""
        conversion = self._conversion
        if conversion is None or self._mode == "stale":
            return
        if self._mode == "abort":
            self._conversion = None
        elif t_ns >= conversion.p_ready_ns:  # torn: the new pressure beside the old temperature
            self._registers[0:2] = struct.pack(">H", conversion.words[0] << 6)

    def _load(self, padc: int, tadc: int) -> None:
        self._registers[0:4] = struct.pack(">2H", padc << 6, tadc << 6)
