"""Plausibility checks of a reference against our data: units, scale, drift, COP position."""

from __future__ import annotations

import math

import numpy as np

from devices.arrays import Floats
from devices.errors import ComparisonError
from service.offline.compare.alignment import ReferenceAlignment
from service.offline.compare.paired_frames import PairedFrames
from service.offline.compare.signals import ForceSignal

UNIT_FACTOR = 1000.0
DOUBTFUL_STEP_S = 0.3
"""Sample interval from which a reference's time unit is doubtful."""
UNIT_FACTOR_TOLERANCE = 3.0
"""A scale within this factor of 1000 or 1/1000 means a wrong unit."""
MAX_COP_RANGE_FEET = 10.0
"""COP range, in foot lengths, from which the COP must be in another unit."""
MIN_LOAD_SHARE = 0.1
"""Force, relative to the greatest, below which the COP is not checked."""
MAX_OUTSIDE_SHARE = 0.05
EDGE_SIGMAS = 3.0
"""Tolerance of the foot's edge, in standard uncertainties of a COP: as of the hull of our own."""
IMPLAUSIBLE_SCALE = 2.0
"""Scale, or its inverse, beyond any mounted foot's gain: the unit or the foot is another."""
OTHER_UNITS = {"kgf": 9.80665, "lbf": 4.44822}
IMPLAUSIBLE_DRIFT_PPM = 500.0
"""Implausible drift; crystal clocks differ by at most 100 ppm."""
COP_RANGE_PERCENTILES = (5.0, 95.0)
"""Percentiles that define the COP's range."""


def check_time_unit(ours: ForceSignal, reference: ForceSignal) -> None:
    """Reject a reference whose times are not in seconds.

    Raises:
        ComparisonError: it lasts some thousand times as long, and its samples are too far apart
            to resolve steps. A long recording at a usual rate passes.
    """
    if reference.step_s < DOUBTFUL_STEP_S:
        return
    times = float(np.ptp(reference.t_s) / np.ptp(ours.t_s))
    for factor, unit in ((UNIT_FACTOR, "ms"), (UNIT_FACTOR**2, "us"), (UNIT_FACTOR**3, "ns")):
        if factor / UNIT_FACTOR_TOLERANCE < times < factor * UNIT_FACTOR_TOLERANCE:
            raise ComparisonError(
                f"the reference is {np.ptp(reference.t_s):.4g} s long, {times:.0f} times the "
                f"session, with a sample every {reference.step_s:.3g} s",
                expected="about as long as the session",
                remedy=f"Its time may be in {unit}: add --units time={unit}, and rename its column "
                "if that is called time_s",
            )


def check_force_unit(alignment: ReferenceAlignment) -> None:
    """Reject a reference whose force is about 1000 times ours, or 1/1000.

    Raises:
        ComparisonError: the scale is near 1000 or 1/1000.
    """
    scale = alignment.scale.value
    for factor, unit in ((UNIT_FACTOR, "kN"), (1.0 / UNIT_FACTOR, "mN")):
        if factor / UNIT_FACTOR_TOLERANCE < scale < factor * UNIT_FACTOR_TOLERANCE:
            raise ComparisonError(
                f"a newton of the reference is {scale:.4g} N of ours",
                expected="about one",
                remedy=f"Its unit may be {unit} instead: look at --units grf=",
            )


def describe_implausible_alignment(alignment: ReferenceAlignment) -> list[str]:
    """Return notes on an implausible scale or drift."""
    notes, scale = [], alignment.scale.value
    if not 1.0 / IMPLAUSIBLE_SCALE < scale < IMPLAUSIBLE_SCALE:
        near = next((u for u, n in OTHER_UNITS.items() if n / 1.25 < scale < n * 1.25), None)
        what = "its unit or its place may be another" if near is None else f"it may be in {near}"
        notes.append(f"a newton of the reference is {scale:.3g} N of ours: {what}")
    low_ppm, high_ppm = alignment.drift_ppm.interval_95
    if low_ppm > IMPLAUSIBLE_DRIFT_PPM or high_ppm < -IMPLAUSIBLE_DRIFT_PPM:
        notes.append(
            f"the clocks differ by {alignment.drift_ppm.value:.0f} ppm, far more than clocks do: "
            "is it the recording of this trial, and its time in seconds?"
        )
    return notes


def advise_on_scale(alignment: ReferenceAlignment) -> list[str]:
    """Return advice for a plausible scale that differs from one."""
    low, high = alignment.scale.interval_95
    if (
        low <= 1.0 <= high
        or not 1.0 / IMPLAUSIBLE_SCALE < alignment.scale.value < IMPLAUSIBLE_SCALE
    ):
        return []
    return [
        f"a newton of the reference is {alignment.scale.value:.3f} N of ours: load may pass beside "
        "the domes, or a gain is off; `foottile calibrate --reference` fits a mounted foot"
    ]


def check_cop_position(
    pairs: PairedFrames, tile_positions_m: Floats, reference_sigma_m: float | None = None
) -> list[str]:
    """Return notes on an implausible COP of the reference.

    A load on a tile at the edge has its COP there, and half of its noise is beyond.

    Args:
        pairs: our frames with the reference.
        tile_positions_m: (tiles, 2), positions of the load-bearing tiles in the foot frame.
        reference_sigma_m: standard uncertainty of each coordinate of the reference's COP; None:
            not known, then the edge has the tolerance of our own COP alone.

    Raises:
        ComparisonError: the COP is in another unit.
    """
    rows = pairs.reference_contact & np.isfinite(pairs.reference_cop_m).all(axis=1)
    # At a few newtons a plate's COP is noise divided by noise.
    over_zero_n = pairs.reference_n - pairs.remaining_zero_n
    rows &= over_zero_n > MIN_LOAD_SHARE * np.max(over_zero_n, initial=0.0, where=rows)
    if not rows.any() or len(tile_positions_m) < 2:
        return []
    cop_m = pairs.reference_cop_m[rows]
    centre_m = tile_positions_m.mean(axis=0)
    reach_m = float(np.hypot(*(tile_positions_m - centre_m).T).max())
    low_m, high_m = np.percentile(cop_m, COP_RANGE_PERCENTILES, axis=0)
    travel_m = float(np.hypot(*(high_m - low_m)))
    if travel_m > MAX_COP_RANGE_FEET * 2.0 * reach_m:
        raise ComparisonError(
            f"the reference's centre of pressure travels over {travel_m:.3g} m under a foot whose "
            f"tiles span {2.0 * reach_m:.3g} m",
            expected="a centre of pressure under the foot",
            remedy="Its unit may be mm or cm: look at --units cop=",
        )
    sigmas_m = [pairs.columns[name][rows] for name in ("cop_sigma_x_m", "cop_sigma_y_m")]
    own_m = [float(np.median(known)) for each in sigmas_m if len(known := each[np.isfinite(each)])]
    tolerance_m = EDGE_SIGMAS * math.hypot(*own_m, reference_sigma_m or 0.0)
    outside = float(np.mean(np.hypot(*(cop_m - centre_m).T) > reach_m + tolerance_m))
    if outside > MAX_OUTSIDE_SHARE:
        return [
            "the reference's centre of pressure is outside the foot by more than "
            f"{1e3 * tolerance_m:.1f} mm in {100.0 * outside:.0f} % of its frames: its origin or "
            "axes are not the foot's (--cop-offset-m), so only cop_p95_about_mean_m means anything"
        ]
    return []
