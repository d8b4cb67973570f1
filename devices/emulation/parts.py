"""Properties of emulated domes, drawn by serial and seed, and the families of parts.

A serial is the same part in every scene and session with the same `parts_seed`. Drivers and
estimators must not read these properties: they use only the bus, and calibration recordings.

The default family is the basis of stored calibrations and results, and never changes. The broad one
tests an estimator on unknown domes: its ranges are wider wherever hardware.md says "not known", or
gives a number of one part only.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, replace

import numpy as np

from devices.arrays import Floats
from devices.errors import SceneError
from devices.scene.emulation_sections import PartFamily

FULL_SCALE_KPA = 115.0
"""Pressure at which the loads of domes are stated: the end of the paper's chip. A dome is the same
over any chip."""


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


def draw_dome(serial: str, parts_seed: int) -> DomeProperties:
    """Draw the dome of a serial: an 11 mm Vytaflex 60 dome with casting tolerances.

    It reaches 115 kPa at a slow force of 25 to 35 N (paper III-A).
    """
    rng = make_part_rng("dome", serial, parts_seed)
    seal_kpa = rng.uniform(98.0, 102.5)
    knee_n = rng.uniform(8.0, 13.0)
    wall_per_kpa = rng.uniform(0.0010, 0.0015)
    full_scale_n = rng.uniform(25.0, 35.0)
    stretched = 1.0 + wall_per_kpa * (FULL_SCALE_KPA - seal_kpa)
    lost = 1.0 - seal_kpa / (FULL_SCALE_KPA * stretched)
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


def make_part_rng(what: str, serial: str, parts_seed: int) -> np.random.Generator:
    """Create a random generator of a part's property."""
    return make_rng(f"{what}/{parts_seed}/{serial}")


def make_rng(label: str) -> np.random.Generator:
    """Create a random generator seeded by `label` alone, the same on every machine."""
    digest = hashlib.sha256(label.encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:16], "big"))


_LACKING_PROBABILITY = 0.05
"""Probability that a dome lacks the gas effect, creep, or loop: an estimator must not invent one.
"""


def draw_family_dome(family: PartFamily, serial: str, parts_seed: int) -> DomeProperties:
    """Draw the dome of a serial in a family."""
    if family == "default":
        return draw_dome(serial, parts_seed)
    if family == "table-1":
        return _make_paper_dome(serial, draw_dome("table-1", parts_seed))
    return _draw_broad_dome(make_rng(f"broad dome/{parts_seed}/{serial}"))


_TABLE_1 = re.compile(r"v(?P<material>40|60)-(?P<mm>10|11|12)")
_MODULUS_MPA = {"40": 0.69, "60": 2.17}
_BUBBLE_MM = 3.0


def _make_paper_dome(serial: str, usual: DomeProperties) -> DomeProperties:
    """Create a dome of the paper's Table I by its name: v60-11 is 11 mm of Vytaflex 60.

    The paper states forces of v60-11 only. All six are the same default dome, with forces scaled by
    modulus and area, which gives the same strain at the same part of full scale, and with the
    compliance of a thick sphere's wall (hardware.md 9).

    Raises:
        SceneError: the serial is no name of a dome.
    """
    named = _TABLE_1.fullmatch(serial)
    if named is None:
        raise SceneError(
            f"tile {serial} is of the family table-1, and no dome of the paper's Table I",
            expected="v40-10, v40-11, v40-12, v60-10, v60-11 or v60-12",
        )
    modulus_mpa, diameter_mm = _MODULUS_MPA[named["material"]], float(named["mm"])
    stiffer = modulus_mpa / _MODULUS_MPA["60"] * (diameter_mm / 11.0) ** 2
    given = _compute_wall_compliance(modulus_mpa, diameter_mm) / _compute_wall_compliance(
        _MODULUS_MPA["60"], 11.0
    )
    full_scale_n = float(usual.compute_static_force_n(np.array([FULL_SCALE_KPA]))[0])
    part = replace(
        usual,
        knee_n=stiffer * usual.knee_n,
        wall_per_kpa=given * usual.wall_per_kpa,
        loop_n=stiffer * usual.loop_n,
    )
    # A more compliant wall alone must not shift the end of the range: only the rubber's forces.
    shifted = float(part.compute_static_force_n(np.array([FULL_SCALE_KPA]))[0])
    lost = part.stiffening * np.log1p(shifted / part.knee_n)
    return replace(part, stiffening=float(lost / np.log1p(stiffer * full_scale_n / part.knee_n)))


def _compute_wall_compliance(modulus_mpa: float, diameter_mm: float) -> float:
    """Compute the relative compliance of a thick sphere's wall, up to a common factor."""
    outer3 = (diameter_mm / 2.0) ** 3
    return outer3 / (modulus_mpa * (outer3 - _BUBBLE_MM**3))


def _draw_broad_dome(rng: np.random.Generator) -> DomeProperties:
    """Draw a dome of varied rubber and gas that reaches 115 kPa at 20 to 40 N.

    Creep has one to four terms from 10 ms to 10 s, 2 to 15 % in sum. The loop of a slow stroke is
    1 to 5 % of full scale from branch to branch, with any viscous part: flow with the third to
    sixth power of the stress; Bergstrom and Boyce (1998) found about the fourth.
    """
    seal_kpa = rng.uniform(98.0, 102.5)
    full_scale_n = 20.0 * 2.0 ** rng.uniform(0.0, 1.0)
    knee_n = full_scale_n * rng.uniform(0.25, 0.5)
    wall_per_kpa = rng.uniform(0.0010, 0.0015) * 30.0 / full_scale_n  # a softer wall gives way more
    lost = 1.0 - seal_kpa / (FULL_SCALE_KPA * (1.0 + wall_per_kpa * (FULL_SCALE_KPA - seal_kpa)))
    gamma = rng.uniform(1.1, 1.4)
    conduction_s = float(np.exp(rng.uniform(np.log(0.005), np.log(0.060))))
    chip_lag_s = rng.uniform(0.8, 2.0)
    gas_lag_s = rng.uniform(-3.0, 3.0)
    terms = int(rng.integers(1, 5))
    creep_s = np.sort(np.exp(rng.uniform(np.log(0.010), np.log(10.0), terms)))
    creep_parts = rng.uniform(0.02, 0.15) * rng.dirichlet(np.ones(terms))
    loop_n = full_scale_n * rng.uniform(0.01, 0.05) / 2.0
    viscous_part = rng.uniform(0.0, 1.0)
    has_gas, has_creep, has_loop = (rng.random(3) >= _LACKING_PROBABILITY).tolist()
    # Drawn last: a new draw before the others would change all earlier parts.
    flow_part, flow_power = rng.uniform(0.04, 0.12), rng.uniform(3.0, 6.0)
    return DomeProperties(
        seal_kpa=seal_kpa,
        knee_n=knee_n,
        stiffening=float(lost / np.log1p(full_scale_n / knee_n)),
        wall_per_kpa=wall_per_kpa,
        conduction_s=conduction_s,
        gas_lag_s=gas_lag_s,
        chip_lag_s=chip_lag_s,
        creep_parts=tuple(creep_parts.tolist()) if has_creep else (),
        creep_s=tuple(creep_s.tolist()) if has_creep else (),
        loop_n=(1.0 - viscous_part) * loop_n if has_loop else 0.0,
        viscous_n=viscous_part * loop_n if has_loop else 0.0,
        flow_part=flow_part,
        flow_power=flow_power,
        kappa=(gamma - 1.0) / gamma if has_gas else 0.0,
    )
