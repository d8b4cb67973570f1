"""Trials: what is as good as independent of one another, and means over them with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit
from scipy.stats import bootstrap

from devices.arrays import Bools, Floats, Times

BOOTSTRAP_FROM = 20
"""From so many trials on their own distribution is taken, below that Student's t."""
RESAMPLES = 9999
_SEED = 0
_UPPER_95 = 0.975


@dataclass(frozen=True)
class Mark:
    """Something a person marked.

    Attributes:
        label: what they wrote.
        t_ns: UTC of the frame nearest to it.
    """

    label: str
    t_ns: int


@dataclass(frozen=True)
class Trial:
    """Frames that are judged together.

    Attributes:
        name: for tables.
        rows: (n,), which frames.
    """

    name: str
    rows: Bools


@dataclass(frozen=True)
class OverTrials:
    """A figure over trials.

    Attributes:
        mean: of those that have it.
        interval_95: of that mean; None with a single trial, which has no spread.
        trials: how many have it.
        method: "t", "bootstrap" or "single".
    """

    mean: float
    interval_95: tuple[float, float] | None
    trials: int
    method: str


def trials_of(
    t_ns: Times, part: npt.NDArray[Any], marks: Sequence[Mark]
) -> tuple[list[Trial], str]:
    """Trials of a session, and what they are.

    Marks cut it: each begins a trial that lasts until the next one, or the end; what is before the
    first is in none. Without marks each part that was recorded without a break is one.

    Args:
        t_ns: (n,), of frames.
        part: (n,), of the session.
        marks: in any order.
    """
    if marks:
        ordered = sorted(marks, key=lambda mark: mark.t_ns)
        bounds = [mark.t_ns for mark in ordered] + [np.iinfo(np.int64).max]
        return [
            Trial(f"{i + 1}: {mark.label}", (t_ns >= bounds[i]) & (t_ns < bounds[i + 1]))
            for i, mark in enumerate(ordered)
        ], "from mark to mark"
    return [
        Trial(f"part {number}", part == number) for number in np.unique(part).tolist()
    ], "each contiguous recording"


def over_trials(values: Floats) -> OverTrials:
    """Mean of a figure with its 95 % interval; trials without the figure (NaN) do not count."""
    known = values[np.isfinite(values)]
    if len(known) < 2:
        mean = float(known[0]) if len(known) else float("nan")
        return OverTrials(mean, None, len(known), "single")
    mean = float(known.mean())
    if len(known) < BOOTSTRAP_FROM or np.ptp(known) == 0.0:
        half = stdtrit(len(known) - 1, _UPPER_95) * known.std(ddof=1) / np.sqrt(len(known))
        return OverTrials(mean, (mean - float(half), mean + float(half)), len(known), "t")
    found = bootstrap((known,), np.mean, n_resamples=RESAMPLES, rng=np.random.default_rng(_SEED))
    low, high = found.confidence_interval
    return OverTrials(mean, (float(low), float(high)), len(known), "bootstrap")
