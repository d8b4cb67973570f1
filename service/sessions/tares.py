"""The tares of one node: which is in force, which were before, which were undone. Kept on disk.

Automatic tares (source "flight") come unasked, so they have rules of their own: of many the older
ones are thinned out, never one that was taken by hand; and when one is undone, no other follows
until one is taken by hand: an undone tare says that automatic ones are not trusted now.
"""

from __future__ import annotations

import json
import uuid
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from devices.errors import FileFormatError, TareError, UnknownError
from devices.frames import ArrayInfo
from service.estimation.tare.tare import Tare
from storage.durable import make_folder, storage_errors, write_whole

KEPT_MAX = 1000
AUTOMATIC_KEPT_MAX = 200
"""Above this number the older half is thinned out, which keeps the trend over hours."""
REASON_LENGTH_MAX = 200

_REASONS = {
    "lead": "unloaded lead of the emulation",
    "unloaded": "by hand",
    "flight": "in flight",
}


@dataclass(frozen=True)
class RecordedTare:
    """A tare, the tiles it is of, why it was taken, and what became of it."""

    id: str
    serials: tuple[str, ...]
    tare: Tare
    undone: bool = False
    reason: str = ""
    """In words."""
    chips: tuple[tuple[int, ...], ...] | None = None
    """Coefficients of the tiles' chips; None in tares of older versions, which kept none."""

    def is_of(self, info: ArrayInfo) -> bool:
        """Does it belong to these tiles? A swapped part has the same serial but another chip."""
        return self.serials == info.serials and self.chips in (None, _chips(info))

    @property
    def is_automatic(self) -> bool:
        """Did it come unasked?"""
        return self.tare.source == "flight"


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

    def anchor(self, info: ArrayInfo) -> RecordedTare | None:
        """What automatic tares are compared with: the last other tare, else the oldest."""
        fitting = self._of(info)
        return next((t for t in reversed(fitting) if not t.is_automatic), (*fitting, None)[0])

    def is_automatic_paused(self, info: ArrayInfo) -> bool:
        """Was an automatic tare undone, with no other kind taken since?"""
        for recorded in reversed(self._tares):
            if not recorded.is_of(info):
                continue
            if recorded.is_automatic and recorded.undone:
                return True
            if not recorded.is_automatic and not recorded.undone:
                return False
        return False

    def valid(self, info: ArrayInfo) -> tuple[Tare, ...]:
        """All that were not undone, in the order they were taken."""
        return tuple(recorded.tare for recorded in self._of(info))

    def during(self, info: ArrayInfo, begin_t_ns: int, end_t_ns: int) -> tuple[Tare, ...]:
        """Tares that were in force at some time of an interval, oldest first.

        Those are the last one before it and all within; if it began without, the first within
        serves from the beginning on.
        """
        fitting = [recorded.tare for recorded in self._of(info) if recorded.tare.t_ns <= end_t_ns]
        fitting.sort(key=lambda tare: tare.t_ns)
        before = [tare for tare in fitting if tare.t_ns <= begin_t_ns][-1:]
        return tuple(before + [tare for tare in fitting if tare.t_ns > begin_t_ns])

    def add(self, tare: Tare, info: ArrayInfo, reason: str = "") -> RecordedTare:
        """Put a tare in force.

        Args:
            tare: the tare.
            info: the array.
            reason: why, in words; what its source says if none is given.

        Raises:
            StorageError: it cannot be kept; it is not in force then.
        """
        reason = (reason or _REASONS.get(tare.source, tare.source))[:REASON_LENGTH_MAX]
        recorded = RecordedTare(
            uuid.uuid4().hex[:12], info.serials, tare, reason=reason, chips=_chips(info)
        )
        self._keep(_bounded([*self._tares, recorded]))
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
        return [t for t in self._tares if t.is_of(info) and not t.undone]

    def _keep(self, tares: list[RecordedTare]) -> None:
        content = [
            {
                "id": t.id,
                "serials": t.serials,
                "undone": t.undone,
                "reason": t.reason,
                "chips": t.chips,
                "tare": t.tare.as_dict(),
            }
            for t in tares
        ]
        with storage_errors(self._path):
            make_folder(self._path.parent)
        write_whole(self._path, json.dumps(content).encode())
        self._tares = tares


def _chips(info: ArrayInfo) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(tile.coefficient_words) for tile in info.tiles)


def _read_chips(content: Any) -> tuple[tuple[int, ...], ...] | None:
    return None if content is None else tuple(tuple(int(w) for w in words) for words in content)


def _bounded(tares: list[RecordedTare]) -> list[RecordedTare]:
    automatic = [t for t in tares if t.is_automatic]
    if len(automatic) > AUTOMATIC_KEPT_MAX:
        # Drop the tare that says least: in the older half, the one with the closest neighbours. The
        # very first stays, because others may be compared with it.
        gaps_ns = {
            now.id: after.tare.t_ns - before.tare.t_ns
            for before, now, after in zip(automatic, automatic[1:], automatic[2:], strict=False)
        }
        older = [t.id for t in automatic[1 : len(automatic) // 2]]
        least = min(older, key=lambda tare_id: gaps_ns[tare_id])
        tares = [t for t in tares if t.id != least]
    return tares[-KEPT_MAX:]


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
                str(entry.get("reason") or _REASONS.get(entry["tare"]["source"], "")),
                _read_chips(entry.get("chips")),
            )
            for entry in content
        ]
    except (OSError, ValueError, KeyError, TypeError, TareError) as error:
        raise FileFormatError(
            f"the node's tares are not readable: {error}",
            where=str(path),
            remedy="Move the file away; the node has to be tared again then",
        ) from error
