"""The tares of one node: which is in force, which were before, which were undone. Kept on disk."""

from __future__ import annotations

import json
import uuid
from dataclasses import dataclass, replace
from pathlib import Path

from devices.errors import FileFormatError, TareError, UnknownError
from devices.frames import ArrayInfo
from service.estimation.tare import Tare
from storage.durable import storage_errors, write_whole

KEPT_MAX = 1000


@dataclass(frozen=True)
class RecordedTare:
    """A tare, the tiles it is of, and what became of it."""

    id: str
    serials: tuple[str, ...]
    tare: Tare
    undone: bool = False


class TareHistory:
    """Tares in the order they were taken; the newest that was not undone is in force.

    Args:
        path: file to keep them in.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._tares: list[RecordedTare] = _read(path) if path.exists() else []

    @property
    def all(self) -> list[RecordedTare]:
        """All of them, oldest first."""
        return list(self._tares)

    def in_force(self, info: ArrayInfo) -> RecordedTare | None:
        """The one in force for an array; tares of other tiles do not count."""
        fitting = self._of(info)
        return fitting[-1] if fitting else None

    def during(self, info: ArrayInfo, begin_t_ns: int, end_t_ns: int) -> tuple[Tare, ...]:
        """Tares that were in force at some time of an interval, oldest first.

        Those are the last one before it and all within; if it began without, the first within
        serves from the beginning on.
        """
        fitting = [recorded.tare for recorded in self._of(info) if recorded.tare.t_ns <= end_t_ns]
        fitting.sort(key=lambda tare: tare.t_ns)
        before = [tare for tare in fitting if tare.t_ns <= begin_t_ns][-1:]
        return tuple(before + [tare for tare in fitting if tare.t_ns > begin_t_ns])

    def add(self, tare: Tare, info: ArrayInfo) -> RecordedTare:
        """Put a tare in force.

        Raises:
            StorageError: it cannot be kept; it is not in force then.
        """
        recorded = RecordedTare(uuid.uuid4().hex[:12], info.serials, tare)
        self._keep([*self._tares, recorded][-KEPT_MAX:])
        return recorded

    def undo(self, tare_id: str) -> None:
        """Take a tare out of force; the one before it is in force again.

        Raises:
            UnknownError: there is no such tare, or it was undone already.
            StorageError: that cannot be kept; nothing has changed then.
        """
        if not any(tare.id == tare_id and not tare.undone for tare in self._tares):
            raise UnknownError(f"no tare {tare_id!r} that could be undone")
        self._keep(
            [replace(tare, undone=tare.undone or tare.id == tare_id) for tare in self._tares]
        )

    def _of(self, info: ArrayInfo) -> list[RecordedTare]:
        return [t for t in self._tares if t.serials == info.serials and not t.undone]

    def _keep(self, tares: list[RecordedTare]) -> None:
        content = [
            {"id": t.id, "serials": t.serials, "undone": t.undone, "tare": t.tare.as_dict()}
            for t in tares
        ]
        with storage_errors(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(self._path, json.dumps(content).encode())
        self._tares = tares


def _read(path: Path) -> list[RecordedTare]:
    try:
        content = json.loads(path.read_bytes())
        if not isinstance(content, list):
            raise TypeError("it is no list")  # noqa: TRY301  # caught with the others
        return [
            RecordedTare(
                str(entry["id"]),
                tuple(entry["serials"]),
                Tare.from_dict(entry["tare"], tiles=len(entry["serials"])),
                bool(entry["undone"]),
            )
            for entry in content
        ]
    except (OSError, ValueError, KeyError, TypeError, TareError) as error:
        raise FileFormatError(
            f"the node's tares are not readable: {error}",
            where=str(path),
            remedy="Move the file away; the node has to be tared anew then",
        ) from error
