"""Summary of a session's estimates: stances, ground pull, and errors if the truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Columns, Floats, Ints
from devices.errors import FileFormatError
from devices.flags import CONTACT_UNKNOWN, EstimateFlag
from devices.frames import FrameBatch
from service.estimation.stances import Stance, StanceDetector
from service.offline.accuracy import ACCURACY_COLUMNS, Accuracy, compute_accuracy
from storage.sessions.reader import SealedFileReader

if TYPE_CHECKING:
    from service.estimation.pipeline.plan import EstimationPlan

PLATE_COLUMN = "true_plate_n"
"""Truth column of a mounted foot's calibration: the plate's force instead of the domes' sum."""


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


_COLUMNS = ("t_ns", "grf_n", "contact")


@dataclass(frozen=True)
class StoredEstimates:
    """Stored GRF and contact of a session's frames, with the look-ahead of their estimate."""

    lag_ms: float
    t_ns: Ints
    grf_n: Floats
    contact: Ints


@dataclass(frozen=True)
class EstimateChange:
    """Difference of two estimates of the same frames."""

    lag_before_ms: float
    frames: int
    """Number of common frames with a GRF in both."""
    grf_rms_n: float
    grf_most_n: float
    contact_frames: int
    """Frames whose contact is another one."""


def read_stored_estimates(path: Path) -> StoredEstimates | None:
    """Read a session's stored estimates; None if it has none or they are damaged.

    Damaged estimates are no error here: a new estimate needs the raw counts only.
    """
    try:
        with SealedFileReader(path, only_slices=True) as session:
            lag_ms = session.notes.get("lag_ms")
            if not isinstance(lag_ms, int | float) or not session.has_columns(*_COLUMNS):
                return None
            pieces = list(session.read_quantities(*_COLUMNS))
    except FileFormatError:
        return None
    if not pieces:
        return None
    t_ns, grf_n, contact = (np.concatenate([piece[name] for piece in pieces]) for name in _COLUMNS)
    return StoredEstimates(float(lag_ms), t_ns, grf_n, contact)


def compute_estimate_change(before: StoredEstimates, after: StoredEstimates) -> EstimateChange:
    """Compute the difference over the common frames."""
    _, i, j = np.intersect1d(before.t_ns, after.t_ns, return_indices=True)
    apart_n = after.grf_n[j].astype(np.float64) - before.grf_n[i]
    known_n = apart_n[np.isfinite(apart_n)]
    contacts = before.contact[i], after.contact[j]
    is_known = (contacts[0] != CONTACT_UNKNOWN) & (contacts[1] != CONTACT_UNKNOWN)
    return EstimateChange(
        lag_before_ms=before.lag_ms,
        frames=len(known_n),
        grf_rms_n=float(np.sqrt((known_n**2).mean())) if len(known_n) else float("nan"),
        grf_most_n=float(np.abs(known_n).max()) if len(known_n) else float("nan"),
        contact_frames=int((is_known & (contacts[0] != contacts[1])).sum()),
    )
