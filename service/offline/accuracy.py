"""Errors of an estimate against the truth of an emulated scene.

Error is estimate minus truth at the same `t_ns`. The figures come from an emulated foot; the
paper's (GRF within 1 N, COP within 4 mm) come from a real one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats, Times
from devices.flags import EstimateFlag
from service.estimation.records import SIGMAS_95

ACCURACY_COLUMNS = (
    "t_ns",
    "grf_n",
    "grf_sigma_n",
    "grf_lower_bound_n",
    "cop_x_m",
    "cop_y_m",
    "cop_sigma_x_m",
    "estimate_flags",
    "true_grf_n",
    "true_cop_x_m",
    "true_cop_y_m",
)
"""Columns that `compute_accuracy` needs."""

MIN_GRF_N = 0.5
MIN_COP_GRF_N = 3.0
MIN_STANCE_NS = 50_000_000
STEEP_PEAKS_PER_DURATION = 2.0
"""Slope of the true force, in stance peaks per stance duration, above which a frame is loading or
unloading; for a half sine these are the outer 28 % on each side."""
PHASES = ("flight", "loading", "mid_stance", "unloading")


@dataclass(frozen=True)
class CoverageCount:
    """Counts of one phase: frames, and frames with the truth within 1.96 sigma.

    As counts, so that recordings can be pooled by addition.
    """

    frames: int
    within: int

    @property
    def share(self) -> float:
        """Fraction within 1.96 sigma; NaN without frames."""
        return self.within / self.frames if self.frames else math.nan

    def __add__(self, other: CoverageCount) -> CoverageCount:
        return CoverageCount(self.frames + other.frames, self.within + other.within)

    def as_dict(self) -> dict[str, float]:
        """Return the content that `service.json_output.to_json_value` converts."""
        return {"frames": self.frames, "within": self.within, "coverage_95": self.share}


@dataclass(frozen=True)
class Accuracy:
    """Errors of one recording; NaN where no frame qualifies.

    GRF: frames with a true GRF above 0.5 N and no saturated or missing tile. COP: frames with a
    true GRF above 3 N and a COP, on the axes that the tiles measure. Flight: frames without any
    load. `grf_phases`: all frames without a saturated or missing tile, by phase of the true force.
    """

    frames: int
    grf_frames: int
    grf_mae_n: float
    grf_rms_n: float
    grf_bias_n: float
    grf_coverage_95: float
    """Fraction of the GRF frames with the truth within 1.96 sigma."""
    grf_sigma_median_n: float
    grf_sigma_mid_stance_n: float
    """Median of sigma in mid-stance."""
    grf_published_mae_n: float
    """Mean absolute error against the truth at the time of publication, one look-ahead after the
    frame; over the GRF frames whose time of publication is recorded."""
    grf_phases: Mapping[str, CoverageCount]
    """Coverage in each of `PHASES`."""
    flight_mean_n: float
    flight_mae_n: float
    peak_error_n: float
    """Mean over stances of |estimated peak - true peak|."""
    impulse_error_ns: float
    """Mean over stances of |estimated impulse - true impulse|, in newton seconds."""
    stances: int
    cop_frames: int
    cop_mean_m: float
    cop_p95_m: float
    cop_coverage_95: float
    """Fraction of the COP frames with the true x within 1.96 sigma."""
    cop_covered: CoverageCount
    """Counts behind `cop_coverage_95`."""
    cop_masked_frames: int
    """Frames with a true GRF above 3 N but without a COP."""
    cop_masked_share: float
    """Fraction of these among all frames with a true GRF above 3 N."""
    saturated_frames: int
    bounds: CoverageCount
    """Frames with a lower bound instead of a GRF, and how many have the truth above it."""
    after_saturation_mae_n: float
    """Mean absolute GRF error in usable frames after saturation, which count in the figures above
    too."""
    after_saturation: CoverageCount
    """Frames after saturation, and how many have the truth within 1.96 sigma."""


def compute_accuracy(columns: Mapping[str, npt.NDArray[Any]], *, lag_ms: float = 0.0) -> Accuracy:
    """Compute the errors of estimates against the truth.

    Args:
        columns: `ACCURACY_COLUMNS`, one value per frame, at least one.
        lag_ms: look-ahead of the estimates, the delay from frame to publication.
    """
    true_n, error_n = columns["true_grf_n"], columns["grf_n"] - columns["true_grf_n"]
    saturated = (columns["estimate_flags"] & EstimateFlag.SATURATED) != 0
    usable = ~saturated & np.isfinite(error_n)
    at_least_n = columns["grf_lower_bound_n"]
    bounded = np.isnan(columns["grf_n"]) & np.isfinite(at_least_n)
    after = usable & ((columns["estimate_flags"] & EstimateFlag.AFTER_SATURATION) != 0)
    judged = (true_n > MIN_GRF_N) & usable
    heavy = true_n > MIN_COP_GRF_N
    cop_m, true_m = (
        np.stack([columns[f"{source}cop_{axis}_m"] for axis in "xy"]) for source in ("", "true_")
    )
    measured = np.isfinite(cop_m).any(axis=1)  # across a row of tiles nothing is
    stated = heavy & np.isfinite(cop_m[measured]).all(axis=0) & measured.any()
    off_m = np.hypot(*np.where(measured[:, None], cop_m - true_m, 0.0)[:, stated])
    within = np.abs(error_n[judged]) <= SIGMAS_95 * columns["grf_sigma_n"][judged]
    stated_x = stated & measured[0]
    within_x = (
        np.abs(cop_m[0] - true_m[0])[stated_x] <= SIGMAS_95 * columns["cop_sigma_x_m"][stated_x]
    )
    peaks_n, impulses_ns = _compute_stance_errors(columns["t_ns"], true_n, columns["grf_n"])
    flight = error_n[(true_n == 0.0) & np.isfinite(error_n)]
    phases = classify_phases(columns["t_ns"], true_n)
    covered = np.abs(error_n) <= SIGMAS_95 * columns["grf_sigma_n"]
    steady = usable & (phases == PHASES.index("mid_stance"))
    cop_masked = int((heavy & ~stated).sum())
    return Accuracy(
        frames=len(true_n),
        grf_frames=int(judged.sum()),
        grf_mae_n=_mean(np.abs(error_n[judged])),
        grf_rms_n=float(np.sqrt(_mean(error_n[judged] ** 2))),
        grf_bias_n=_mean(error_n[judged]),
        grf_coverage_95=_mean(within),
        grf_sigma_median_n=_median(columns["grf_sigma_n"][judged]),
        grf_sigma_mid_stance_n=_median(columns["grf_sigma_n"][steady]),
        grf_published_mae_n=_mean(_compute_published_error_n(columns, round(lag_ms * 1e6), judged)),
        grf_phases={
            name: CoverageCount(int(rows.sum()), int((rows & covered).sum()))
            for i, name in enumerate(PHASES)
            for rows in (usable & (phases == i),)
        },
        flight_mean_n=_mean(flight),
        flight_mae_n=_mean(np.abs(flight)),
        peak_error_n=_mean(np.abs(peaks_n)),
        impulse_error_ns=_mean(np.abs(impulses_ns)),
        stances=len(peaks_n),
        cop_frames=int(stated.sum()),
        cop_mean_m=_mean(off_m),
        cop_p95_m=float(np.percentile(off_m, 95)) if len(off_m) else np.nan,
        cop_coverage_95=_mean(within_x),
        cop_covered=CoverageCount(len(within_x), int(within_x.sum())),
        cop_masked_frames=cop_masked,
        cop_masked_share=cop_masked / int(heavy.sum()) if heavy.any() else math.nan,
        saturated_frames=int(saturated.sum()),
        bounds=CoverageCount(int(bounded.sum()), int((bounded & (true_n >= at_least_n)).sum())),
        after_saturation_mae_n=_mean(np.abs(error_n[after])),
        after_saturation=CoverageCount(int(after.sum()), int((after & covered).sum())),
    )


def classify_phases(t_ns: Times, true_grf_n: Floats) -> npt.NDArray[np.intp]:
    """Return every frame's index into `PHASES`, by the true force alone.

    Flight: the true force is exactly zero. Each interval between two flights is classified by its
    own peak and duration; see `STEEP_PEAKS_PER_DURATION`.
    """
    phases = np.full(len(true_grf_n), PHASES.index("flight"))
    t_s = (t_ns - t_ns[0]) * 1e-9
    for begin, end in _find_runs(true_grf_n != 0.0):
        # With a frame of flight on each side, so that short contacts have a slope.
        first, last = max(begin - 1, 0), min(end + 1, len(true_grf_n))
        inner = slice(begin - first, end - first)
        duration_s = t_s[last - 1] - t_s[first]
        if duration_s == 0.0:
            phases[begin:end] = PHASES.index("mid_stance")
            continue
        rate = np.gradient(true_grf_n[first:last], t_s[first:last])[inner]
        steep = STEEP_PEAKS_PER_DURATION * np.abs(true_grf_n[begin:end]).max() / duration_s
        phases[begin:end] = np.select(
            [rate > steep, rate < -steep],
            [PHASES.index("loading"), PHASES.index("unloading")],
            PHASES.index("mid_stance"),
        )
    return phases


def _compute_published_error_n(
    columns: Mapping[str, npt.NDArray[Any]], lag_ns: int, rows: Bools
) -> Floats:
    # From the first frame: float64 cannot represent nanoseconds since 1970.
    since_ns = (columns["t_ns"] - columns["t_ns"][0]).astype(np.float64)
    published_ns = since_ns[rows] + lag_ns
    seen = published_ns <= since_ns[-1]
    then_n = np.interp(published_ns[seen], since_ns, columns["true_grf_n"])
    return np.asarray(np.abs(columns["grf_n"][rows][seen] - then_n))


def _compute_stance_errors(t_ns: Floats, true_n: Floats, grf_n: Floats) -> tuple[Floats, Floats]:
    """Compute peak and impulse errors of every stance, where the truth is above `MIN_GRF_N`."""
    peaks, impulses = [], []
    for begin, end in _find_runs(true_n > MIN_GRF_N):
        rows = slice(begin, end)
        if t_ns[end - 1] - t_ns[begin] < MIN_STANCE_NS or not np.isfinite(grf_n[rows]).all():
            continue
        peaks.append(grf_n[rows].max() - true_n[rows].max())
        t_s = (t_ns[rows] - t_ns[begin]) * 1e-9
        impulses.append(np.trapezoid(grf_n[rows] - true_n[rows], t_s))
    return np.array(peaks), np.array(impulses)


def _find_runs(rows: Bools) -> list[tuple[int, int]]:
    """Return first row and end row (exclusive) of every run of True."""
    edges = np.flatnonzero(np.diff(rows, prepend=False, append=False)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _mean(values: npt.NDArray[Any]) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _median(values: Floats) -> float:
    return float(np.median(values)) if len(values) else math.nan
