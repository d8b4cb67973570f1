"""File `tares.json` with the tares of one node, each with a checksum.

A line per tare, with a hash of the line, its number and the total. Whatever is changed in the file,
cut off, removed, doubled or moved: the whole tares are read, and the places of missing ones are
known. A `LostTares` stands for those.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from devices.errors import DamagedFileError
from devices.frames import ArrayInfo
from service.estimation.tare.tare import Tare
from storage.checksummed_json import verify_and_strip_json_checksum, write_checksummed_json
from storage.durable_files import ASIDE_SUFFIX, read_small_file

REASONS = {
    "lead": "unloaded lead of the emulation",
    "unloaded": "by hand",
    "flight": "in flight",
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
    """Coefficients of the tiles' chips."""
    undone: bool = False

    def is_of_array(self, info: ArrayInfo) -> bool:
        """Return whether it is of these tiles, by serials and chips.

        A swapped part has the same serial but another chip.
        """
        return self.serials == info.serials and self.chips == chip_coefficients(info)

    @property
    def is_automatic(self) -> bool:
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


def chip_coefficients(info: ArrayInfo) -> tuple[tuple[int, ...], ...]:
    """Return the coefficients of an array's chips."""
    return tuple(tuple(tile.coefficient_words) for tile in info.tiles)


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
    return merge_lost_runs(entries), lost


def merge_lost_runs(entries: Iterable[Entry]) -> tuple[Entry, ...]:
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
