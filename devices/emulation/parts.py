"""Properties of emulated parts, drawn by serial and seed.

A serial is the same part in every scene and session with the same `parts_seed`. Drivers and
estimators must not read these properties: they use only the bus, and calibration recordings.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.chips.mpl115a2 import CONVERSION_MAX_NS, PRESSURE_MAX_KPA, Coefficients, compute_padc


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
class DomeProperties:
    """Properties of a polyurethane dome with its bubble (hardware.md 9).

    Static curve: under a slow force F the bubble loses the part `stiffening * ln(1 + F / knee_n)`
    of its volume; concave, unbounded, and no polynomial.
    """

    seal_kpa: float
    """Gas pressure unloaded at the sealing temperature."""
    knee_n: float
    stiffening: float
    wall_per_kpa: float
    """Volume change per kPa of pressure difference over the wall, relative."""
    conduction_s: float
    """Time constant r^2 / (pi^2 a) of the slowest mode of heat conduction in the bubble at constant
    pressure."""
    gas_lag_s: float
    """Time constant of the gas behind its chip's temperature; negative: of the chip behind the gas.
    """
    chip_lag_s: float
    """Time constant of the faster of the two behind the surroundings."""
    creep_parts: tuple[float, ...]
    """Parts of a force that appear with a delay (Prony terms)."""
    creep_s: tuple[float, ...]
    """Time constants of these parts."""
    loop_n: float
    """Half width of the rate-independent hysteresis loop at full load, in newtons."""
    viscous_n: float = 0.0
    """Half width of the additional loop due to viscosity, in newtons, where a force changes by
    7.5 N/s; faster loads widen it."""
    flow_part: float = 0.08
    """Part of a change of force that the viscous branch bears at first."""
    flow_power: float = 4.0
    """Exponent of the branch's rate of flow over its stress."""
    kappa: float = 0.4 / 1.4
    """(gamma - 1) / gamma of the gas: air's, unless it contains vapours of the casting."""

    def compute_static_force_n(self, kpa: Floats) -> Floats:
        """Compute the slow force of a pressure: inverse static curve, at sealing temperature."""
        stretched = 1.0 + self.wall_per_kpa * (kpa - self.seal_kpa)
        lost = 1.0 - self.seal_kpa / (kpa * stretched)
        return np.asarray(self.knee_n * np.expm1(lost / self.stiffening))


def draw_chip(serial: str, parts_seed: int) -> ChipProperties:
    """Draw the chip of a serial. The ranges bracket the three published sets of coefficients."""
    rng = _make_part_rng("chip", serial, parts_seed)
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


def draw_dome(serial: str, parts_seed: int) -> DomeProperties:
    """Draw the dome of a serial: an 11 mm Vytaflex 60 dome with casting tolerances.

    It reaches the chip's full scale of 115 kPa at a slow force of 25 to 35 N (paper III-A).
    """
    rng = _make_part_rng("dome", serial, parts_seed)
    seal_kpa = rng.uniform(98.0, 102.5)
    knee_n = rng.uniform(8.0, 13.0)
    wall_per_kpa = rng.uniform(0.0010, 0.0015)
    full_scale_n = rng.uniform(25.0, 35.0)
    stretched = 1.0 + wall_per_kpa * (PRESSURE_MAX_KPA - seal_kpa)
    lost = 1.0 - seal_kpa / (PRESSURE_MAX_KPA * stretched)
    return DomeProperties(
        seal_kpa=seal_kpa,
        knee_n=knee_n,
        stiffening=float(lost / np.log1p(full_scale_n / knee_n)),
        wall_per_kpa=wall_per_kpa,
        conduction_s=float(np.exp(rng.uniform(np.log(0.008), np.log(0.042)))),
        gas_lag_s=rng.uniform(2.0, 6.0),
        chip_lag_s=rng.uniform(0.8, 2.0),
        creep_parts=(rng.uniform(0.02, 0.04), rng.uniform(0.02, 0.04), rng.uniform(0.02, 0.04)),
        creep_s=(rng.uniform(0.02, 0.06), rng.uniform(0.2, 0.5), rng.uniform(1.5, 4.0)),
        loop_n=rng.uniform(0.35, 0.55),  # 3 % of 30 N from branch to branch
    )


def _make_part_rng(what: str, serial: str, parts_seed: int) -> np.random.Generator:
    return make_rng(f"{what}/{parts_seed}/{serial}")


def make_rng(label: str) -> np.random.Generator:
    """Create a random generator seeded by `label` alone, the same on every machine."""
    digest = hashlib.sha256(label.encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:16], "big"))
