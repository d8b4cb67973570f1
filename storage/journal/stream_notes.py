"""`stream.json`: a stream's array, end and losses, beside its frames."""

from __future__ import annotations

import math
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from devices.chips.pressure_chips import KnownArray
from devices.errors import DamagedFileError
from storage.documents import read_document, write_document
from storage.durable_files import try_set_aside_and_describe
from storage.intervals import LossPairs

NOTES_FILE = "stream.json"
MAX_UNSYNCED_S = 0.5
"""Upper limit of the time that a node's frame is unsynced, unless its disk is slower."""
_BATCH_S = 0.033
"""Longest batch of a node."""


def compute_max_lost_tail_frames(rate_hz: float, sync_max_s: float = 0.0) -> int:
    """Compute how many frames a power cut loses at most: waiting frames and one batch.

    Args:
        rate_hz: frame rate of the stream.
        sync_max_s: longest time that frames have waited for the disk.
    """
    return math.ceil(rate_hz * max(MAX_UNSYNCED_S, sync_max_s)) + math.ceil(rate_hz * _BATCH_S)


class StreamNotes(BaseModel):
    """Content of `stream.json` in the stream's folder, replaced atomically at every change."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    array_info: KnownArray
    number: int = 0
    """Order in which a node's streams began; its clock may have been set in between."""
    kernel_boot_id: str | None = None
    """Kernel's boot id while it was acquired; None if unknown."""
    next_seq: int | None = None
    """Number after its last frame; None while it runs, or if unknown."""
    max_lost_tail_frames: int = 0
    """Upper limit of further frames, lost if the end was not recorded."""
    missed_slots: int = 0
    """Slots without a frame; they never had a number."""
    sync_max_s: float = 0.0
    """Longest time that frames waited for the disk."""
    lost: LossPairs = Field(default_factory=dict)
    damaged: tuple[tuple[int, int], ...] = ()
    """Unreadable numbers on a server; the node may send them once more."""

    @property
    def has_ended(self) -> bool:
        """True if the stream's end is recorded."""
        return self.next_seq is not None

    def save(self, folder: Path) -> None:
        """Write `stream.json`.

        Raises:
            StorageError: the disk is full or not writable.
        """
        write_document(folder / NOTES_FILE, self)

    @classmethod
    def load(cls, folder: Path) -> StreamNotes | None:
        """Read `stream.json`; None if there is none.

        Raises:
            DamagedFileError: its content has changed since it was written.
            FileFormatError: another version wrote it.
            StorageError: it cannot be read now.
        """
        try:
            # An unknown field is not dropped silently: it may bound the losses.
            return read_document(folder / NOTES_FILE, cls)
        except FileNotFoundError:
            return None

    @classmethod
    def load_or_set_aside(cls, folder: Path, problems: list[str]) -> StreamNotes | None:
        """Read `stream.json`; set a damaged one aside and return None.

        Args:
            folder: the stream's own.
            problems: a message of any damage is added here.

        Raises:
            FileFormatError: another version wrote it.
            StorageError: it cannot be read now.
        """
        try:
            return cls.load(folder)
        except DamagedFileError as error:
            problems.append(try_set_aside_and_describe(folder / NOTES_FILE, error))
            return None
