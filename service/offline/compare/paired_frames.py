"""Our frames paired with the reference's values, in nearly independent trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit
from scipy.stats import bootstrap

from devices.arrays import Bools, Columns, Floats, Times
from service.estimation.stances import STANCE_INPUT_COLUMNS
from service.offline.accuracy import MIN_GRF_N
from service.offline.compare.alignment import ReferenceAlignment
from service.offline.compare.block_covariance import UncertainValue, compute_correlated_mean
from service.offline.compare.signals import ForceSignal, compute_robust_deviation

COMPARED_COLUMNS = ("seq", "t_ns", *STANCE_INPUT_COLUMNS, "cop_y_m", "cop_sigma_y_m")
"""Session columns that a comparison reads."""

CONTACT_SIGMAS = 5.0
"""Contact threshold of the reference, in sigma of its unloaded noise, as for our contact."""
FLIGHT_SETTLING_S = 0.02
"""Time from any contact after which a frame is in flight: averaging and most ringing have ended."""
MAX_SAME_RATE_RATIO = 1.05
"""Largest ratio of time steps that count as the same rate."""
MIN_FLIGHT_FRAMES = 50
"""Least number of flight frames to estimate the zero."""


@dataclass(frozen=True)
class ReferenceSignals:
    """Measurements of a reference, in SI units and with our signs.

    Attributes:
        force: vertical force of the ground on the foot.
        cop_m: (n, 2), COP in the foot frame; NaN where missing; None if there is none.
    """

    force: ForceSignal
    cop_m: Floats | None = None

    def interpolate_cop_m(self, t_s: Floats) -> Floats:
        """Interpolate the COP at times (m,), (m, 2); NaN unless both adjacent samples have it."""
        if self.cop_m is None:
            return np.full((len(t_s), 2), np.nan)
        known = self.force.is_known(t_s)
        both = [np.interp(t_s, self.force.t_s, column) for column in self.cop_m.T]
        return np.where(known[:, None], np.stack(both, axis=1), np.nan)


@dataclass(frozen=True)
class PairedFrames:
    """Our n frames at which the reference is known.

    Attributes:
        columns: our columns, `COMPARED_COLUMNS`.
        t_s: (n,), since the first frame of the session.
        reference_n: (n,), reference force, minus its zero if `is_zero_removed`.
        reference_cop_m: (n, 2), reference COP.
        reference_contact: (n,), True where the reference is loaded.
        contact_threshold_n: contact threshold of the reference above its zero.
        lag_sigma_n: (n,), force uncertainty due to the lag: rate of change times lag sigma.
        is_counted: (n,), frames that count: all; with a reference slower than ours, the nearest to
            each of its samples, so that no sample counts twice.
        reference_zero_n: reference reading in flight; None without a long enough flight.
        is_zero_removed: True if the zero is subtracted from `reference_n`.
    """

    columns: Columns
    t_s: Floats
    reference_n: Floats
    reference_cop_m: Floats
    reference_contact: Bools
    contact_threshold_n: float
    lag_sigma_n: Floats
    is_counted: Bools
    reference_zero_n: UncertainValue | None
    is_zero_removed: bool

    @property
    def remaining_zero_n(self) -> float:
        """Zero still contained in `reference_n`."""
        return (
            0.0
            if self.is_zero_removed or self.reference_zero_n is None
            else self.reference_zero_n.value
        )

    @property
    def error_n(self) -> Floats:
        """Our GRF minus the reference, (n,); NaN where our GRF is unknown."""
        return np.asarray(self.columns["grf_n"] - self.reference_n)


def seconds_since_first(t_ns: Times) -> Floats:
    """Convert times in ns to seconds since the first frame."""
    return np.asarray((t_ns - t_ns[0]) * 1e-9)


def pair_frames(
    columns: Columns,
    reference: ReferenceSignals,
    alignment: ReferenceAlignment,
    *,
    remove_offset: bool = False,
    contact_n: float | None = None,
) -> PairedFrames:
    """Interpolate the reference at the times of our frames.

    Args:
        columns: `COMPARED_COLUMNS` of a session, one value per frame.
        reference: measurements of the reference.
        alignment: alignment of both.
        remove_offset: subtract the reference's mean reading in flight.
        contact_n: contact threshold of the reference; None: `CONTACT_SIGMAS` times its noise in
            flight, at least `MIN_GRF_N`.
    """
    t_s = seconds_since_first(columns["t_ns"])
    to_s = alignment.to_reference_time_s(t_s)
    force = reference.force
    both_n = force.interpolate_force_n(to_s)
    zero_n, noise_n = _estimate_reference_zero(t_s, columns["contact"], both_n)
    level_n = 0.0 if zero_n is None else zero_n.value
    if contact_n is None:
        contact_n = max(MIN_GRF_N, CONTACT_SIGMAS * noise_n)
    there = np.isfinite(both_n)
    rate = np.gradient(force.force_n, force.t_s)
    lag_n = np.abs(np.interp(to_s, force.t_s, rate)) * alignment.compute_lag_sigma_s(t_s)
    return PairedFrames(
        columns={name: values[there] for name, values in columns.items()},
        t_s=t_s[there],
        reference_n=both_n[there] - (level_n if remove_offset else 0.0),
        reference_cop_m=reference.interpolate_cop_m(to_s[there]),
        reference_contact=both_n[there] - level_n > contact_n,
        contact_threshold_n=contact_n,
        lag_sigma_n=lag_n[there],
        is_counted=_select_nearest(to_s[there], force.t_s),
        reference_zero_n=zero_n,
        is_zero_removed=remove_offset and zero_n is not None,
    )


def _estimate_reference_zero(
    t_s: Floats, contact: npt.NDArray[np.uint8], reference_n: Floats
) -> tuple[UncertainValue | None, float]:
    """Estimate zero and noise of the reference from frames in which our foot is in flight."""
    loaded_s = t_s[contact != 0]
    flying = (contact == 0) & np.isfinite(reference_n)
    if len(loaded_s):
        after = np.searchsorted(loaded_s, t_s)
        behind_s = loaded_s[np.minimum(after, len(loaded_s) - 1)] - t_s
        before_s = t_s - loaded_s[np.maximum(after - 1, 0)]
        flying &= ~((np.abs(behind_s) < FLIGHT_SETTLING_S) | (np.abs(before_s) < FLIGHT_SETTLING_S))
    rows = np.flatnonzero(flying)
    if len(rows) < MIN_FLIGHT_FRAMES:
        return None, 0.0
    values_n = reference_n[rows]
    # Contacts that only the reference shows are not noise.
    middle_n = np.median(values_n)
    noise_n = compute_robust_deviation(values_n)
    quiet = np.abs(values_n - middle_n) <= max(CONTACT_SIGMAS * noise_n, MIN_GRF_N)
    if quiet.sum() < MIN_FLIGHT_FRAMES:
        return None, noise_n
    return compute_correlated_mean(values_n[quiet], np.arange(int(quiet.sum()))), noise_n


def _select_nearest(at_s: Floats, samples_s: Floats) -> Bools:
    """Select the times that count: all, or the nearest to each sample of a slower reference."""
    if len(at_s) < 2 or not (
        np.median(np.diff(samples_s)) > MAX_SAME_RATE_RATIO * np.median(np.diff(at_s))
    ):
        return np.ones(len(at_s), dtype=np.bool_)
    after = np.clip(np.searchsorted(at_s, samples_s), 1, len(at_s) - 1)
    nearer = np.where(samples_s - at_s[after - 1] < at_s[after] - samples_s, after - 1, after)
    inside = (samples_s >= at_s[0]) & (samples_s <= at_s[-1])
    judged = np.zeros(len(at_s), dtype=np.bool_)
    judged[nearer[inside]] = True
    return judged


MIN_BOOTSTRAP_TRIALS = 20
"""Least number of trials for a bootstrap interval; below, Student's t is used."""
RESAMPLES = 9999
_SEED = 0
_UPPER_95 = 0.975


