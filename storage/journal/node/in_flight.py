"""File of frames in flight: acquired, perhaps not yet in the journal, and safe from SIGKILL.

It has fixed rows, mapped into memory, one per frame, and overwrites the oldest. It is never synced:
the kernel keeps it when a process is killed, but a power cut loses it, so it states the kernel's
boot id. Each row has its CRC-32, by which an incomplete or outdated row is recognised.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from devices.acquisition import AcquiredFrame, RangeDetector
from devices.chips.pressure_chips import check_chips, get_raw_type
from devices.errors import DamagedFileError, StorageError
from devices.frames import ArrayInfo, Edge, FrameBatch, get_frame_columns
from storage.durable_files import make_synced_folder, read_small_file, translate_storage_errors
from storage.edges import EdgesInFlightWriter, try_delete_edges_in_flight

IN_FLIGHT_FILE = "in_flight"
ROW_COUNT = 8192
"""Rows for 15 s at full rate, the longest wait for a slow card."""
_MAGIC = b"FootTile in flight 1\n"
_HEAD = struct.Struct("<21sHII36sI")
"""Magic, tiles, rows, length of the description, kernel's boot id, CRC-32 of the two before."""
_ORDER = AcquiredFrame._fields
_CODES = {
    **{"uint64": "Q", "int64": "q", "uint32": "I", "int32": "i", "float32": "f"},
    **{"uint16": "H", "uint8": "B"},
}


class InFlightWriter:
    """Writer of one stream's frames in flight, for the acquisition process.

    Args:
        folder: the stream's own; created if absent.
        info: description of the stream's array.

    Raises:
        StorageError: the disk has no room for the file; acquisition runs without it then.
    """

    def __init__(self, folder: Path, info: ArrayInfo) -> None:
        path = folder / IN_FLIGHT_FILE
        self._edges = EdgesInFlightWriter(folder)
        tiles = len(info.tiles)
        self._row = struct.Struct(_row_format(info))
        self._size = self._row.size + 4
        description = info.model_dump_json().encode()
        self._begin = _HEAD.size + len(description)
        length = self._begin + ROW_COUNT * self._size
        with translate_storage_errors(path):
            make_synced_folder(folder)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
            try:
                # Reserve the room: else a write to the map ends with SIGBUS on a full disk.
                os.posix_fallocate(descriptor, 0, length)
                self._map = mmap.mmap(descriptor, length)
            except OSError:
                path.unlink(missing_ok=True)
                raise
            finally:
                os.close(descriptor)
        kernel_boot_id = (read_kernel_boot_id() or "").encode()
        check = zlib.crc32(description + kernel_boot_id)
        head = _HEAD.pack(_MAGIC, tiles, ROW_COUNT, len(description), kernel_boot_id, check)
        self._map[: self._begin] = head + description

    def write_frame(self, frame: AcquiredFrame) -> None:
        """Write one frame to its row."""
        *of_frame, pressure_raw, temperature_raw, offset_us, status = frame
        row = self._row.pack(*of_frame, *pressure_raw, *temperature_raw, *offset_us, *status)
        at = self._begin + (frame.seq % ROW_COUNT) * self._size
        self._map[at : at + self._size] = row + zlib.crc32(row).to_bytes(4, "little")

    def write_edges(self, edges: Sequence[Edge]) -> None:
        """Write edges of the sync line, to a file of their own."""
        self._edges.write_edges(edges)

    def close(self) -> None:
        """Close the files without deleting them."""
        self._map.close()
        self._edges.close()


class InFlightFrames(NamedTuple):
    """Frames that a killed process left."""

    array_info: ArrayInfo
    frames: FrameBatch | None
    """None: no row is whole."""


