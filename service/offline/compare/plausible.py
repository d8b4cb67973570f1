"""What a reference's numbers cannot be, judged by ours: a wrong unit, a place off the foot."""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats
from devices.errors import ComparisonError
from service.offline.compare.align import Alignment
from service.offline.compare.pairs import Pairs

THOUSAND = 1000.0
NEAR = 3.0
"""A scale within this factor of a thousand, or of a thousandth, is a wrong unit."""
FEET = 10.0
"""A COP that travels over so many lengths of the foot is in another unit."""
OUTSIDE_SHARE = 0.05
RANGE = (5.0, 95.0)
"""Percentiles between which it travels."""


def check_force_unit(alignment: Alignment) -> None:
    """Refuse a reference whose force is some thousand times ours, or a thousandth.

    Raises:
        ComparisonError: it is.
    """
    scale = alignment.scale.value
    for factor, unit in ((THOUSAND, "kN"), (1.0 / THOUSAND, "mN")):
        if factor / NEAR < scale < factor * NEAR:
            raise ComparisonError(
                f"a newton of the reference is {scale:.4g} N of ours",
                expected="about one",
                remedy=f"Its unit may be {unit} instead: look at --units grf=",
            )


def cop_notes(pairs: Pairs, places_m: Floats) -> list[str]:
    """What is odd about where the reference's centre of pressure is.

    Args:
        pairs: our frames with the reference.
        places_m: (tiles, 2), of the tiles that bear load, in the foot frame.

    Raises:
        ComparisonError: it is in another unit.
    """
    rows = pairs.contact & np.isfinite(pairs.reference_cop_m).all(axis=1)
    if not rows.any() or len(places_m) < 2:
        return []
    cop_m = pairs.reference_cop_m[rows]
    centre_m = places_m.mean(axis=0)
    reach_m = float(np.hypot(*(places_m - centre_m).T).max())
    low_m, high_m = np.percentile(cop_m, RANGE, axis=0)
    travel_m = float(np.hypot(*(high_m - low_m)))
    if travel_m > FEET * 2.0 * reach_m:
        raise ComparisonError(
            f"the reference's centre of pressure travels over {travel_m:.3g} m under a foot whose "
            f"tiles span {2.0 * reach_m:.3g} m",
            expected="a centre of pressure under the foot",
            remedy="Its unit may be mm or cm: look at --units cop=",
        )
    outside = float(np.mean(np.hypot(*(cop_m - centre_m).T) > reach_m))
    if outside > OUTSIDE_SHARE:
        return [
            f"the reference's centre of pressure is outside the foot in {100.0 * outside:.0f} % of "
            "its frames: its origin or axes are not the foot's (--cop-offset-m), so only "
            "cop_p95_about_mean_m means anything"
        ]
    return []
