"""History of one node's tares, stored on disk: in force, former, undone.

Automatic tares (source "flight") have rules of their own: the older ones are thinned out, never one
by hand; and after an undone one no other follows until a tare by hand: an undo means that automatic
tares are not trusted now.

A line per tare, with a hash of the line, its number and the total. Whatever is changed in the file,
cut off, removed, doubled or moved: the whole tares are read, and the places of missing ones are
known. A `LostTares` stands for those.
"""

from __future__ import annotations

import hashlib
import json
import re
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from devices.errors import DamagedFileError, StorageError, UnknownError
from devices.frames import ArrayInfo
from service.estimation.tare.tare import Tare
from storage.documents import verify_and_strip_json_checksum, write_checksummed_json
from storage.durable_files import (
    ASIDE_SUFFIX,
    make_synced_folder,
    read_small_file,
    set_aside_damaged,
    translate_storage_errors,
)

REASONS = {
    "lead": "unloaded lead of the emulation",
    "unloaded": "by hand",
    "flight": "automatic, foot in the air",
}
_LINE = re.compile(
    rb'(\{"number": ([0-9]{1,9}), "of": ([0-9]{1,9}), [^\n]*?), "sha256": "([0-9a-f]{64})"\}'
)


@dataclass(frozen=True)
class RecordedTare:
    """Tare of certain tiles, with its reason."""

    id: str
    serials: tuple[str, ...]
    tare: Tare
    reason: str
    """Reason, as text."""
    chips: tuple[tuple[int, ...], ...]
    """Registers that the tiles' chips are identified by."""
    undone: bool = False

    def is_of_array(self, info: ArrayInfo) -> bool:
        """Return whether it is of these tiles, by serials and chips.

        A swapped part has the same serial but another chip.
        """
        return self.serials == info.serials and self.chips == _chip_registers(info)

    @property
    def is_taken_in_flight(self) -> bool:
        """True if it was taken in flight."""
        return self.tare.source == "flight"


@dataclass(frozen=True)
class LostTares:
    """One or more lost tares in a row, of unknown content."""


Entry = RecordedTare | LostTares
LOST = LostTares()


@dataclass(frozen=True)
class TareFileContent:
    """Content of a file.

    Attributes:
        entries: tares in their order of time.
        problem: error of the file, as text; None: it is whole.
        is_damaged: True: it has to be set aside.
    """

    entries: tuple[Entry, ...]
    problem: str | None = None
    is_damaged: bool = False


def _chip_registers(info: ArrayInfo) -> tuple[tuple[int, ...], ...]:
    """Return the registers of an array's chips."""
    return tuple(tile.registers for tile in info.tiles)


def read_tares_marking_lost(path: Path) -> TareFileContent:
    """Read all intact tares of a file, with a `LostTares` in place of others.

    Raises:
        StorageError: it cannot be read now.
    """
    try:
        text = read_small_file(path)
    except FileNotFoundError:
        return _content_without_file(path)
    except DamagedFileError as error:
        return TareFileContent((LOST,), f"{error.what}: all of its tares are lost", is_damaged=True)
    is_intact, what = True, "not a complete list of tares"
    try:
        verify_and_strip_json_checksum(text, where=str(path))
    except DamagedFileError as error:
        is_intact, what = False, error.what
    entries, lost = _parse_intact(text)
    if is_intact and lost == 0:
        return TareFileContent(entries)
    return TareFileContent(entries, f"{what}: {_format_lost(lost)}", is_damaged=True)


def write_tares(path: Path, entries: Sequence[Entry]) -> None:
    """Write all tares, in their order of time.

    Raises:
        StorageError: the disk is full or not writable; the old file is still there then.
    """
    lines = []
    for number, entry in enumerate(entries):
        content = {"number": number, "of": len(entries), **_encode_entry(entry)}
        body = json.dumps(content).encode()[:-1]
        lines.append(body + b', "sha256": "' + _hash(body) + b'"}')
    write_checksummed_json(path, b'{"tares": [\n' + b",\n".join(lines) + b"\n]}")


