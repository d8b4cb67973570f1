"""Saturation: bounds of the load during saturation and gaps, and its effect on gas and rubber.

The load is unknown beyond the chip's end or the calibrated range, and during more than
`LONG_GAP_NS` without a reading. Models with a state then run twice: on the best guess, and on the
possible load farthest from it (alternative hypothesis). The second run decays towards the first
with the models' own time constants. The difference of the two is the uncertainty of the next
estimates.
"""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation import LONG_GAP_NS
from service.estimation.models.static import StaticParams, compute_forces
from service.estimation.records import KernelRecord, RecordArray

FORCE_MAX_FACTOR = 2.0
"""Largest load during saturation, over the load where saturation begins. The paper's dome ends at
25 to 35 N and its leg weighs 8.9 N: this is six to eight legs on a single tile. An assumption;
where loads are greater the dome is the wrong one (`foottile domes`)."""
UNIFORM_SIGMA = 1.0 / 3.0**0.5
"""Standard deviation of a uniform distribution over its half width: 1.96 standard deviations
reach a little farther."""


class SaturationParams(KernelRecord):
    """Bounds of the load on a tile during saturation and gaps."""

    range_high_kpa: float  # gauge pressure at the calibrated range's end
    range_end_n: float  # load there
    slope_n_per_kpa: float  # slope with which the curve is extrapolated
    force_max_n: float  # largest possible load during saturation
    range_end_hot_kpa: float  # absolute pressure of the load at the range's end, before gas cools
    force_max_hot_kpa: float  # same of the largest possible load


@jit_cached
def extrapolate_capped_force_n(params: SaturationParams, curve_n: float, gauge_kpa: float) -> float:
    """Extrapolate the static curve beyond its range, up to the largest load; NaN stays NaN.

    Args:
        params: of the tile.
        curve_n: force by the static curve, constant beyond its range.
        gauge_kpa: pressure above the baseline.
    """
    beyond_kpa = gauge_kpa - params.range_high_kpa
    guess = curve_n + params.slope_n_per_kpa * beyond_kpa if beyond_kpa > 0.0 else curve_n
    return params.force_max_n if guess > params.force_max_n else guess


def make_saturation_params(
    curves: RecordArray[StaticParams], gamma: Floats, baseline_kpa: Floats, chip_max_kpa: Floats
) -> RecordArray[SaturationParams]:
    """Make the bounds of load-bearing tiles, (tiles,).

    Args:
        curves: static curves of the tiles.
        gamma: (tiles,), ratio of heat capacities of their gas; 1 if no heat is corrected.
        baseline_kpa: (tiles,), absolute pressure unloaded.
        chip_max_kpa: (tiles,), absolute pressure above which the chip saturates.
    """
    high_kpa = curves["range_high_kpa"]
    at_end = compute_forces(curves, high_kpa[None])
    end_n, slope = at_end.force_n[0], at_end.slope_n_per_kpa[0]
    # A preset's curve may bend over where it ends.
    slope = np.where(slope > 0.0, slope, end_n / high_kpa)
    tells_kpa = np.maximum(high_kpa, chip_max_kpa - baseline_kpa)
    most_n = FORCE_MAX_FACTOR * (end_n + slope * (tells_kpa - high_kpa))
    most_kpa = high_kpa + (most_n - end_n) / slope
    # The baseline is 0 before the first tare.
    base_kpa = np.maximum(baseline_kpa, 1.0)
    end_hot_kpa, most_hot_kpa = (
        base_kpa * (1.0 + gauge_kpa / base_kpa) ** gamma for gauge_kpa in (high_kpa, most_kpa)
    )
    return SaturationParams.array(
        len(high_kpa),
        range_high_kpa=high_kpa,
        range_end_n=end_n,
        slope_n_per_kpa=slope,
        force_max_n=most_n,
        range_end_hot_kpa=end_hot_kpa,
        force_max_hot_kpa=most_hot_kpa,
    )


@jit_cached
def select_farther_bound(value: float, lower_bound: float, upper_bound: float) -> float:
    """Return the bound farther from `value`; the lower one if both are as far."""
    return upper_bound if upper_bound - value > value - lower_bound else lower_bound


@jit_cached
def is_after_long_gap(t_ns: int, last_ns: int) -> bool:
    """Return whether more than `LONG_GAP_NS` passed since the last reading."""
    return t_ns - last_ns > LONG_GAP_NS
