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
from dataclasses import dataclass, replace

import numpy as np

from devices.chips.mpl115a2 import (
    ADDRESS,
    CONVERSION_MAX_NS,
    PRESSURE_MAX_KPA,
    PRESSURE_MIN_KPA,
    Coefficients,
    compute_padc,
)
from devices.chips.pressure_chip import Registers
from devices.emulation.fault_timing import PartFaults
from devices.emulation.i2c_bus import OnConversion
from devices.emulation.parts import make_part_rng, make_rng
from devices.emulation.surroundings import ChipSite
from devices.scene.emulation_sections import EmulationSection, PartFamily, ReadDuringConversion
from devices.scene.hardware_sections import TileSection
from devices.scene.scene_file import Scene

_CONVERT = 0x12
_REGISTERS = 0x80
_SAMPLE_QUARTER = 4  # as the driver assumes (hardware.md 1.4)
_SLOW_NS = 2_900_000  # slower than any healthy part, within the data sheet's 3 ms

SampleFunction = Callable[[int], tuple[int, int]]
"""Function of a conversion's sample instant in ns that returns the 10-bit words `padc`, `tadc`."""


@dataclass(frozen=True)
class ChipProperties:
    """Properties of an MPL115A2 (hardware.md 1.3, 1.4, 1.6)."""

    coefficients: Coefficients
    conversion_ns: int
    tadc_at_25_degc: float
    sample_delay_ns: int = 0
    """Delay of the sample instant after a quarter of the conversion: not documented (hardware.md
    1.4)."""


@dataclass(frozen=True)
class Mpl115a2Part:
    """Fixed properties of one part."""

    registers: Registers
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

    address = ADDRESS
    """I2C address of every part; the general call is not acknowledged (DS 2)."""

    def __init__(
        self,
        silicon: Mpl115a2Part,
        read_during_conversion: ReadDuringConversion = "stale",
        faults: PartFaults | None = None,
        make_replacement: Callable[[], Mpl115a2Part] | None = None,
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

    @property
    def sample_delay_ns(self) -> int:
        """Delay of a sample after the instant that drivers assume."""
        return self._silicon.sample_delay_ns

    def interrupt_supply(self) -> None:
        """Reset: all registers but the coefficients are zero, no conversion runs."""
        self._registers = bytearray(_REGISTERS)
        self._registers[0x04:0x0C] = struct.pack(">4H", *self._silicon.registers)
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
                self.on_conversion(t_ns, words, self._silicon.registers)
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


class FrontEnd:
    """Sampler of a chip at its site: called by the emulated chip.

    Fault `frozen`: the pressure word stays constant, the temperature word does not.
    """

    def __init__(self, chip: ChipProperties, site: ChipSite) -> None:
        self._c = chip.coefficients
        self._tadc_at_25 = chip.tadc_at_25_degc
        self._site = site
        self._padc = -1  # none so far
        self._noise = _generate_noise(site.emulation, self._lsb_kpa(), make_rng(site.noise_label))
        self._correlated_s = site.emulation.correlated_ms * 1e-3
        self._core_kpa = 0.0
        self._last_s = -math.inf
        self._constant_tadc = self._true_tadc(0.0)

    def __call__(self, t_ns: int) -> tuple[int, int]:
        """Compute the words `padc`, `tadc` of a conversion that samples at `t_ns`."""
        t_s = self._site.to_scene_s(t_ns)
        core_kpa, outlier_kpa, tadc_noise = next(self._noise)
        kpa = self._site.compute_kpa(t_s, t_ns)
        kpa += self._correlate(core_kpa, t_ns * 1e-9) + outlier_kpa
        # The true temperature affects the pressure word; the temperature word itself is noisy.
        is_constant = self._site.is_temperature_constant
        tadc = self._constant_tadc if is_constant else self._true_tadc(t_s)
        c = self._c
        pcomp = (kpa - PRESSURE_MIN_KPA) / _KPA_PER_PCOMP
        padc = (pcomp - c.a0 - c.b2 * tadc) / (c.b1 + c.c12 * tadc)
        if self._padc < 0 or not self._site.is_frozen(t_ns):
            self._padc = round(padc) % 1024
        return self._padc, min(max(round(tadc + tadc_noise), 0), 1023)

    def _true_tadc(self, t_s: float) -> float:
        return self._tadc_at_25 + (self._site.compute_degc(t_s) - 25.0) * _TADC_PER_KELVIN

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


def draw_chip(serial: str, parts_seed: int) -> ChipProperties:
    """Draw the chip of a serial. The ranges bracket the three published sets of coefficients."""
    rng = make_part_rng("chip", serial, parts_seed)
    while True:
        drawn = Coefficients(
            a0=rng.uniform(1700, 2200),
            b1=rng.uniform(-2.5, -1.9),
            b2=rng.uniform(-1.0, -0.85),
            c12=rng.uniform(0.00065, 0.00088),
        )
        coefficients = Coefficients.from_words(drawn.to_words())
        if 250 <= float(compute_padc(100.0, 500, coefficients)) <= 500:
            break
    return ChipProperties(
        coefficients=coefficients,
        conversion_ns=min(CONVERSION_MAX_NS, round(rng.uniform(1.4e6, 2.0e6))),
        tadc_at_25_degc=rng.uniform(472, 498),  # two published scales, 26 counts apart
    )


_SAMPLE_DELAY_MAX_NS = 300_000
"""Largest deviation of the sample instant from a quarter of the conversion."""


def draw_family_chip(family: PartFamily, serial: str, parts_seed: int) -> ChipProperties:
    """Draw the chip of a serial in a family."""
    chip = draw_chip(serial, parts_seed)
    if family != "broad":
        return chip
    rng = make_rng(f"broad chip/{parts_seed}/{serial}")
    return replace(
        chip, sample_delay_ns=round(rng.uniform(-_SAMPLE_DELAY_MAX_NS, _SAMPLE_DELAY_MAX_NS))
    )


def make_chip(
    tile: TileSection,
    scene: Scene,
    parts_seed: int,
    faults: PartFaults,
    make_site: Callable[[str], ChipSite],
) -> EmulatedMpl115a2:
    """Make the chip of a scene's tile; `make_site` makes the site of a serial."""

    def make_part(serial: str) -> Mpl115a2Part:
        chip = draw_family_chip(scene.emulation.family, serial, parts_seed)
        fixed_ms = scene.array.conversion_ms
        return Mpl115a2Part(
            chip.coefficients.to_words(),
            chip.conversion_ns if fixed_ms is None else round(fixed_ms * 1e6),
            FrontEnd(chip, make_site(serial)),
            chip.sample_delay_ns,
        )

    return EmulatedMpl115a2(
        make_part(tile.serial),
        scene.emulation.read_during_conversion,
        faults,
        make_replacement=lambda: make_part(f"{tile.serial}.spare"),
    )
