"""Summary of a session's estimates: stances, ground pull, and errors if the truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from devices.flags import EstimateFlag
from devices.frames import FrameBatch
from service.estimation.stances import Stance, StanceDetector
from service.offline.accuracy import ACCURACY_COLUMNS, Accuracy, compute_accuracy

if TYPE_CHECKING:
    from service.estimation.pipeline.plan import EstimationPlan

PLATE_COLUMN = "true_plate_n"
"""Truth column of a mounted foot's calibration: the plate's force instead of the domes' sum."""

Columns = Mapping[str, npt.NDArray[Any]]


PULL_SIGMAS = 4.0
MIN_PULL_N = 1.0
"""A GRF below zero by `MIN_PULL_N`, and by `PULL_SIGMAS` or with a lost baseline, is a pull. Mud
pulls too, briefly."""


@dataclass(frozen=True)
class GroundPull:
    """Negative estimated GRF, as after a tare under load.

    Attributes:
        duration_s: total duration.
        greatest_n: greatest magnitude.
    """

    duration_s: float = 0.0
    greatest_n: float = 0.0


@dataclass(frozen=True)
class EstimateSummary:
    """Summary of a session's estimates; empty without estimates."""

    stances: tuple[Stance, ...] = ()
    accuracy: Accuracy | None = None
    """None without the truth."""
    assumed_scale: bool | None = None
    """True if forces are based on an assumed scale."""
    pull: GroundPull = GroundPull()


class EstimateSummarizer:
    """Accumulator of a summary over consecutive frames with estimates.

    Args:
        has_truth: True if the columns contain the truth, and perhaps `PLATE`.
    """

    def __init__(self, *, has_truth: bool) -> None:
        self._gathered = StanceDetector()
        self._stances: list[Stance] = []
        self._judging = has_truth
        self._judged: list[Columns] = []
        self._pull = GroundPull()

    def add_frames(self, batch: FrameBatch, columns: Columns) -> None:
        """Add the next frames."""
        self._stances += self._gathered.add_frames(batch.seq, batch.t_ns, columns)
        self._add_pull(batch, columns)
        if self._judging:
            known = {"t_ns": batch.t_ns, **columns}
            names = [
                name
                for name in (*ACCURACY_COLUMNS, PLATE_COLUMN)
                if name != PLATE_COLUMN or name in known
            ]
            self._judged.append({name: known[name] for name in names})

    def finish_summary(self, plan: EstimationPlan) -> EstimateSummary:
        """Return the summary; `plan` contains the constants of the estimates."""
        accuracy = None
        if self._judged:
            judged = concatenate_columns(self._judged)
            if plan.calibration.mounted is not None and PLATE_COLUMN in judged:
                judged["true_grf_n"] = judged[PLATE_COLUMN]
            accuracy = compute_accuracy(judged, lag_ms=plan.lag_ns * 1e-6)
        stances = *self._stances, *self._gathered.finish()
        return EstimateSummary(stances, accuracy, plan.is_scale_assumed, self._pull)

    def _add_pull(self, batch: FrameBatch, columns: Columns) -> None:
        grf_n = columns["grf_n"]
        is_lost = (columns["estimate_flags"] & EstimateFlag.BASELINE_LOST) != 0
        is_sure = is_lost | (grf_n < -PULL_SIGMAS * columns["grf_sigma_n"])
        pulls = (grf_n < -MIN_PULL_N) & is_sure
        if not pulls.any() or len(batch) < 2:  # one frame has no period
            return
        period_s = float(np.median(np.diff(batch.t_ns))) * 1e-9
        self._pull = GroundPull(
            self._pull.duration_s + period_s * int(np.count_nonzero(pulls)),
            max(self._pull.greatest_n, float(-grf_n[pulls].min())),
        )


def concatenate_columns(batches: Sequence[Columns]) -> dict[str, npt.NDArray[Any]]:
    """Concatenate the columns of consecutive batches."""
    return {name: np.concatenate([piece[name] for piece in batches]) for name in batches[0]}
