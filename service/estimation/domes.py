"""Choice of a dome for a load, by the paper's Table I and Boyle's law.

The paper gives the range of one dome over its chip only, 25 to 35 N for 11 mm of Vytaflex 60
(III-A). For others there is only a scaling, marked as an estimate: no curve is published. PAPER is
Ruppert and Badri-Sproewitz 2020, [D] a derivation in hardware.md 9.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Literal

from devices.chips.mpl115a2 import MPL115A2

SEAL_KPA = 100.0
"""Approximate pressure at which a bubble is sealed (PAPER II-A)."""
ISOTHERMAL = 1.0
ADIABATIC = 1.4
"""Exponents of air; a real load has a polytropic exponent between the two, by its speed against a
relaxation of 5 to 42 ms ([D])."""
PAPER_CHIP = MPL115A2
PAPER_KPA = PAPER_CHIP.max_kpa
"""End of that chip's range: full scale of the paper's domes."""
BUBBLE_RADIUS_MM = 3.0
"""PAPER Table I, for the 11 mm dome; assumed for the others."""

RangeSource = Literal["paper", "estimate"]
LoadVerdict = Literal["covers", "perhaps", "saturates"]


@dataclass(frozen=True)
class Material:
    """Polyurethane of the paper's Table I.

    Its modulus in the paper is almost surely the maker's at 100 % strain, not the small-strain one
    ([D]).
    """

    name: str
    modulus_mpa: float


VYTAFLEX_40 = Material("Vytaflex 40", 0.69)
VYTAFLEX_60 = Material("Vytaflex 60", 2.17)


@dataclass(frozen=True)
class Dome:
    """Dome of the paper's Table I."""

    material: Material
    diameter_mm: float

    @property
    def name(self) -> str:
        """Name such as `v60-11`: material and diameter."""
        return f"v{self.material.name.split()[-1]}-{self.diameter_mm:.0f}"

    @property
    def base_area_mm2(self) -> float:
        """Area of the base in mm2."""
        return pi * (self.diameter_mm / 2) ** 2


DOMES = tuple(
    Dome(material, diameter_mm)
    for material in (VYTAFLEX_40, VYTAFLEX_60)
    for diameter_mm in (10.0, 11.0, 12.0)
)
"""Domes of PAPER Table I."""
PAPER_DOME = Dome(VYTAFLEX_60, 11.0)
"""Dome that was built (PAPER III-A)."""
PAPER_EQUATION_2 = (0.1309, 0.5702, 0.02354, 0.13)
"""Coefficients of its curve, from the constant on, without units (PAPER eq. 2, hardware.md 7)."""
PAPER_RANGE_N = (25.0, 35.0)
"""Load at which that dome saturates its chip (PAPER III-A)."""


def compute_volume_ratio(exponent: float = ISOTHERMAL, full_scale_kpa: float = PAPER_KPA) -> float:
    """Return V2/V1 of a bubble that goes from its seal to full scale: p1 V1^k = p2 V2^k.

    Slowly, k = 1, this is Boyle's law (PAPER eq. 1): 0.8696 is left at 115 kPa, 13 % are gone. Fast
    loads reach full scale earlier: k = 1.4 leaves 0.9050.
    """
    return float((SEAL_KPA / full_scale_kpa) ** (1.0 / exponent))


def compute_fast_to_slow_saturation_load_ratio(full_scale_kpa: float = PAPER_KPA) -> float:
    """Return the change of volume at full scale of a fast load, relative to a slow one: 0.73.

    With volume proportional to force this is also the ratio of the loads ([D], estimate).
    """
    slow = 1.0 - compute_volume_ratio(ISOTHERMAL, full_scale_kpa)
    return (1.0 - compute_volume_ratio(ADIABATIC, full_scale_kpa)) / slow