@dataclass(frozen=True)
class TrialMarker:
    """Marker that begins a trial.

    Attributes:
        label: its text.
        t_ns: UTC of the nearest frame.
    """

    label: str
    t_ns: int


@dataclass(frozen=True)
class Trial:
    """Frames that are evaluated together.

    Attributes:
        name: name in tables.
        rows: (n,), mask of its frames.
    """

    name: str
    rows: Bools


@dataclass(frozen=True)
class TrialMean:
    """Mean of a figure over trials.

    Attributes:
        mean: mean over trials that have the figure.
        interval_95: 95 % interval of the mean; None with a single trial.
        trials: number of trials that have it.
        method: "t", "bootstrap" or "single".
    """

    mean: float
    interval_95: tuple[float, float] | None
    trials: int
    method: str


def split_into_trials(
    t_ns: Times, part: npt.NDArray[Any], markers: Sequence[TrialMarker]
) -> tuple[list[Trial], str]:
    """Split a session into trials; also return the definition of a trial.

    Each marker begins a trial that lasts until the next marker or the end; frames before the first
    marker are in none. Without markers, each contiguously recorded part is a trial.

    Args:
        t_ns: (n,), UTC of the frames.
        part: (n,), session part of the frames.
        markers: markers in any order.
    """
    if markers:
        ordered = sorted(markers, key=lambda marker: marker.t_ns)
        bounds = [marker.t_ns for marker in ordered] + [np.iinfo(np.int64).max]
        return [
            Trial(f"{i + 1}: {marker.label}", (t_ns >= bounds[i]) & (t_ns < bounds[i + 1]))
            for i, marker in enumerate(ordered)
        ], "from marker to marker"
    return [
        Trial(f"part {number}", part == number) for number in np.unique(part).tolist()
    ], "each contiguous recording"


def average_over_trials(values: Floats) -> TrialMean:
    """Compute the mean of a figure with its 95 % interval; trials with NaN do not count."""
    known = values[np.isfinite(values)]
    if len(known) < 2:
        mean = float(known[0]) if len(known) else float("nan")
        return TrialMean(mean, None, len(known), "single")
    mean = float(known.mean())
    if len(known) < MIN_BOOTSTRAP_TRIALS or np.ptp(known) == 0.0:
        half = stdtrit(len(known) - 1, _UPPER_95) * known.std(ddof=1) / np.sqrt(len(known))
        return TrialMean(mean, (mean - float(half), mean + float(half)), len(known), "t")
    found = bootstrap((known,), np.mean, n_resamples=RESAMPLES, rng=np.random.default_rng(_SEED))
    low, high = found.confidence_interval
    return TrialMean(mean, (float(low), float(high)), len(known), "bootstrap")
