"""Stances of sealed sessions: found while frames are written, or later from the file.

They are computed from the numbers in the file, in single precision: both ways give the same bytes.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from devices.arrays import Times
from devices.errors import FileFormatError, FootTileError, StorageError, UnknownError
from service.estimation.stance_curves import (
    OVERLAY_COLUMNS,
    Overlay,
    StanceOverlayBuilder,
    select_evenly,
)
from service.estimation.stances import STANCE_INPUT_COLUMNS, Stance, StanceDetector
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.reader import SealedFileReader
from storage.sessions.stances import STANCES_NAME, make_stance_table, read_stances, write_stances

log = logging.getLogger("foottile.stances")

_NEEDED = (*STANCE_INPUT_COLUMNS, "part")
_ROWS = 1 << 14
"""Number of frames that are analysed together: half a megabyte, a minute or less."""
_NOT_WRITTEN = f"{STANCES_NAME} was not written, and is rebuilt on request"


class StancesWriter:
    """Finder of the stances of frames that are being sealed.

    A failure does not affect the session: it is reported, and the stances are found later.

    Attributes:
        problem: reason why they are missing; None: they are written, or there are no estimates.
    """

    def __init__(self) -> None:
        self.problem: str | None = None
        self._finder = StanceDetector()
        self._finished: list[Stance] = []
        self._has_estimates = False
        self._waiting: list[dict[str, npt.NDArray[Any]]] = []
        self._waiting_frames = 0

    def try_add_frames(
        self,
        seq: npt.NDArray[np.uint64],
        t_ns: Times,
        columns: Mapping[str, npt.NDArray[Any]],
    ) -> None:
        """Add the next frames with their columns; without estimates there are no stances."""
        if self.problem is not None or "contact" not in columns:
            return
        self._has_estimates = True
        needed = {name: columns[name] for name in _NEEDED if name in columns}
        self._waiting.append({"seq": seq, "t_ns": t_ns, **needed})
        self._waiting_frames += len(seq)
        if self._waiting_frames >= _ROWS:
            self._analyse_waiting()

    def try_write_or_delete_file(self, folder: Path, frames_sha256: str) -> None:
        """Try to write `stances.parquet`; without estimates, delete that of an earlier attempt."""
        path = folder / STANCES_NAME
        if not self._has_estimates:
            with suppress(OSError):
                path.unlink(missing_ok=True)
            return
        table = self.finish_table()
        if self.problem is None:
            try:
                write_stances(path, table, frames_sha256=frames_sha256)
            except Exception as error:
                if not isinstance(error, FootTileError):
                    log.exception("stances: this is a bug")
                self.problem = f"{_NOT_WRITTEN}: {error}"

    def finish_table(self) -> pa.Table:
        """Return all stances; no more frames will come."""
        self._analyse_waiting()
        self._finished += self._finder.finish()
        return make_stance_table(stance.as_dict() for stance in self._finished)

    def _analyse_waiting(self) -> None:
        """Analyse the waiting frames together, which is faster than piece by piece."""
        waiting, self._waiting, self._waiting_frames = self._waiting, [], 0
        if not waiting or self.problem is not None:
            return
        try:
            columns = {
                name: _to_file_precision(np.concatenate([piece[name] for piece in waiting]))
                for name in waiting[0]
            }
            self._finished += self._finder.add_frames(columns["seq"], columns["t_ns"], columns)
        except Exception as error:  # never fail a session for a derived file
            log.exception("stances: this is a bug")
            self.problem = f"{_NOT_WRITTEN}: {error}"


def load_stances(
    folder: Path, *, frames_sha256: str | None = None, store: bool = False
) -> pa.Table:
    """Return the stances of a sealed session as a table: from their file, else from its frames.

    Args:
        folder: folder of the session.
        frames_sha256: hash of the file of frames; computed if None.
        store: store stances that had to be computed, if the folder is writable.

    Raises:
        UnknownError: it has no estimates.
        FileFormatError: there are no frames, or they are damaged.
        StorageError: they cannot be read now.
    """
    path = folder / STANCES_NAME
    frames_sha256 = frames_sha256 or _file_hash(folder / FRAMES_NAME)
    with suppress(FileNotFoundError, FileFormatError):
        stored = read_stances(path)
        if stored.frames_sha256 == frames_sha256:
            return stored.table
    with SealedFileReader(folder / FRAMES_NAME, only_slices=True) as session:
        table = compute_stances(session)
    if store:
        with suppress(StorageError):
            write_stances(path, table, frames_sha256=frames_sha256)
    return table


def compute_stances(session: SealedFileReader) -> pa.Table:
    """Compute the stances of a sealed file.

    Raises:
        UnknownError: it has no estimates.
        FileFormatError: it is damaged.
    """
    if not session.has_columns(*STANCE_INPUT_COLUMNS):
        reason = session.notes.get("estimates", "no estimates were made")
        raise UnknownError(
            f"there are no stances without estimates: {reason}",
            where=str(session.path),
            remedy="`foottile estimate` makes them",
        )
    names = (*STANCE_INPUT_COLUMNS, "part") if session.has_columns("part") else STANCE_INPUT_COLUMNS
    found = StancesWriter()
    for columns in session.read_quantities("seq", "t_ns", *names):
        found.try_add_frames(columns["seq"], columns["t_ns"], columns)
    if found.problem is not None:
        raise FileFormatError(found.problem, where=str(session.path))
    return found.finish_table()


def _file_hash(path: Path) -> str:
    try:
        return compute_sha256(path)
    except OSError as error:
        raise FileFormatError(f"cannot be read: {error.strerror}", where=str(path)) from error


def _to_file_precision(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Convert numbers to the precision of the file."""
    return values.astype(np.float32) if values.dtype == np.float64 else values


