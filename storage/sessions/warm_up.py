"""`warm_up.parquet` beside a session's frames: the frames just before its first one.

Creep, loops and gas of a dome remember earlier loads. A session that begins under load needs the
frames from before it to know them: they are kept as long as the session, and estimated again with
it. They are none of its frames: no ledger counts them, no export has them, and a session without
them is whole. The notes of `frames.parquet` have the file's hash, so that another recording's file
is not taken for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from devices.arrays import Columns
from devices.errors import DamagedFileError, FileFormatError
from devices.frames import ArrayInfo, FrameBatch
from storage.durable_files import sync_folder, translate_storage_errors
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import WARM_UP_NAME
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter

WARM_UP_NOTE = "warm_up"
"""Note of a session's frames: number and file hash of its warm-up frames."""


def write_or_delete_warm_up(
    folder: Path, info: ArrayInfo, frames: Sequence[FrameBatch]
) -> dict[str, object]:
    """Write the warm-up frames of a session; without any, delete the file of an earlier sealing.

    Returns:
        Notes for the session's frames, which are written after it.

    Raises:
        StorageError: the disk is full or not writable.
    """
    path = folder / WARM_UP_NAME
    if not frames:
        with translate_storage_errors(path):
            if path.exists():
                path.unlink()
                sync_folder(folder)
        return {}
    with SealedFileWriter(path, info, {}) as writer:
        for batch in frames:
            writer.append_frames(batch, {})
    count = sum(len(batch) for batch in frames)
    return {WARM_UP_NOTE: {"frames": count, "sha256": compute_sha256(path)}}


def read_warm_up(frames: Path, notes: Mapping[str, object]) -> list[FrameBatch]:
    """Read the warm-up frames of a session; empty if its notes name none.

    Args:
        frames: file of the session's frames.
        notes: notes in that file.

    Raises:
        FileFormatError: they are missing.
        DamagedFileError: they are damaged, or of another session.
    """
    note = notes.get(WARM_UP_NOTE)
    if note is None:
        return []
    path = frames.with_name(WARM_UP_NAME)
    try:
        sha256 = compute_sha256(path)
    except FileNotFoundError as error:
        raise FileFormatError("is missing", where=str(path)) from error
    except OSError as error:
        raise FileFormatError(f"cannot be read: {error.strerror}", where=str(path)) from error
    if not isinstance(note, dict) or sha256 != note.get("sha256"):
        raise DamagedFileError(
            f"it is damaged, or of another session than {frames.name}", where=str(path)
        )
    with SealedFileReader(path) as reader:
        return [batch for batch, _ in reader.read_batches()]


def with_part_column(frames: FrameBatch) -> tuple[FrameBatch, Columns]:
    """Return warm-up frames with the column that frames of a session have: the first part."""
    return frames, {"part": np.zeros(len(frames), dtype=np.uint16)}
