"""Trials, the nearly independent units of a comparison, and means over trials with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit
from scipy.stats import bootstrap

from devices.arrays import Bools, Floats, Times

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
