"""Lost baselines: a dome that has leaked, or one whose baseline has moved for an unknown reason.

No load makes a dome read less than without load. If it stays below its baseline by more than
temperature, surroundings and the gas of a released dome explain, then gas is missing, or the gas is
colder than its chip. The largest such reading bounds the error of the baseline.

A leak so fast that air returns within a moment shows as well: air that leaks out under load has to
return, so the tile reads too little afterwards as much as it has read too much. A sealed dome
hardly reads too little at all.

A tile that permanently reads too much cannot be told from a loaded one.
"""

from __future__ import annotations

import math

import numpy as np

from devices.jit import jit_cached
from service.estimation.records import KernelRecord, RecordArray

ERROR_MIN_KPA = 0.4
"""Four fifths of a newton; creep and hysteresis leave half of that of a fast release."""
TOLERANCE_SIGMAS = 5.0
"""Tolerance in standard uncertainties of the baseline ..."""
TOLERANCE_THERMAL = 1.5
"""... and in shifts by warmth: the wall gives way, and chip and gas differ."""
SMOOTHING_S = 0.05
BELOW_MIN_NS = 350_000_000
"""Time below the baseline that counts: a released dome's gas is as warm as its wall after five
times 60 ms, and the smoothing."""
LEAK_ASYMMETRY = 0.08
"""Least deficit as a part of the excess, for a tile with gas correction: the longer a leak takes,
the more returns slowly enough to be read. For 30 ms it is a tenth."""
LEAK_ASYMMETRY_WITHOUT_GAS = 0.35
"""Same part without gas correction: the gas is cold after a release, in a fast hop a fifth."""
DEFICIT_MIN_KPA_S = 0.3
"""Least deficit that is evidence."""
FADING_S = 10.0
GAP_MAX_S = 0.5
"""Gap in the readings after which the low-pass starts again."""
NEVER_NS = -(1 << 62)


class BaselineLossState(KernelRecord):
    """State of a tile."""

    smoothed_kpa: float  # above the baseline; NaN before the first
    t_ns: int
    below_since_ns: int  # `NEVER_NS`: not below
    deepest_kpa: float  # below the baseline
    highest_kpa: float  # above the baseline
    excess_kpa_s: float  # integral above the baseline, fading
    deficit_kpa_s: float  # integral below the baseline, fading
    error_kpa: float


def initial_state(tiles: int) -> RecordArray[BaselineLossState]:
    """Make the states before the first reading, (tiles,)."""
    return BaselineLossState.array(tiles, smoothed_kpa=np.nan, below_since_ns=NEVER_NS)


@jit_cached
def update_baseline_error_bound_kpa(
    state: BaselineLossState,
    asymmetry: float,
    gauge_kpa: float,
    baseline_variance: float,
    thermal_drift_kpa: float,
    t_ns: int,
) -> float:
    """Update the state; return the bound of the baseline's error in kPa, 0 without evidence.

    Args:
        state: after the tile's readings before; updated.
        asymmetry: `LEAK_ASYMMETRY` or `LEAK_ASYMMETRY_WITHOUT_GAS`.
        gauge_kpa: pressure above the baseline with all corrections; NaN where unknown.
        baseline_variance: known variance of the baseline, in kPa squared.
        thermal_drift_kpa: shift by warmth that no model corrects.
        t_ns: instant.
    """
    if not math.isnan(gauge_kpa):
        step_s = max(0.0, (t_ns - state.t_ns) * 1e-9)
        if math.isnan(state.smoothed_kpa) or step_s > GAP_MAX_S:
            state.smoothed_kpa, state.below_since_ns, step_s = gauge_kpa, NEVER_NS, 0.0
        # Implicit steps: stable for any length, and without an exponential.
        state.smoothed_kpa += step_s / (SMOOTHING_S + step_s) * (gauge_kpa - state.smoothed_kpa)
        state.t_ns = t_ns
        bound = (
            ERROR_MIN_KPA
            + TOLERANCE_SIGMAS * math.sqrt(baseline_variance)
            + TOLERANCE_THERMAL * abs(thermal_drift_kpa)
        )
        fading = FADING_S / (FADING_S + step_s)
        state.excess_kpa_s *= fading
        state.deficit_kpa_s *= fading
        if state.smoothed_kpa >= -bound:
            state.below_since_ns = NEVER_NS
            if state.smoothed_kpa > bound:
                state.excess_kpa_s += step_s * state.smoothed_kpa
                state.highest_kpa = max(state.highest_kpa, state.smoothed_kpa)
        else:
            state.deepest_kpa = max(state.deepest_kpa, -state.smoothed_kpa)
            if state.smoothed_kpa < -bound - state.error_kpa:  # a dip, beyond the lasting shift
                state.deficit_kpa_s -= step_s * state.smoothed_kpa
            if state.below_since_ns == NEVER_NS:
                state.below_since_ns = state.t_ns
            if state.t_ns - state.below_since_ns > BELOW_MIN_NS:
                state.error_kpa = max(state.error_kpa, -state.smoothed_kpa)
            least = max(DEFICIT_MIN_KPA_S, asymmetry * state.excess_kpa_s)
            if state.deficit_kpa_s > least and state.highest_kpa > 0.0:
                # Then none of the excess is force.
                state.error_kpa = max(state.error_kpa, state.highest_kpa, state.deepest_kpa)
    return state.error_kpa
