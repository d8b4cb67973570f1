"""Emulated MPL115A2 at register level.

Source: MPL115A2 data sheet Rev. 10 and hardware.md 1. Undocumented behaviour is either undefined
for the driver (the pointer after a read) or a choice of modes (a read in a conversion).

Noise as in a real part (hardware.md 1.3): 0.165 kPa in all, rounding included, with 1.2 % of
readings more than 0.5 kPa off, mostly low. Counts past either end wrap, as in real parts.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from devices.chips.mpl115a2 import PRESSURE_MAX_KPA, PRESSURE_MIN_KPA
from devices.emulation.fault_timing import FaultTiming, SceneFaults
from devices.emulation.parts import ChipProperties, DomeProperties, make_rng
from devices.emulation.surroundings import Puncture, Surroundings
from devices.scene.emulation_sections import EmulationSection, ReadDuringConversion

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


_KPA_PER_PCOMP = (PRESSURE_MAX_KPA - PRESSURE_MIN_KPA) / 1023
_TADC_PER_KELVIN = -5.35
_TADC_NOISE = 0.5  # in counts

_MEASURED_NOISE_KPA = 0.165
_OUTLIER_RATE = 0.012
_OUTLIER_KPA = (0.5, 1.2)  # range of their size, at the measured noise
_OUTLIERS_LOW = 0.85  # most are low (hardware.md 1.3)
_DRAWN_AT_ONCE = 1024  # a call of numpy for each reading would be slow
_FAR_OVER_RANGE_KPA = 45.0


class FrontEnd:
    """Sampler of one dome, or of the surroundings of a bare chip: called by the emulated chip.

    Before `begin` the dome is at the scene's first instant. Fault `over_range`: pressure is 45 kPa
    higher, past the range; most parts wrap. `frozen`: the pressure word stays constant, the
    temperature word does not.
    """

    def __init__(
        self,
        chip: ChipProperties,
        dome: DomeProperties,
        pressure_kpa: Callable[[float], float],
        surroundings: Surroundings,
        scene: EmulationSection,
        label: str,
        over_range: FaultTiming | None = None,
        frozen: FaultTiming | None = None,
        puncture: Puncture | None = None,
    ) -> None:
        self._c = chip.coefficients
        self._tadc_at_25 = chip.tadc_at_25_degc
        self._lags_s = dome.chip_lag_s, dome.gas_lag_s
        self._pressure_kpa = pressure_kpa
        self._surroundings = surroundings
        self._clip_kpa = scene.clip_kpa or math.inf
        self._epoch_ns: int | None = None
        self._over_range = over_range if over_range is not None else FaultTiming()
        self._frozen = frozen if frozen is not None else FaultTiming()
        self._puncture = puncture
        self._padc = -1  # none so far
        self._noise = _generate_noise(scene, self._lsb_kpa(), make_rng(label))
        self._correlated_s = scene.correlated_ms * 1e-3
        self._core_kpa = 0.0
        self._last_s = -math.inf
        self._is_temperature_constant = surroundings.is_temperature_constant
        self._constant_tadc = self._true_tadc(0.0)

    def begin_scene_time(self, epoch_ns: int) -> None:
        """Begin the scene's time at this instant of the clock."""
        self._epoch_ns = epoch_ns

    def __call__(self, t_ns: int) -> tuple[int, int]:
        """Compute the words `padc`, `tadc` of a conversion that samples at `t_ns`."""
        # A conversion begun before the scene samples its first instant.
        t_s = 0.0 if self._epoch_ns is None else max(0.0, (t_ns - self._epoch_ns) * 1e-9)
        core_kpa, outlier_kpa, tadc_noise = next(self._noise)
        kpa = self._pressure_kpa(t_s)
        if self._puncture is not None:
            kpa = self._puncture.apply_leak(kpa, t_s, t_ns)
        kpa = min(kpa, self._clip_kpa)
        if self._over_range(t_ns):
            kpa += _FAR_OVER_RANGE_KPA
        kpa += self._correlate(core_kpa, t_ns * 1e-9) + outlier_kpa
        # The true temperature affects the pressure word; the temperature word itself is noisy.
        tadc = self._constant_tadc if self._is_temperature_constant else self._true_tadc(t_s)
        c = self._c
        pcomp = (kpa - PRESSURE_MIN_KPA) / _KPA_PER_PCOMP
        padc = (pcomp - c.a0 - c.b2 * tadc) / (c.b1 + c.c12 * tadc)
        if self._padc < 0 or not self._frozen(t_ns):
            self._padc = round(padc) % 1024
        return self._padc, min(max(round(tadc + tadc_noise), 0), 1023)

    def _true_tadc(self, t_s: float) -> float:
        degc = self._surroundings.compute_chip_degc(t_s, *self._lags_s)
        return self._tadc_at_25 + (degc - 25.0) * _TADC_PER_KELVIN

    def _lsb_kpa(self) -> float:
        return abs(self._c.b1 + self._c.c12 * self._tadc_at_25) * _KPA_PER_PCOMP

    def _correlate(self, white_kpa: float, t_s: float) -> float:
        """Correlate the core noise in time (AR(1)), with unchanged variance."""
        if self._correlated_s == 0.0:
            return white_kpa
        keep = math.exp(-(t_s - self._last_s) / self._correlated_s)
        self._core_kpa = keep * self._core_kpa + math.sqrt(1.0 - keep * keep) * white_kpa
        self._last_s = t_s
        return self._core_kpa


def _generate_noise(
    scene: EmulationSection, lsb_kpa: float, rng: np.random.Generator
) -> Iterator[tuple[float, float, float]]:
    """Yield core noise and outlier in kPa, and temperature noise in counts, per conversion."""
    scale = scene.noise_kpa / _MEASURED_NOISE_KPA
    low, high = (scale * limit for limit in _OUTLIER_KPA)
    outlier_variance = _OUTLIER_RATE * (low * low + low * high + high * high) / 3
    core_variance = scene.noise_kpa**2 - outlier_variance - lsb_kpa**2 / 12
    core_kpa = math.sqrt(max(0.0, core_variance))
    n = _DRAWN_AT_ONCE
    while True:
        core = core_kpa * rng.standard_normal(n)
        size = rng.uniform(low, high, n) * np.where(rng.random(n) < _OUTLIERS_LOW, -1.0, 1.0)
        outlier = np.where(rng.random(n) < _OUTLIER_RATE, size, 0.0)
        temperature = _TADC_NOISE * rng.standard_normal(n)
        yield from zip(core.tolist(), outlier.tolist(), temperature.tolist(), strict=True)
