"""Errors against a reference: GRF, stances, COP and coverage, by trial and over trials.

Error is ours minus reference. Frames count while the reference is loaded and our GRF is known.
Phases and coverage are defined as in `service.offline.accuracy`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats
from devices.errors import ComparisonError
from service.estimation.records import SIGMAS_95
from service.estimation.stances import Stance, compute_stances
from service.offline.accuracy import PHASES, CoverageCount, classify_phases
from service.offline.compare.paired_frames import (
    PairedFrames,
    Trial,
    TrialMean,
    average_over_trials,
)

STANCE_MARGIN_NS = 50_000_000
"""Window beyond our stance in which the reference may land earlier or lift off later."""


@dataclass(frozen=True)
class StanceError:
    """Errors of one stance that both recorded completely; ours minus reference.

    Attributes:
        number: index of the stance in the session.
        t_ns: UTC of its first frame.
        peak_n: error of the greatest GRF.
        impulse_n_s: error of the impulse.
        contact_s: error of the contact time: both cross the same force upwards.
        lift_off_s: error of the lift-off time, likewise downwards.
    """

    number: int
    t_ns: int
    peak_n: float
    impulse_n_s: float
    contact_s: float
    lift_off_s: float


@dataclass(frozen=True)
class PhaseError:
    """Errors in one phase: number of frames, mean error, mean absolute error, coverage."""

    frames: int
    bias_n: float
    mae_n: float
    covered: CoverageCount | None


@dataclass(frozen=True)
class TrialErrors:
    """Errors of one trial.

    Attributes:
        name: name of the trial.
        figures: by name, as in docs/compare.md; NaN where there is nothing to judge.
        limits_of_agreement_n: bias minus and plus 1.96 standard deviations of the error.
        phases: errors by name of the phase.
        stances: errors of comparable stances.
        stances_left_out: number of our stances that are not comparable: cut by the end of trial
            or recording, with unknown frames, or not in the reference.
        cop_frames: number of frames with a COP by ours, by the reference, and by both.
    """

    name: str
    figures: Mapping[str, float]
    limits_of_agreement_n: tuple[float, float]
    phases: Mapping[str, PhaseError]
    stances: tuple[StanceError, ...]
    stances_left_out: int
    cop_frames: Mapping[str, int]


@dataclass(frozen=True)
class ComparisonErrors:
    """Errors of all trials, and each figure over them."""

    trials: tuple[TrialErrors, ...]
    figures: Mapping[str, TrialMean]


def compute_errors(
    pairs: PairedFrames,
    trials: Sequence[Trial],
    *,
    reference_sigma_n: float | None = None,
    reference_cop_sigma_m: float | None = None,
) -> ComparisonErrors:
    """Compute the errors of every trial.

    Args:
        pairs: frames of ours with the reference.
        trials: rows of `pairs`.
        reference_sigma_n: standard uncertainty of the reference force; None: unknown, so
            coverage is not computed.
        reference_cop_sigma_m: standard uncertainty of each coordinate of its COP, likewise.

    Raises:
        ComparisonError: no trial has a frame.
    """
    within = None if reference_sigma_n is None else _is_within_interval(pairs, reference_sigma_n)
    phases = classify_phases(
        pairs.columns["t_ns"], np.where(pairs.reference_contact, pairs.reference_n, 0.0)
    )
    stances = compute_stances(pairs.columns["seq"], pairs.columns["t_ns"], pairs.columns)
    judged = tuple(
        _compute_trial_errors(pairs, trial, phases, within, stances, reference_cop_sigma_m)
        for trial in trials
        if trial.rows.any()
    )
    if not judged:
        raise ComparisonError(
            "no trial has a frame at which the reference is known",
            expected="markers within what reference and session have in common",
        )
    names = judged[0].figures
    figures = {
        name: average_over_trials(np.array([one.figures[name] for one in judged])) for name in names
    }
    return ComparisonErrors(judged, figures)


def _is_within_interval(pairs: PairedFrames, reference_sigma_n: float) -> Bools:
    """Return where the error is within 1.96 sigma of our force, the reference and the lag."""
    variance = pairs.columns["grf_sigma_n"] ** 2 + reference_sigma_n**2 + pairs.lag_sigma_n**2
    return np.asarray(np.abs(pairs.error_n) <= SIGMAS_95 * np.sqrt(variance))


def _compute_trial_errors(
    pairs: PairedFrames,
    trial: Trial,
    phases: npt.NDArray[np.intp],
    within: Bools | None,
    stances: Sequence[Stance],
    reference_cop_sigma_m: float | None,
) -> TrialErrors:
    rows = trial.rows & pairs.is_counted & np.isfinite(pairs.error_n)
    loaded = rows & pairs.reference_contact
    error_n, reference_n = pairs.error_n[loaded], pairs.reference_n[loaded]
    bias_n, spread_n = _mean(error_n), float(np.std(error_n)) if len(error_n) else math.nan
    compared, left_out = _compute_stance_errors(pairs, trial.rows, stances)
    cop, cop_frames = _compute_cop_errors(
        pairs, trial.rows & pairs.is_counted, reference_cop_sigma_m
    )
    scatter = float(((reference_n - reference_n.mean()) ** 2).sum()) if len(error_n) else 0.0
    figures = {
        "grf_frames": float(len(error_n)),
        "grf_bias_n": bias_n,
        "grf_mae_n": _mean(np.abs(error_n)),
        "grf_rmse_n": math.sqrt(_mean(error_n**2)),
        "grf_r2": 1.0 - float((error_n**2).sum()) / scatter if scatter > 0.0 else math.nan,
        "grf_coverage_95": math.nan if within is None else _mean(within[loaded]),
        "grf_lag_n": math.sqrt(_mean(pairs.lag_sigma_n[loaded] ** 2)),
        "stances": float(len(compared)),
        "peak_bias_n": _mean(np.array([one.peak_n for one in compared])),
        "peak_mae_n": _mean(np.abs([one.peak_n for one in compared])),
        "impulse_bias_n_s": _mean(np.array([one.impulse_n_s for one in compared])),
        "impulse_mae_n_s": _mean(np.abs([one.impulse_n_s for one in compared])),
        "contact_bias_s": _mean(np.array([one.contact_s for one in compared])),
        "contact_mae_s": _mean(np.abs([one.contact_s for one in compared])),
        "lift_off_bias_s": _mean(np.array([one.lift_off_s for one in compared])),
        "lift_off_mae_s": _mean(np.abs([one.lift_off_s for one in compared])),
        **cop,
    }
    by_phase = {}
    for i, name in enumerate(PHASES):
        of_phase = rows & (phases == i)
        # In flight the true force is zero: the rest is the reference's own offset.
        off_n = pairs.error_n[of_phase]
        covered = None
        if within is not None:
            covered = CoverageCount(int(of_phase.sum()), int((of_phase & within).sum()))
        by_phase[name] = PhaseError(len(off_n), _mean(off_n), _mean(np.abs(off_n)), covered)
    half_n = SIGMAS_95 * spread_n
    return TrialErrors(
        name=trial.name,
        figures=figures,
        limits_of_agreement_n=(bias_n - half_n, bias_n + half_n),
        phases=by_phase,
        stances=tuple(compared),
        stances_left_out=left_out,
        cop_frames=cop_frames,
    )


def _compute_stance_errors(
    pairs: PairedFrames, rows: Bools, stances: Sequence[Stance]
) -> tuple[list[StanceError], int]:
    """Compute errors of stances that begin in `rows`; also count those not comparable."""
    t_ns, error_n = pairs.columns["t_ns"], pairs.error_n
    compared, left_out = [], 0
    for i, stance in enumerate(stances):
        first = int(np.searchsorted(t_ns, stance.begin_t_ns))
        if not rows[first]:
            continue
        # At most half way to the adjacent stances.
        before_ns = stances[i - 1].end_t_ns if i else stance.begin_t_ns - 2 * STANCE_MARGIN_NS
        last = i == len(stances) - 1
        behind_ns = stance.end_t_ns + 2 * STANCE_MARGIN_NS if last else stances[i + 1].begin_t_ns
        begin_ns = stance.begin_t_ns - min(STANCE_MARGIN_NS, (stance.begin_t_ns - before_ns) // 2)
        end_ns = stance.end_t_ns + min(STANCE_MARGIN_NS, (behind_ns - stance.end_t_ns) // 2)
        window = slice(
            int(np.searchsorted(t_ns, begin_ns)), int(np.searchsorted(t_ns, end_ns, side="right"))
        )
        whole = stance.is_whole and rows[window].all() and np.isfinite(error_n[window]).all()
        crossed = _compute_crossing_delays_s(pairs, window) if whole else None
        if crossed is None:
            left_out += 1
            continue
        t_s = pairs.t_s[window]
        compared.append(
            StanceError(
                number=stance.number,
                t_ns=stance.begin_t_ns,
                peak_n=float(
                    pairs.columns["grf_n"][window].max() - pairs.reference_n[window].max()
                ),
                impulse_n_s=float(np.trapezoid(error_n[window], t_s)),
                contact_s=crossed[0],
                lift_off_s=crossed[1],
            )
        )
    return compared, left_out


def _compute_crossing_delays_s(pairs: PairedFrames, window: slice) -> tuple[float, float] | None:
    """Return our delay in s at crossing the contact force, up and down; None without a crossing."""
    t_s, found = pairs.t_s[window], []
    for force_n in (
        pairs.columns["grf_n"][window],
        pairs.reference_n[window] - pairs.remaining_zero_n,
    ):
        over = force_n - pairs.contact_threshold_n
        above = np.flatnonzero(over > 0.0)
        if not len(above) or above[0] == 0 or above[-1] == len(over) - 1:
            return None
        for i in (int(above[0]) - 1, int(above[-1])):
            part = over[i] / (over[i] - over[i + 1])
            found.append(float(t_s[i] + part * (t_s[i + 1] - t_s[i])))
    return found[0] - found[2], found[1] - found[3]


def _compute_cop_errors(
    pairs: PairedFrames, rows: Bools, reference_sigma_m: float | None
) -> tuple[dict[str, float], dict[str, int]]:
    """Compute COP errors where both have contact and a COP; also the frame counts.

    Only axes that our tiles measure count: tiles in one row measure one, a single tile none.
    """
    ours, sigma_m = (
        np.stack([pairs.columns[f"{name}_{axis}_m"] for axis in "xy"], axis=1)
        for name in ("cop", "cop_sigma")
    )
    measured = (sigma_m[rows] > 0.0).any(axis=0)
    by_ours = rows & (pairs.columns["contact"] == 1) & measured.any()
    by_ours &= np.isfinite(ours[:, measured]).all(axis=1)
    known = np.isfinite(pairs.reference_cop_m)
    axes = known[rows].any(axis=0)  # a treadmill has one axis only
    by_reference = rows & pairs.reference_contact & known[:, axes].all(axis=1) & axes.any()
    both = by_ours & by_reference
    off_m = np.where(measured, ours - pairs.reference_cop_m, np.nan)[both]
    mean_m = off_m.mean(axis=0) if len(off_m) else np.full(2, np.nan)
    distance_m = np.hypot(*np.where(measured, off_m, 0.0).T)
    about_mean_m = np.hypot(*np.where(measured, off_m - mean_m, 0.0).T)
    figures = {
        "cop_mean_m": _mean(distance_m),
        "cop_p95_m": _p95(distance_m),
        "cop_bias_x_m": float(mean_m[0]),
        "cop_bias_y_m": float(mean_m[1]),
        "cop_p95_about_mean_m": _p95(about_mean_m),
    }
    most_m = SIGMAS_95 * np.hypot(sigma_m[both].astype(np.float64), reference_sigma_m or 0.0)
    for axis, off, most in zip("xy", off_m.T, most_m.T, strict=True):
        has_sigma = reference_sigma_m is not None and np.isfinite(off).any()
        figures[f"cop_coverage_{axis}_95"] = _mean(np.abs(off) <= most) if has_sigma else math.nan
    counts = {"ours": by_ours, "reference": by_reference, "both": both}
    return figures, {name: int(which.sum()) for name, which in counts.items()}


def _mean(values: Floats | Bools) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _p95(values: Floats) -> float:
    return float(np.percentile(values, 95)) if len(values) else math.nan
