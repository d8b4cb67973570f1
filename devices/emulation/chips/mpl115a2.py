"""Emulated MPL115A2 at register level.

Source: MPL115A2 data sheet Rev. 10 and hardware.md 1. Undocumented behaviour is either undefined
for the driver (the pointer after a read) or a choice of modes (a read in a conversion).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from devices.emulation.fault_timing import FaultTiming, SceneFaults
from devices.scene.emulation_sections import ReadDuringConversion

_CONVERT = 0x12
_REGISTERS = 0x80
_SAMPLE_QUARTER = 4  # as the driver assumes (hardware.md 1.4)
_SLOW_NS = 2_900_000  # slower than any healthy part, within the data sheet's 3 ms

SampleFunction = Callable[[int], tuple[int, int]]
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

    no_answer: FaultTiming = field(default_factory=FaultTiming)
    unplugged: FaultTiming = field(default_factory=FaultTiming)
    replaced: FaultTiming = field(default_factory=FaultTiming)
    stale: FaultTiming = field(default_factory=FaultTiming)
    slow: FaultTiming = field(default_factory=FaultTiming)
    all_ones: FaultTiming = field(default_factory=FaultTiming)
    scene: SceneFaults | None = None
    """All faults of the scene; while none is possible, the others are not evaluated."""


@dataclass(frozen=True)
class EmulatedPart:
    """Fixed properties of one part."""

    coefficient_words: tuple[int, int, int, int]
    conversion_ns: int
    sample_counts: SampleFunction
    sample_delay_ns: int = 0
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
        silicon: EmulatedPart,
        read_during_conversion: ReadDuringConversion = "stale",
        faults: PartFaults | None = None,
        make_replacement: Callable[[], EmulatedPart] | None = None,
    ) -> None:
        self.on_conversion: OnConversion | None = None
        self._silicon = silicon
        self._mode = read_during_conversion
        self._faults = faults if faults is not None else PartFaults()
        self._make_replacement = make_replacement
        self._scene_faults = self._faults.scene
        self._seen_ns = 0
        self._t_ns = 0
        self.interrupt_supply()

    def interrupt_supply(self) -> None:
        """Reset: all registers but the coefficients are zero, no conversion runs."""
        self._registers = bytearray(_REGISTERS)
        self._registers[0x04:0x0C] = struct.pack(">4H", *self._silicon.coefficient_words)
        self._pointer = 0
        self._expects_register = False
        self._convert_at_stop = False
        self._conversion: _Conversion | None = None

    def on_address(self, reading: bool, t_ns: int) -> bool:
        """Handle the part's address; return the acknowledge, False if the part is silent."""
        if (
            self._scene_faults is None or self._scene_faults.is_any_possible
        ) and not self._apply_faults(t_ns):
            return False
        self._t_ns = t_ns
        if self._conversion is not None:
            self._finish_conversion(t_ns)
            if reading:
                self._apply_early_read(t_ns)
        self._expects_register = not reading
        return True

    def _apply_faults(self, t_ns: int) -> bool:
        """Apply faults since the last call; return whether the part acknowledges."""
        since_ns, self._seen_ns = self._seen_ns, t_ns
        faults = self._faults
        if faults.replaced.is_possible and faults.replaced.was_active_between(since_ns, t_ns):
            if self._make_replacement is not None:
                self._silicon, self._make_replacement = self._make_replacement(), None
            self.interrupt_supply()
        if faults.unplugged.is_possible and faults.unplugged.was_active_between(since_ns, t_ns):
            self.interrupt_supply()
        return not (faults.no_answer(t_ns) or faults.unplugged(t_ns) or faults.replaced(t_ns))

    def receive_byte(self, value: int) -> bool:
        """Receive the register address, then data, which matter for CONVERT only, in any value."""
        if self._expects_register:
            self._pointer = value & 0x7F  # the top bit is "don't care" (DS 8.4)
            self._expects_register = False
        else:
            self._convert_at_stop |= self._pointer == _CONVERT
            self._pointer = (self._pointer + 1) % _REGISTERS
        return True

    def send_bytes(self, count: int) -> bytes:
        """Send bytes from the pointer on, and advance it."""
        begin = self._pointer
        self._pointer = (begin + count) % _REGISTERS
        if self._faults.all_ones.is_possible and self._faults.all_ones(self._t_ns):
            return b"\xff" * count
        if begin + count <= _REGISTERS:
            return bytes(self._registers[begin : begin + count])
        return bytes(self._registers[(begin + i) % _REGISTERS] for i in range(count))

    def on_stop(self, t_ns: int) -> None:
        """Start a conversion if the transaction contained CONVERT."""
        if self._convert_at_stop:
            self._convert_at_stop = False
            self._finish_conversion(t_ns)
            self._conversion = None
            silicon = self._silicon
            after_ns = silicon.conversion_ns // _SAMPLE_QUARTER + silicon.sample_delay_ns
            words = silicon.sample_counts(t_ns + after_ns)
            if self.on_conversion is not None:
                self.on_conversion(t_ns, words, self._silicon.coefficient_words)
            if not self._faults.stale(t_ns):
                slow = self._faults.slow(t_ns)
                tc = _SLOW_NS if slow else self._silicon.conversion_ns
                self._conversion = _Conversion(
                    p_ready_ns=t_ns + tc // 2, done_ns=t_ns + tc, words=words
                )

    def _finish_conversion(self, t_ns: int) -> None:
        conversion = self._conversion
        if conversion is not None and t_ns >= conversion.done_ns:
            self._load_result(*conversion.words)
            self._conversion = None

    def _apply_early_read(self, t_ns: int) -> None:
        """Apply the effect of a read during a conversion: undocumented, so one of three modes."""
        conversion = self._conversion
        if conversion is None or self._mode == "stale":
            return
        if self._mode == "abort":
            self._conversion = None
        elif t_ns >= conversion.p_ready_ns:  # torn: the new pressure beside the old temperature
            self._registers[0:2] = struct.pack(">H", conversion.words[0] << 6)

    def _load_result(self, padc: int, tadc: int) -> None:
        self._registers[0:4] = struct.pack(">2H", padc << 6, tadc << 6)