def _content_without_file(path: Path) -> TareFileContent:
    """Return the content without a file: none, unless a damaged file was set aside."""
    try:
        was_set_aside = any(path.parent.glob(path.name + ASIDE_SUFFIX + "*"))
    except OSError:
        was_set_aside = False
    if not was_set_aside:
        return TareFileContent(())
    return TareFileContent(
        (LOST,), "a damaged one was set aside, and no other written: all are lost"
    )


def _format_lost(lost: int | None) -> str:
    if lost is None:
        return "all of its tares are lost"
    if lost == 0:
        return "none of its tares is lost"
    return "1 tare is lost" if lost == 1 else f"{lost} tares are lost"


def _parse_intact(text: bytes) -> tuple[tuple[Entry, ...], int | None]:
    """Return entries in order, and the number of lost ones; None: not even that is known."""
    places: dict[int, set[bytes]] = {}
    totals = set()
    for line in _LINE.finditer(text):
        body, number, total, digits = line.groups()
        if _hash(body) == digits:
            places.setdefault(int(number), set()).add(body)
            totals.add(int(total))
    if len(totals) != 1:
        return (LOST,), None
    entries: list[Entry] = []
    lost = 0
    for number in range(totals.pop()):
        bodies = places.get(number, set())
        entry = _parse_entry(json.loads(bodies.pop() + b"}")) if len(bodies) == 1 else None
        lost += entry is None
        entries.append(entry or LOST)
    return _merge_lost_runs(entries), lost


def _merge_lost_runs(entries: Iterable[Entry]) -> tuple[Entry, ...]:
    """Return the entries with each run of lost ones merged into one."""
    merged: list[Entry] = []
    for entry in entries:
        if not (isinstance(entry, LostTares) and merged and merged[-1] == entry):
            merged.append(entry)
    return tuple(merged)


def _encode_entry(entry: Entry) -> dict[str, object]:
    if isinstance(entry, LostTares):
        return {"lost": True}
    return {
        "id": entry.id,
        "serials": entry.serials,
        "undone": entry.undone,
        "reason": entry.reason,
        "chips": entry.chips,
        "tare": entry.tare.as_dict(),
    }


def _parse_entry(content: Mapping[str, Any]) -> Entry | None:
    """Parse an entry; None if it is of another version."""
    if content.get("lost") is True:
        return LOST
    try:
        return _parse_tare(content)
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


def _parse_tare(entry: Mapping[str, Any]) -> RecordedTare:
    return RecordedTare(
        str(entry["id"]),
        tuple(entry["serials"]),
        Tare.from_dict(entry["tare"], tiles=len(entry["serials"])),
        str(entry["reason"]),
        tuple(tuple(int(word) for word in words) for words in entry["chips"]),
        bool(entry["undone"]),
    )


def _hash(body: bytes) -> bytes:
    return hashlib.sha256(body).hexdigest().encode()


KEPT_MAX = 1000
AUTOMATIC_KEPT_MAX = 200
"""Limit of automatic tares; beyond it the older half is thinned out, which preserves the trend."""
REASON_LENGTH_MAX = 200


