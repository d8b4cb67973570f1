"""Stances of sealed sessions: found while frames are written, or later from the file.

They are computed from the numbers in the file, in single precision: both ways give the same bytes.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.errors import FileFormatError, FootTileError, StorageError, UnknownError
from service.estimation.stances import GATHERED, Stance, Stances
from storage.file_hash import sha256_of
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.reader import SessionReader
from storage.sessions.stances import STANCES_NAME, read_stances, stances_table, write_stances

log = logging.getLogger("foottile.stances")

_NEEDED = (*GATHERED, "part")
_ROWS = 1 << 14
"""Number of frames that are analysed together: half a megabyte, a minute or less."""
_NOT_WRITTEN = f"{STANCES_NAME} was not written, and is rebuilt on request"


class StancesBeside:
    """Finder of the stances of frames that are being sealed.

    A failure does not affect the session: it is reported, and the stances are found later.

    Attributes:
        problem: reason why they are missing; None: they are written, or there are no estimates.
    """

    def __init__(self) -> None:
        self.problem: str | None = None
        self._gathered = Stances()
        self._over: list[Stance] = []
        self._has_estimates = False
        self._waiting: list[dict[str, npt.NDArray[Any]]] = []
        self._rows = 0

    def feed(
        self,
        seq: npt.NDArray[np.uint64],
        t_ns: npt.NDArray[np.int64],
        columns: Mapping[str, npt.NDArray[Any]],
    ) -> None:
        """Add the next frames with their columns; without estimates there are no stances."""
        if self.problem is not None or "contact" not in columns:
            return
        self._has_estimates = True
        needed = {name: columns[name] for name in _NEEDED if name in columns}
        self._waiting.append({"seq": seq, "t_ns": t_ns, **needed})
        self._rows += len(seq)
        if self._rows >= _ROWS:
            self._take_waiting()

    def write(self, folder: Path, frames_sha256: str) -> None:
        """Write `stances.parquet`; without estimates, delete the file of an earlier attempt."""
        path = folder / STANCES_NAME
        if not self._has_estimates:
            with suppress(OSError):
                path.unlink(missing_ok=True)
            return
        table = self.table()
        if self.problem is None:
            try:
                write_stances(path, table, frames_sha256=frames_sha256)
            except Exception as error:
                if not isinstance(error, FootTileError):
                    log.exception("stances: this is a bug")
                self.problem = f"{_NOT_WRITTEN}: {error}"

    def table(self) -> pa.Table:
        """Return all stances; no more frames will come."""
        self._take_waiting()
        self._over += self._gathered.finish()
        return stances_table(stance.as_dict() for stance in self._over)

    def _take_waiting(self) -> None:
        """Analyse the waiting frames together, which is faster than piece by piece."""
        waiting, self._waiting, self._rows = self._waiting, [], 0
        if not waiting or self.problem is not None:
            return
        try:
            columns = {
                name: _single(np.concatenate([piece[name] for piece in waiting]))
                for name in waiting[0]
            }
            self._over += self._gathered.feed(columns["seq"], columns["t_ns"], columns)
        except Exception as error:  # never fail a session for a derived file
            log.exception("stances: this is a bug")
            self.problem = f"{_NOT_WRITTEN}: {error}"


def stances_of_session(
    folder: Path, *, frames_sha256: str | None = None, keep: bool = False
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
    frames_sha256 = frames_sha256 or _hash_of(folder / FRAMES_NAME)
    with suppress(FileNotFoundError, FileFormatError):
        stored = read_stances(path)
        if stored.frames_sha256 == frames_sha256:
            return stored.table
    with SessionReader(folder / FRAMES_NAME, only_slices=True) as session:
        table = stances_in(session)
    if keep:
        with suppress(StorageError):
            write_stances(path, table, frames_sha256=frames_sha256)
    return table


def stances_in(session: SessionReader) -> pa.Table:
    """Compute the stances of a sealed file.

    Raises:
        UnknownError: it has no estimates.
        FileFormatError: it is damaged.
    """
    if not session.has(*GATHERED):
        reason = session.notes.get("estimates", "no estimates were made")
        raise UnknownError(
            f"there are no stances without estimates: {reason}",
            where=str(session.path),
            remedy="`foottile estimate` makes them",
        )
    names = (*GATHERED, "part") if session.has("part") else GATHERED
    found = StancesBeside()
    for columns in session.columns("seq", "t_ns", *names):
        found.feed(columns["seq"], columns["t_ns"], columns)
    if found.problem is not None:
        raise FileFormatError(found.problem, where=str(session.path))
    return found.table()


def _hash_of(path: Path) -> str:
    try:
        return sha256_of(path)
    except OSError as error:
        raise FileFormatError(f"cannot be read: {error.strerror}", where=str(path)) from error


def _single(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Convert numbers to the precision of the file."""
    return values.astype(np.float32) if values.dtype == np.float64 else values
