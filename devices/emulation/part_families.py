"""Families of emulated parts: the default one, the paper's six domes, and a broad one.

The default family (`devices.emulation.parts`) is the basis of stored calibrations and results, and
never changes. The broad one tests an estimator on unknown domes: its ranges are wider wherever
hardware.md says "not known", or gives a number of one part only.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from devices.chips.mpl115a2 import PRESSURE_MAX_KPA
from devices.emulation.parts import ChipProperties, DomeProperties, draw_chip, draw_dome, make_rng
from devices.errors import SceneError
from devices.scene.emulation_sections import PartFamily

_SAMPLE_DELAY_MAX_NS = 300_000
"""Largest deviation of the sample instant from a quarter of the conversion."""
_LACKING_PROBABILITY = 0.05
"""Probability that a dome lacks the gas effect, creep, or loop: an estimator must not invent one.
"""


def draw_family_chip(family: PartFamily, serial: str, parts_seed: int) -> ChipProperties:
    """Draw the chip of a serial in a family."""
    chip = draw_chip(serial, parts_seed)
    if family != "broad":
        return chip
    rng = make_rng(f"broad chip/{parts_seed}/{serial}")
    return replace(
        chip, sample_delay_ns=round(rng.uniform(-_SAMPLE_DELAY_MAX_NS, _SAMPLE_DELAY_MAX_NS))
    )


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
    full_scale_n = float(usual.compute_static_force_n(np.array([PRESSURE_MAX_KPA]))[0])
    part = replace(
        usual,
        knee_n=stiffer * usual.knee_n,
        wall_per_kpa=given * usual.wall_per_kpa,
        loop_n=stiffer * usual.loop_n,
    )
    # A more compliant wall alone must not shift the end of the range: only the rubber's forces.
    shifted = float(part.compute_static_force_n(np.array([PRESSURE_MAX_KPA]))[0])
    lost = part.stiffening * np.log1p(shifted / part.knee_n)
    return replace(part, stiffening=float(lost / np.log1p(stiffer * full_scale_n / part.knee_n)))


def _compute_wall_compliance(modulus_mpa: float, diameter_mm: float) -> float:
    """Compute the relative compliance of a thick sphere's wall, up to a common factor."""
    outer3 = (diameter_mm / 2.0) ** 3
    return outer3 / (modulus_mpa * (outer3 - _BUBBLE_MM**3))


def _draw_broad_dome(rng: np.random.Generator) -> DomeProperties:
    """Draw a dome of varied rubber and gas that reaches the chip's full scale at 20 to 40 N.

    Creep has one to four terms from 10 ms to 10 s, 2 to 15 % in sum. The loop of a slow stroke is
    1 to 5 % of full scale from branch to branch, with any viscous part: flow with the third to
    sixth power of the stress; Bergstrom and Boyce (1998) found about the fourth.
    """
    seal_kpa = rng.uniform(98.0, 102.5)
    full_scale_n = 20.0 * 2.0 ** rng.uniform(0.0, 1.0)
    knee_n = full_scale_n * rng.uniform(0.25, 0.5)
    wall_per_kpa = rng.uniform(0.0010, 0.0015) * 30.0 / full_scale_n  # a softer wall gives way more
    lost = 1.0 - seal_kpa / (
        PRESSURE_MAX_KPA * (1.0 + wall_per_kpa * (PRESSURE_MAX_KPA - seal_kpa))
    )
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
