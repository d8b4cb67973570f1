"""Lost baselines: a dome that has leaked, or one whose baseline has moved for an unknown reason.

No load makes a dome read less than without load. If it stays below its baseline by more than
temperature, surroundings and the gas of a released dome explain, then gas is missing, or the gas is
colder than its chip. The largest such reading bounds the error of the baseline.

A leak so fast that air returns within a moment shows as well: air that leaks out under load has to
return, so the tile reads too little afterwards as much as it has read too much. A sealed dome
hardly reads too little at all.

A tile that permanently reads too much cannot be told from a loaded one.

Thermal drift is the shift of the baseline by warmth. Without the model `temperature` the drift is
all error, and all tiles err to the same side. The gas follows its chip within seconds, so the
larger shift counts: the chip's, or its low-pass.
"""

from __future__ import annotations

import math

import numpy as np

from devices.frames import NOT_READ
from devices.jit import jit_cached
from service.estimation.records import KernelRecord

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
CHIP_SMOOTHING_S = 0.5  # long against the noise of half a count
GAS_LAG_S = 5.0  # of the gas behind its chip, at most


class BaselineLossState(KernelRecord):
    """State of a tile."""

    smoothed_kpa: float = np.nan  # above the baseline; NaN before the first
    t_ns: int
    below_since_ns: int = NEVER_NS  # `NEVER_NS`: not below
    deepest_kpa: float  # below the baseline
    highest_kpa: float  # above the baseline
    excess_kpa_s: float  # integral above the baseline, fading
    deficit_kpa_s: float  # integral below the baseline, fading
    error_kpa: float


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


class ThermalDriftState(KernelRecord):
    """State of a tile: counts from the tare's, low-passed; NaN before the first reading."""

    chip_counts: float = np.nan
    gas_counts: float = np.nan
    t_ns: int


@jit_cached
def update_thermal_drift_kpa(
    state: ThermalDriftState,
    temperature_raw: int,
    tare_counts: float,
    kpa_per_count: float,
    t_ns: int,
) -> float:
    """Update the state; return the baseline's signed drift by warmth in kPa, 0 where unknown.

    Args:
        state: after the tile's readings before; updated.
        temperature_raw: counts; `NOT_READ` where unknown.
        tare_counts: at the tare, NaN where unknown.
        kpa_per_count: shift of the baseline for a count.
        t_ns: instant.
    """
    now = temperature_raw - tare_counts
    if temperature_raw != NOT_READ and not math.isnan(now):
        if math.isnan(state.chip_counts):
            state.chip_counts = state.gas_counts = now
        else:
            step_s = max(0.0, (t_ns - state.t_ns) * 1e-9)
            state.chip_counts += step_s / (CHIP_SMOOTHING_S + step_s) * (now - state.chip_counts)
            state.gas_counts += (
                step_s / (GAS_LAG_S + step_s) * (state.chip_counts - state.gas_counts)
            )
        state.t_ns = t_ns
    more = state.chip_counts if abs(state.chip_counts) > abs(state.gas_counts) else state.gas_counts
    return 0.0 if math.isnan(more) else kpa_per_count * more
