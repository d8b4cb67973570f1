"""What is kept of a stream beside its frames: which array it is of, how it ended, what it lost."""

from __future__ import annotations

import math
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from devices.errors import DamagedFileError, FileFormatError
from devices.frames import ArrayInfo
from storage.checked_json import read_checked, write_checked
from storage.durable import put_aside
from storage.intervals import AsPairs

NOTES_FILE = "stream.json"
PROMISE_S = 0.5
"""The longest that a frame of a node is unsynced, unless its disk is slower."""
_BATCH_S = 0.033
"""The longest batch of a node."""


def unsynced_tail_max(rate_hz: float, waited_s: float = 0.0) -> int:
    """How many frames a power cut takes at most: what waited for the disk, and one batch.

    Args:
        rate_hz: of the stream.
        waited_s: the longest that frames are known to have waited for the disk.
    """
    return math.ceil(rate_hz * max(PROMISE_S, waited_s)) + math.ceil(rate_hz * _BATCH_S)


class StreamNotes(BaseModel):
    """`stream.json` in the stream's folder, replaced whole at every change."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    array_info: ArrayInfo
    number: int = 0
    """Streams of a node are numbered as they begin; their clocks may have been set in between."""
    kernel_boot_id: str | None = None
    """Which start of the machine it was taken in; None if that is not known here."""
    next_seq: int | None = None
    """The number after its last frame; None while it runs, or if that is not known."""
    unsynced_tail_max: int = 0
    """How many more frames there may have been if its end was not recorded."""
    missed_slots: int = 0
    """Slots in which no frame was taken; they never had a number."""
    sync_max_s: float = 0.0
    """The longest that frames waited for the disk."""
    lost: AsPairs = Field(default_factory=dict)
    damaged: tuple[tuple[int, int], ...] = ()
    """On a server: numbers that were here and cannot be read; the node may give them once more."""

    @property
    def has_ended(self) -> bool:
        """Is it known where it ended?"""
        return self.next_seq is not None

    def save(self, folder: Path) -> None:
        """Write it.

        Raises:
            StorageError: the disk is full or not writable.
        """
        write_checked(folder / NOTES_FILE, self.model_dump_json(indent=1).encode())

    @classmethod
    def load(cls, folder: Path) -> StreamNotes | None:
        """Read it; None if there is none.

        Raises:
            As `load_checked`.
        """
        notes, _ = cls.load_checked(folder)
        return notes

    @classmethod
    def load_checked(cls, folder: Path) -> tuple[StreamNotes | None, bool]:
        """Read it, and say whether it proves itself; an older version's does not.

        Raises:
            DamagedFileError: it is not what was written.
            FileFormatError: it is, by another version.
            StorageError: it cannot be read now.
        """
        path = folder / NOTES_FILE
        try:
            read = read_checked(path)
        except FileNotFoundError:
            return None, True
        try:
            return cls.model_validate_json(read.text), read.is_proven
        except ValidationError as error:
            what = f"not a stream's notes: {' '.join(str(error).split())[:300]}"
            if not read.is_proven:
                raise DamagedFileError(what, where=str(path)) from error
            # A field that is not known here is not dropped in silence: it may bound what is lost.
            raise FileFormatError(
                f"{what}; another version wrote it, and it is left as it is",
                where=str(path),
                remedy="Update foottile",
            ) from error

    @classmethod
    def load_whole(cls, folder: Path, problems: list[str]) -> StreamNotes | None:
        """As `load`, and what is damaged is set aside.

        Args:
            folder: the stream's own.
            problems: told what was found damaged and what became of it.

        Raises:
            FileFormatError: another version wrote it.
            StorageError: it cannot be read now.
        """
        try:
            return cls.load(folder)
        except DamagedFileError as error:
            problems.append(put_aside(folder / NOTES_FILE, error))
            return None
