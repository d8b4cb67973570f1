"""Summary of a session's estimates: stances, ground pull, and errors if the truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from devices.frames import FrameBatch
from service.estimation.estimates import EstimateStatus
from service.estimation.stances import Stance, Stances
from service.offline.accuracy import COMPARED, Accuracy, accuracy_of

if TYPE_CHECKING:
    from service.estimation.ladder.plan import EstimationPlan

PLATE = "true_plate_n"
"""Truth column of a mounted foot's calibration: the plate's force instead of the domes' sum."""

Columns = Mapping[str, npt.NDArray[Any]]


PULL_SIGMAS = 4.0
PULL_MIN_N = 1.0
"""A GRF below zero by `PULL_MIN_N`, and by `PULL_SIGMAS` or with a lost baseline, is a pull. Mud
pulls too, briefly."""


@dataclass(frozen=True)
class Pull:
    """Negative estimated GRF, as after a tare under load.

    Attributes:
        duration_s: total duration.
        most_n: greatest magnitude.
    """

    duration_s: float = 0.0
    most_n: float = 0.0


@dataclass(frozen=True)
class Findings:
    """Summary of a session's estimates; empty without estimates."""

    stances: tuple[Stance, ...] = ()
    accuracy: Accuracy | None = None
    """None without the truth."""
    assumed_scale: bool | None = None
    """True if forces are based on an assumed scale."""
    pull: Pull = Pull()


class FindingsOf:
    """Accumulator of a summary over consecutive frames with estimates.

    Args:
        judging: True if the columns contain the truth, and perhaps `PLATE`.
    """

    def __init__(self, *, judging: bool) -> None:
        self._gathered = Stances()
        self._stances: list[Stance] = []
        self._judging = judging
        self._judged: list[Columns] = []
        self._pull = Pull()

    def feed(self, batch: FrameBatch, columns: Columns) -> None:
        """Add the next frames."""
        self._stances += self._gathered.feed(batch.seq, batch.t_ns, columns)
        self._feel_pull(batch, columns)
        if self._judging:
            known = {"t_ns": batch.t_ns, **columns}
            names = [name for name in (*COMPARED, PLATE) if name != PLATE or name in known]
            self._judged.append({name: known[name] for name in names})

    def finish(self, plan: EstimationPlan) -> Findings:
        """Return the summary; `plan` contains the constants of the estimates."""
        accuracy = None
        if self._judged:
            judged = joined(self._judged)
            if plan.calibration.mounted is not None and PLATE in judged:
                judged["true_grf_n"] = judged[PLATE]
            accuracy = accuracy_of(judged, lag_ms=plan.lag_ns * 1e-6)
        stances = *self._stances, *self._gathered.finish()
        return Findings(stances, accuracy, plan.assumed_scale, self._pull)

    def _feel_pull(self, batch: FrameBatch, columns: Columns) -> None:
        grf_n = columns["grf_n"]
        is_lost = (columns["estimate_status"] & EstimateStatus.BASELINE_LOST) != 0
        is_sure = is_lost | (grf_n < -PULL_SIGMAS * columns["grf_sigma_n"])
        pulls = (grf_n < -PULL_MIN_N) & is_sure
        if not pulls.any() or len(batch) < 2:  # one frame has no period
            return
        period_s = float(np.median(np.diff(batch.t_ns))) * 1e-9
        self._pull = Pull(
            self._pull.duration_s + period_s * int(np.count_nonzero(pulls)),
            max(self._pull.most_n, float(-grf_n[pulls].min())),
        )


def joined(pieces: Sequence[Columns]) -> dict[str, npt.NDArray[Any]]:
    """Concatenate the columns of consecutive batches."""
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