STANCES_MAX = 4000
"""Limit of overlaid stances, evenly spread over the session: two seconds of work."""


@dataclass(frozen=True)
class SessionOverlay:
    """Overlay of the whole stances of a session.

    Attributes:
        overlay: curves, mean and spread.
        numbers: numbers of the stances with single curves, in the order of its rows.
        whole_count: number of stances that could be overlaid.
        overlaid_count: number of stances in mean and spread: all, or `STANCES_MAX`.
        partial_count: number of stances left out as incomplete.
        too_short_count: number of stances left out as single frames without duration.
    """

    overlay: Overlay
    numbers: tuple[int, ...]
    whole_count: int
    overlaid_count: int
    partial_count: int
    too_short_count: int


def overlay_stances(
    session: SealedFileReader, stances: pa.Table, *, points: int, curves: int
) -> SessionOverlay:
    """Overlay the stances of a sealed session.

    Args:
        session: frames of the session, open for slices.
        stances: table of `service.sessions.stances.load_stances`.
        points: number of percentages of the duration, from 0 to 100.
        curves: limit of single curves, evenly spread over the session.

    Raises:
        UnknownError: it lacks estimates of an overlaid quantity.
        FileFormatError: it is damaged.
    """
    if absent := [
        name for name in (*OVERLAY_COLUMNS, "estimate_flags") if not session.has_columns(name)
    ]:
        raise UnknownError(
            f"stances cannot be overlaid without {', '.join(absent)}",
            where=str(session.path),
            remedy="`foottile estimate` makes them",
        )
    whole = stances.filter(stances["is_whole"])
    long = whole.filter(pc.greater(whole["end_t_ns"], whole["begin_t_ns"]))
    chosen = long.take(select_evenly(long.num_rows, STANCES_MAX))
    part, begin_ns, end_ns = (
        chosen[name].to_numpy() for name in ("part", "begin_t_ns", "end_t_ns")
    )
    rows = select_evenly(chosen.num_rows, curves)
    gathered = StanceOverlayBuilder(part, begin_ns, end_ns, points=points, rows=rows.tolist())
    if chosen.num_rows:
        names = ["t_ns", "estimate_flags", *OVERLAY_COLUMNS]
        names += ["part"] if session.has_columns("part") else []
        begins_ns, ends_ns = (
            session.time_axis.shift_to_axis(t_ns, part) for t_ns in (begin_ns, end_ns)
        )
        groups = session.find_overlapping_row_groups(int(begins_ns.min()), int(ends_ns.max()) + 1)
        for piece in session.read_quantities(*names, row_groups=groups):
            gathered.add_frames(piece["t_ns"].astype(np.int64), piece)
    overlay = gathered.build_overlay()
    return SessionOverlay(
        overlay,
        tuple(chosen["number"].to_numpy()[overlay.rows].tolist()),
        whole_count=long.num_rows,
        overlaid_count=chosen.num_rows,
        partial_count=stances.num_rows - whole.num_rows,
        too_short_count=whole.num_rows - long.num_rows,
    )
