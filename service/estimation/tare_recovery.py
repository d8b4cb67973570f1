"""Recovery of the rubber in a tare: for seconds after a load an unloaded dome reads too much.

A tare between two steps would take the rest of the last load for baseline, and every later force
would be too small. The models know that rest: they estimate it with the tare as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from devices.frames import ArrayInfo, FrameBatch
from service.estimation import LIVE_LAG_MS
from service.estimation.calibration import Calibration
from service.estimation.estimate import ModelEstimator
from service.estimation.pipeline.plan import make_plan
from service.estimation.tare.automatic import HISTORY_NS
from service.estimation.tare.tare import Tare

RECOVERY_UNCERTAINTY = 0.5
"""Uncertain part of the removed pressure: the models' own misfit, and loads before the history."""


def remove_recovery(
    tare: Tare,
    frames: FrameBatch,
    *,
    info: ArrayInfo,
    calibration: Calibration,
    models: Sequence[str],
) -> Tare:
    """Return a tare without the pressure that earlier loads have left in its interval.

    With the tare as it is, the models estimate less than 0 N on the unloaded domes: less by what
    loop and creep of the last loads still press. The curve's slope at zero makes this a pressure.

    Args:
        tare: from an interval of these frames.
        frames: the interval and `HISTORY_NS` before it, or more; without frames before the interval
            the tare is returned unchanged.
        info: the array.
        calibration: of its tiles.
        models: of the estimate; without loop and creep nothing is removed.

    Returns:
        The tare with lower baselines of load-bearing tiles, and with larger uncertainties.
    """
    begin_t_ns = tare.t_ns - round((tare.end_s - tare.begin_s) * 1e9)
    first = int(np.searchsorted(frames.t_ns, begin_t_ns - HISTORY_NS))
    begin = int(np.searchsorted(frames.t_ns, begin_t_ns))
    if begin == first:  # no load is known before it
        return tare
    end = int(np.searchsorted(frames.t_ns, tare.t_ns, side="right"))
    plan = make_plan(info, calibration, tare, models=models, lag_ms=LIVE_LAG_MS)
    estimator = ModelEstimator(plan)
    due = estimator.process_frames(frames.slice_rows(first, end))
    last = estimator.finish()
    force_n = due.force_n if last is None else np.concatenate([due.force_n, last.force_n])
    columns = plan.load_bearing_columns
    force_n = force_n[begin - first :, columns]
    known = np.isfinite(force_n)
    left_n = np.where(known, force_n, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    baseline_kpa, sigma_kpa = tare.baseline_kpa.copy(), tare.baseline_sigma_kpa.copy()
    slope_n_per_kpa = (
        plan.load_bearing_params["mount_gain"] * plan.curves["slope_at_zero_n_per_kpa"]
    )
    shift_kpa = left_n / slope_n_per_kpa
    baseline_kpa[columns] += shift_kpa
    sigma_kpa[columns] = np.hypot(sigma_kpa[columns], RECOVERY_UNCERTAINTY * np.abs(shift_kpa))
    return replace(tare, baseline_kpa=baseline_kpa, baseline_sigma_kpa=sigma_kpa)
