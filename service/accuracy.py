"""How far an estimate is from the truth of an emulated scene, counted as the design says.

Error is estimate minus truth at the same `t_ns`. The figures come from an emulated foot; the
paper's (GRF within 1 N, COP within 4 mm) come from a real one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.estimation.estimates import EstimateStatus

Floats = npt.NDArray[np.float64]

JUDGED = (
    "t_ns",
    "grf_n",
    "grf_sigma_n",
    "cop_x_m",
    "cop_y_m",
    "cop_sigma_x_m",
    "estimate_status",
    "true_grf_n",
    "true_cop_x_m",
    "true_cop_y_m",
)
"""Columns that `judge` needs."""

GRF_FROM_N = 0.5
COP_FROM_N = 3.0
STANCE_MIN_NS = 50_000_000
INTERVAL_95 = 1.96


@dataclass(frozen=True)
class Accuracy:
    """Errors of one recording. NaN where there is nothing to judge.

    GRF: frames with more than 0.5 N of truth and no saturated or missing tile. COP: frames with
    more than 3 N of truth in which it is stated. Flight: frames without any load.
    """

    frames: int
    grf_frames: int
    grf_mae_n: float
    grf_rms_n: float
    grf_bias_n: float
    grf_coverage_95: float
    """Part of the GRF frames whose truth lies within 1.96 sigma."""
    grf_sigma_median_n: float
    flight_mean_n: float
    peak_error_n: float
    """Mean over stances of |estimated peak - true peak|."""
    impulse_error_ns: float
    """Mean over stances of |estimated impulse - true impulse|, in newton seconds."""
    stances: int
    cop_frames: int
    cop_mean_m: float
    cop_p95_m: float
    cop_coverage_95: float
    """Part of the COP frames whose true x lies within 1.96 sigma."""
    cop_masked_frames: int
    """Frames with more than 3 N of truth in which no COP is stated."""
    saturated_frames: int

    def as_dict(self) -> dict[str, float | int | None]:
        """For JSON: what is not finite is null."""
        return {n: value if math.isfinite(value) else None for n, value in asdict(self).items()}


def judge(c: Mapping[str, npt.NDArray[Any]]) -> Accuracy:
    """Compare estimates with truth.

    Args:
        c: the columns `JUDGED`, one value per frame.
    """
    true_n, error_n = c["true_grf_n"], c["grf_n"] - c["true_grf_n"]
    saturated = (c["estimate_status"] & EstimateStatus.SATURATED) != 0
    judged = (true_n > GRF_FROM_N) & ~saturated & np.isfinite(error_n)
    heavy = true_n > COP_FROM_N
    stated = heavy & np.isfinite(c["cop_x_m"])
    off_m = np.hypot(
        c["cop_x_m"][stated] - c["true_cop_x_m"][stated],
        c["cop_y_m"][stated] - c["true_cop_y_m"][stated],
    )
    within = np.abs(error_n[judged]) <= INTERVAL_95 * c["grf_sigma_n"][judged]
    within_x = (
        np.abs(c["cop_x_m"][stated] - c["true_cop_x_m"][stated])
        <= INTERVAL_95 * c["cop_sigma_x_m"][stated]
    )
    peaks_n, impulses_ns = _stances(c["t_ns"], true_n, c["grf_n"])
    flight = error_n[(true_n == 0.0) & np.isfinite(error_n)]
    return Accuracy(
        frames=len(true_n),
        grf_frames=int(judged.sum()),
        grf_mae_n=_mean(np.abs(error_n[judged])),
        grf_rms_n=float(np.sqrt(_mean(error_n[judged] ** 2))),
        grf_bias_n=_mean(error_n[judged]),
        grf_coverage_95=_mean(within),
        grf_sigma_median_n=float(np.median(c["grf_sigma_n"][judged])) if judged.any() else np.nan,
        flight_mean_n=_mean(flight),
        peak_error_n=_mean(np.abs(peaks_n)),
        impulse_error_ns=_mean(np.abs(impulses_ns)),
        stances=len(peaks_n),
        cop_frames=int(stated.sum()),
        cop_mean_m=_mean(off_m),
        cop_p95_m=float(np.percentile(off_m, 95)) if len(off_m) else np.nan,
        cop_coverage_95=_mean(within_x),
        cop_masked_frames=int((heavy & ~stated).sum()),
        saturated_frames=int(saturated.sum()),
    )


def _stances(t_ns: Floats, true_n: Floats, grf_n: Floats) -> tuple[Floats, Floats]:
    """Errors of peak and impulse of every stance: a stretch of truth above `GRF_FROM_N`."""
    loaded = np.concatenate([[False], true_n > GRF_FROM_N, [False]])
    begins = np.flatnonzero(~loaded[:-1] & loaded[1:])
    ends = np.flatnonzero(loaded[:-1] & ~loaded[1:])
    peaks, impulses = [], []
    for begin, end in zip(begins, ends, strict=True):
        rows = slice(begin, end)
        if t_ns[end - 1] - t_ns[begin] < STANCE_MIN_NS or not np.isfinite(grf_n[rows]).all():
            continue
        peaks.append(grf_n[rows].max() - true_n[rows].max())
        t_s = (t_ns[rows] - t_ns[begin]) * 1e-9
        impulses.append(np.trapezoid(grf_n[rows] - true_n[rows], t_s))
    return np.array(peaks), np.array(impulses)


def _mean(values: npt.NDArray[Any]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