class TareHistory:
    """Tares in their order of time; the newest that was not undone is in force.

    If a tare is damaged on disk, no tare is in force from the one before it until the next: its
    tiles and whether it was undone are unknown, and no older one takes its place. The damaged file
    is set aside, and the other tares are written again.

    Args:
        path: file of the history.

    Raises:
        StorageError: it cannot be read now, or is damaged and not set aside: it may hold the only
            copy, so nothing is written in its place.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        found = read_tares_marking_lost(path)
        self._entries: tuple[Entry, ...] = found.entries
        self.problem: str | None = None
        """Damage of the file when it was read, and the consequence."""
        if found.problem is not None:
            self._rewrite(found.problem, is_damaged=found.is_damaged)

    def _rewrite(self, problem: str, *, is_damaged: bool) -> None:
        done = (
            f"it is kept as {set_aside_damaged(self._path).name}"
            if is_damaged
            else "it is rewritten"
        )
        try:
            self._store(self._entries)
        except StorageError as error:
            done = f"it cannot be rewritten: {error}"
        self.problem = f"{self._path}: {problem}; {done}"

    @property
    def all_tares_with_undone(self) -> list[RecordedTare]:
        """All intact tares, of any array and undone ones too, oldest first."""
        return [entry for entry in self._entries if isinstance(entry, RecordedTare)]

    def is_empty(self, info: ArrayInfo) -> bool:
        """Return whether no tare of this array is in the history, counting lost ones."""
        return not self._valid_tares(info) and not any(
            isinstance(e, LostTares) for e in self._entries
        )

    def tare_in_force_unless_lost(self, info: ArrayInfo) -> RecordedTare | None:
        """Return the tare in force for an array; None if there is none, or if it is lost.

        Tares of other tiles do not count.
        """
        fitting = self._valid_since_lost(info)
        return fitting[-1] if fitting else None

    def is_tare_lost(self, info: ArrayInfo) -> bool:
        """Return whether a lost tare may be the one in force."""
        lost = any(isinstance(entry, LostTares) for entry in self._entries)
        return lost and not self._valid_since_lost(info)

    def may_have_lost_tare_taken_at(self, t_ns: int) -> bool:
        """Return whether a lost tare may have this time."""
        return any(first <= t_ns <= last for first, last in self._lost_intervals())

    def tare_in_force_or_lost(self, info: ArrayInfo) -> Tare | None:
        """Return the tare in force, else `Tare.make_lost` for a lost one, else None."""
        in_force = self.tare_in_force_unless_lost(info)
        if in_force is not None:
            return in_force.tare
        return Tare.make_lost(tiles=len(info.tiles), t_ns=0) if self.is_tare_lost(info) else None

    def last_not_in_flight_or_oldest(self, info: ArrayInfo) -> RecordedTare | None:
        """Return the reference of automatic tares: the last other one, else the oldest.

        Tares before a lost one do not count: the lost one may have been the last other tare.
        """
        fitting = self._valid_since_lost(info)
        return next((t for t in reversed(fitting) if not t.is_taken_in_flight), (*fitting, None)[0])

    def is_automatic_paused(self, info: ArrayInfo) -> bool:
        """Return whether a tare was undone, with no tare by hand or from a lead since."""
        for recorded in reversed(self.all_tares_with_undone):
            if not recorded.is_of_array(info):
                continue
            if recorded.undone or not recorded.is_taken_in_flight:
                return recorded.undone
        return False

    def valid_tares(self, info: ArrayInfo) -> tuple[Tare, ...]:
        """Return all tares that were not undone, in their order of time."""
        return tuple(recorded.tare for recorded in self._valid_tares(info))

    def tares_in_force_or_lost_between(
        self, info: ArrayInfo, begin_t_ns: int, end_t_ns: int
    ) -> tuple[Tare, ...]:
        """Return the tares in force at some time of an interval, oldest first.

        Those are the last one up to its begin, if there is one, and all within. `Tare.make_lost`
        stands for a lost one, from the earliest time at which it may have been in force.
        """
        gaps = list(self._lost_intervals())
        valid = [(recorded.tare.t_ns, recorded.tare) for recorded in self._valid_tares(info)]
        fitting = [
            (t_ns, tare)
            for t_ns, tare in valid
            # A lost tare may be newer than this one.
            if not any(first < t_ns < last for first, last in gaps)
        ]
        tiles = len(info.tiles)
        for first, _ in gaps:
            t_ns = max(first, min(begin_t_ns, end_t_ns))
            fitting.append((first, Tare.make_lost(tiles=tiles, t_ns=t_ns)))
        fitting.sort(key=lambda item: (item[0], item[1].is_lost))
        before = [tare for t_ns, tare in fitting if t_ns <= begin_t_ns][-1:]
        within = [tare for t_ns, tare in fitting if begin_t_ns < t_ns <= end_t_ns]
        return tuple(before + within)

    def _lost_intervals(self) -> Iterator[tuple[int, int]]:
        """Yield the intervals of lost tares: between the times of their neighbours."""
        for index, entry in enumerate(self._entries):
            if isinstance(entry, LostTares):
                beside = (
                    self._neighbour_t_ns(index - 1, _ANY_TIME_NS[0]),
                    self._neighbour_t_ns(index + 1, _ANY_TIME_NS[1]),
                )
                # A clock that was set back reverses their order.
                yield min(beside), max(beside)

    def _neighbour_t_ns(self, at: int, otherwise: int) -> int:
        entry = self._entries[at] if 0 <= at < len(self._entries) else None
        return entry.tare.t_ns if isinstance(entry, RecordedTare) else otherwise

    def store_tare_in_force(self, tare: Tare, info: ArrayInfo, reason: str = "") -> RecordedTare:
        """Store a tare, which puts it in force in the history; the caller sets it in the estimator.

        Args:
            tare: the tare.
            info: the array.
            reason: reason, as text; default: by its source.

        Raises:
            StorageError: it cannot be stored; it is not in force then.
        """
        reason = (reason or REASONS.get(tare.source, tare.source))[:REASON_LENGTH_MAX]
        recorded = RecordedTare(
            uuid.uuid4().hex[:12], info.serials, tare, reason, _chip_registers(info)
        )
        self._store(_thin_out((*self._entries, recorded)))
        return recorded

    def undo_tare(self, tare_id: str) -> None:
        """Undo a tare. If it was in force, the one before it is again, and automatic tares pause.

        Raises:
            UnknownError: no such tare, or it was undone already.
            StorageError: that cannot be stored; nothing has changed then.
        """
        if not any(tare.id == tare_id and not tare.undone for tare in self.all_tares_with_undone):
            raise UnknownError(f"no tare {tare_id!r} that could be undone")
        self._store(
            tuple(
                replace(entry, undone=True)
                if isinstance(entry, RecordedTare) and entry.id == tare_id
                else entry
                for entry in self._entries
            )
        )

    def _valid_tares(self, info: ArrayInfo) -> list[RecordedTare]:
        return [t for t in self.all_tares_with_undone if t.is_of_array(info) and not t.undone]

    def _valid_since_lost(self, info: ArrayInfo) -> list[RecordedTare]:
        """Return the valid tares after the last lost one."""
        fitting: list[RecordedTare] = []
        for entry in self._entries:
            if isinstance(entry, LostTares):
                fitting.clear()
            elif entry.is_of_array(info) and not entry.undone:
                fitting.append(entry)
        return fitting

    def _store(self, entries: tuple[Entry, ...]) -> None:
        with translate_storage_errors(self._path):
            make_synced_folder(self._path.parent)
        write_tares(self._path, entries)
        self._entries = entries


_ANY_TIME_NS = (-(2**63), 2**63 - 1)


def _thin_out(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    automatic = [t for t in entries if isinstance(t, RecordedTare) and t.is_taken_in_flight]
    if len(automatic) > AUTOMATIC_KEPT_MAX:
        # Drop the least informative tare: in the older half, the closest to its neighbours. The
        # very first stays: it may be the reference of automatic tares.
        gaps_ns = {
            now.id: after.tare.t_ns - before.tare.t_ns
            for before, now, after in zip(automatic, automatic[1:], automatic[2:], strict=False)
        }
        older = automatic[1 : len(automatic) // 2]
        least = min(older, key=lambda tare: gaps_ns[tare.id])
        entries = tuple(entry for entry in entries if entry is not least)
    return _merge_lost_runs(entries[-KEPT_MAX:])