def read_in_flight_of_this_boot(folder: Path) -> InFlightFrames | None:
    """Read the newest gapless frames that a process killed in this boot left; or None.

    After a reboot it cannot: the file was never synced. Counted back from the newest frame, the
    result ends at the first missing one.

    Raises:
        DamagedFileError: its content has changed.
        StorageError: it cannot be read now.
    """
    path = folder / IN_FLIGHT_FILE
    try:
        content = read_small_file(path)
    except FileNotFoundError:
        return None
    info = _read_description(content, where=str(path))
    if info is None:
        return None
    tiles = len(info.tiles)
    row = struct.Struct(_row_format(info))
    frame_columns = get_frame_columns(get_raw_type(info.tiles))
    begin = len(content) - ROW_COUNT * (row.size + 4)
    types: list[tuple[str, str] | tuple[str, str, tuple[int, ...]]] = []
    for name in _ORDER:
        dtype, per_tile = frame_columns[name]
        code = dtype.newbyteorder("<").str
        types.append((name, code, (tiles,)) if per_tile else (name, code))
    rows = np.frombuffer(content, np.dtype([*types, ("crc32", "<u4")]), ROW_COUNT, begin)
    body = memoryview(content)
    good = [
        number
        for number in range(ROW_COUNT)
        if zlib.crc32(body[(at := begin + number * (row.size + 4)) : at + row.size])
        == rows["crc32"][number]
        and int(rows["seq"][number]) % ROW_COUNT == number
        and rows["t_mono_ns"][number] != 0
    ]
    if not good:
        return InFlightFrames(info, None)
    found = rows[np.array(good)]
    found = found[np.argsort(found["seq"])]
    steps = np.flatnonzero(np.diff(found["seq"]) != 1)
    found = found[steps[-1] + 1 :] if len(steps) else found
    columns = {
        name: np.ascontiguousarray(found[name], dtype=frame_columns[name][0]) for name in _ORDER
    }
    frames = FrameBatch(**columns)
    RangeDetector(info.tiles).flag_out_of_range(frames)  # as acquisition does when a batch is whole
    return InFlightFrames(info, frames)


def read_newest_in_flight_run(folder: Path, next_journal_seq: int) -> FrameBatch | None:
    """Read the newest run without a gap that a killed process left, from a number on.

    None if there is none, or after a restart of the machine. Frames that the journal has already
    are left out only by `next_journal_seq`.

    Raises:
        DamagedFileError: its content has changed.
        StorageError: it cannot be read now.
    """
    left = read_in_flight_of_this_boot(folder)
    frames = None if left is None else left.frames
    if frames is None or int(frames.seq[-1]) < next_journal_seq:
        return None
    return frames.slice_rows(max(0, next_journal_seq - int(frames.seq[0])), len(frames))


def try_delete_in_flight_file(folder: Path) -> None:
    """Delete the files of frames and edges in flight, if they can be deleted."""
    try_delete_edges_in_flight(folder)
    with suppress(OSError):
        (folder / IN_FLIGHT_FILE).unlink(missing_ok=True)


def try_create_in_flight_writer(folder: Path | None, info: ArrayInfo) -> InFlightWriter | None:
    """Create a writer of frames in flight; None without a folder, or if the disk has no room."""
    if folder is None:
        return None
    try:
        return InFlightWriter(folder, info)
    except StorageError:
        return None


def _row_format(info: ArrayInfo) -> str:
    frame_columns = get_frame_columns(get_raw_type(info.tiles))
    codes = []
    for name in _ORDER:
        dtype, per_tile = frame_columns[name]
        codes.append((str(len(info.tiles)) if per_tile else "") + _CODES[dtype.name])
    return "<" + "".join(codes)


def _read_description(content: bytes, *, where: str) -> ArrayInfo | None:
    """Return the array description; None if the file is of an earlier boot, or just created."""
    if not any(content[: _HEAD.size]):
        return None
    damage = DamagedFileError("its head is not what was written", where=where)
    if len(content) < _HEAD.size:
        raise damage
    magic, _, rows, length, kernel_boot_id, check = _HEAD.unpack_from(content)
    description = content[_HEAD.size : _HEAD.size + length]
    kernel_boot_id = kernel_boot_id.rstrip(b"\0")
    if magic != _MAGIC or rows != ROW_COUNT or zlib.crc32(description + kernel_boot_id) != check:
        raise damage
    if kernel_boot_id.decode(errors="replace") != (read_kernel_boot_id() or ""):
        return None
    try:
        info = check_chips(ArrayInfo.model_validate_json(description))
    except ValueError as error:
        what = f"its head is of another version: {' '.join(str(error).split())[:200]}"
        raise DamagedFileError(what, where=where) from error
    row_bytes = struct.calcsize(_row_format(info)) + 4
    if len(content) != _HEAD.size + length + rows * row_bytes:
        raise damage
    return info


BOOT_ID_FILE = Path("/proc/sys/kernel/random/boot_id")


def read_kernel_boot_id() -> str | None:
    """Return the kernel's id of the current boot; None where there is none."""
    try:
        return BOOT_ID_FILE.read_text(encoding="ascii").strip() or None
    except (OSError, ValueError):
        return None
