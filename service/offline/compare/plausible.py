"""Plausibility checks of a reference against our data: units, scale, drift, COP position."""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats
from devices.errors import ComparisonError
from service.offline.compare.align import Alignment
from service.offline.compare.pairs import Pairs
from service.offline.compare.signals import Signal

THOUSAND = 1000.0
STEP_MIN_S = 0.3
"""Sample interval from which a reference's time unit is doubtful."""
NEAR = 3.0
"""A scale within this factor of 1000 or 1/1000 means a wrong unit."""
FEET = 10.0
"""COP range, in foot lengths, from which the COP must be in another unit."""
BORNE = 0.1
"""Force, relative to the greatest, below which the COP is not checked."""
OUTSIDE_SHARE = 0.05
SCALE_FAR = 2.0
"""Scale, or its inverse, beyond any mounted foot's gain: the unit or the foot is another."""
OTHER_UNITS = {"kgf": 9.80665, "lbf": 4.44822}
DRIFT_FAR_PPM = 500.0
"""Implausible drift; crystal clocks differ by at most 100 ppm."""
RANGE = (5.0, 95.0)
"""Percentiles that define the COP's range."""


def check_time_unit(ours: Signal, reference: Signal) -> None:
    """Reject a reference whose times are not in seconds.

    Raises:
        ComparisonError: it lasts some thousand times as long, and its samples are too far apart
            to resolve steps. A long recording at a usual rate passes.
    """
    if reference.step_s < STEP_MIN_S:
        return
    times = float(np.ptp(reference.t_s) / np.ptp(ours.t_s))
    for factor, unit in ((THOUSAND, "ms"), (THOUSAND**2, "us"), (THOUSAND**3, "ns")):
        if factor / NEAR < times < factor * NEAR:
            raise ComparisonError(
                f"the reference is {np.ptp(reference.t_s):.4g} s long, {times:.0f} times the "
                f"session, with a sample every {reference.step_s:.3g} s",
                expected="about as long as the session",
                remedy=f"Its time may be in {unit}: add --units time={unit}, and rename its column "
                "if that is called time_s",
            )


def check_force_unit(alignment: Alignment) -> None:
    """Reject a reference whose force is about 1000 times ours, or 1/1000.

    Raises:
        ComparisonError: the scale is near 1000 or 1/1000.
    """
    scale = alignment.scale.value
    for factor, unit in ((THOUSAND, "kN"), (1.0 / THOUSAND, "mN")):
        if factor / NEAR < scale < factor * NEAR:
            raise ComparisonError(
                f"a newton of the reference is {scale:.4g} N of ours",
                expected="about one",
                remedy=f"Its unit may be {unit} instead: look at --units grf=",
            )


def far_notes(alignment: Alignment) -> list[str]:
    """Return notes on an implausible scale or drift."""
    notes, scale = [], alignment.scale.value
    if not 1.0 / SCALE_FAR < scale < SCALE_FAR:
        near = next((u for u, n in OTHER_UNITS.items() if n / 1.25 < scale < n * 1.25), None)
        what = "its unit or its place may be another" if near is None else f"it may be in {near}"
        notes.append(f"a newton of the reference is {scale:.3g} N of ours: {what}")
    low_ppm, high_ppm = alignment.drift_ppm.interval_95
    if low_ppm > DRIFT_FAR_PPM or high_ppm < -DRIFT_FAR_PPM:
        notes.append(
            f"the clocks differ by {alignment.drift_ppm.value:.0f} ppm, far more than clocks do: "
            "is it the recording of this trial, and its time in seconds?"
        )
    return notes


def gain_notes(alignment: Alignment) -> list[str]:
    """Return advice for a plausible scale that differs from one."""
    low, high = alignment.scale.interval_95
    if low <= 1.0 <= high or not 1.0 / SCALE_FAR < alignment.scale.value < SCALE_FAR:
        return []
    return [
        f"a newton of the reference is {alignment.scale.value:.3f} N of ours: load may pass beside "
        "the domes, or a gain is off; `foottile calibrate --reference` fits a mounted foot"
    ]


def cop_notes(pairs: Pairs, places_m: Floats) -> list[str]:
    """Return notes on an implausible COP of the reference.

    Args:
        pairs: our frames with the reference.
        tile_positions_m: (tiles, 2), positions of the load-bearing tiles in the foot frame.

    Raises:
        ComparisonError: the COP is in another unit.
    """
    rows = pairs.contact & np.isfinite(pairs.reference_cop_m).all(axis=1)
    # At a few newtons a plate's COP is noise divided by noise.
    over_zero_n = pairs.reference_n - pairs.zero_left_n
    rows &= over_zero_n > BORNE * np.max(over_zero_n, initial=0.0, where=rows)
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