def compute_wall_compliance_per_kpa(dome: Dome) -> float:
    """Return the compliance of the wall: part of the bubble's volume for a kPa of difference.

    Thick sphere of an incompressible rubber, 9 b^3 / (4 E (b^3 - a^3)): 0.00124 for Vytaflex 60,
    0.00389 for Vytaflex 40, both of 11 mm ([D], estimate: half a sphere on a board is no sphere).
    """
    a3, b3 = BUBBLE_RADIUS_MM**3, (dome.diameter_mm / 2) ** 3
    return 9.0 * b3 / (4.0 * dome.material.modulus_mpa * 1e3 * (b3 - a3))


def compute_ambient_transmission(dome: Dome) -> float:
    """Return the part of a change of the surrounding pressure that reaches the bubble.

    11 % in Vytaflex 60 and 28 % in Vytaflex 40, both of 11 mm ([D], estimate): weather, height, and
    the depth of mud. The gas' own stiffness is its pressure.
    """
    given = compute_wall_compliance_per_kpa(dome) * SEAL_KPA
    return given / (1.0 + given)


@dataclass(frozen=True)
class SlowSaturationLoad:
    """Range of slow loads at which a dome saturates its chip, with its source."""

    dome: Dome
    low_n: float
    high_n: float
    source: RangeSource

    def judge_slow_load(self, load_n: float) -> LoadVerdict:
        """Return whether the dome covers a slow load without saturating."""
        if load_n <= self.low_n:
            return "covers"
        return "perhaps" if load_n <= self.high_n else "saturates"


def compute_load_growth(full_scale_kpa: float) -> tuple[float, float]:
    """Return the least and the greatest load at another full scale, over that at the paper's.

    Nothing is published beyond the paper's full scale. At least the load follows the volume that is
    lost, 1.53 times to 125 kPa, since a dome stiffens; at most the paper's curve, 2.24 times
    (hardware.md 12, estimates).
    """
    lost = 1.0 - compute_volume_ratio(full_scale_kpa=full_scale_kpa)
    at = (full_scale_kpa - SEAL_KPA) / (PAPER_KPA - SEAL_KPA)  # in the paper's full scales
    terms = PAPER_EQUATION_2[1:]
    curve = sum(term * at**power for power, term in enumerate(terms, start=1)) / sum(terms)
    return lost / (1.0 - compute_volume_ratio()), curve


def compute_saturation_load(dome: Dome, full_scale_kpa: float = PAPER_KPA) -> SlowSaturationLoad:
    """Return the saturation load: the paper's for its dome and chip, else scaled.

    The scaling by modulus and area assumes the same shape and strain at full scale. It agrees with
    the paper in direction only: stiffer and larger domes shift the curve to higher force (PAPER
    Fig. 5).
    """
    if dome == PAPER_DOME and full_scale_kpa == PAPER_KPA:
        return SlowSaturationLoad(dome, *PAPER_RANGE_N, "paper")
    scale = (dome.material.modulus_mpa * dome.base_area_mm2) / (
        PAPER_DOME.material.modulus_mpa * PAPER_DOME.base_area_mm2
    )
    low_n, high_n = (
        scale * growth * load_n
        for growth, load_n in zip(compute_load_growth(full_scale_kpa), PAPER_RANGE_N, strict=True)
    )
    return SlowSaturationLoad(dome, low_n, high_n, "estimate")


def list_saturation_loads(full_scale_kpa: float = PAPER_KPA) -> list[SlowSaturationLoad]:
    """Return the saturation loads of all domes of Table I, weakest first."""
    found = (compute_saturation_load(dome, full_scale_kpa) for dome in DOMES)
    return sorted(found, key=lambda load: load.low_n)


def select_weakest_covering_dome(
    load_n: float, full_scale_kpa: float = PAPER_KPA
) -> SlowSaturationLoad | None:
    """Return the weakest dome that covers a slow load; it resolves the load best.

    If none does for certain, the weakest that perhaps does; None if all saturate.

    Raises:
        ValueError: no load.
    """
    if not load_n > 0.0:
        raise ValueError(f"a load of {load_n} N is no load")
    for verdict in ("covers", "perhaps"):
        for found in list_saturation_loads(full_scale_kpa):
            if found.judge_slow_load(load_n) == verdict:
                return found
    return None
