"""`overview.arrow` beside a session's frames: a pyramid of bins, read piece by piece.

An Arrow file of bins (`storage.sessions.pyramid`), level after level from the finest, in pieces of
some thousand bins. The file's metadata has an index of the pieces with a checksum of each and of
itself, so that each piece is verified without the others. The file can always be made again from
the frames (`service.sessions.overview`): if it is missing, damaged or of other frames.
"""

from __future__ import annotations

import hashlib
import io
import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa

from devices.errors import DamagedFileError, OtherVersionError
from storage.durable_files import (
    open_for_atomic_write,
    open_regular_file,
    translate_read_errors_unless_missing,
)
from storage.sessions.pyramid import (
    BINS_PER_COARSER_BIN,
    FRAMES_PER_FINEST_BIN,
    Bins,
    bin_column_types,
    concatenate_bins,
    select_bins,
    shift_bins_to_axis,
)
from storage.sessions.time_axis import NODE_AXIS, TimeAxis

OVERVIEW_NAME = "overview.arrow"
_KEY, _CHECK_KEY = b"foottile.overview", b"foottile.overview_sha256"
_VERSION = 3
BinColumnTypes = Mapping[str, np.dtype[Any]]
_PIECE_BINS = 4096
"""Bins that are read and verified at a time."""


@dataclass(frozen=True)
class OverviewPiece:
    """Index entry of some bins of a level.

    Attributes:
        level: 0 is the finest.
        bin_count: number of bins.
        begin_ns: least `t_first_ns`.
        end_ns: greatest `t_last_ns`.
        crc32: CRC-32 of their values.
    """

    level: int
    bin_count: int
    begin_ns: int
    end_ns: int
    crc32: int


@dataclass(frozen=True)
class OverviewIndex:
    """Index in the file's metadata.

    Attributes:
        frames_sha256: file hash of the frames it was made from.
        tile_count: number of the array's tiles.
        has_estimates: True: its bins have forces; False: raw counts.
        begin_ns: `t_ns` of the first frame.
        pieces: in the order of the file.
    """

    frames_sha256: str
    tile_count: int
    has_estimates: bool
    begin_ns: int
    pieces: tuple[OverviewPiece, ...]

    @property
    def level_count(self) -> int:
        """Number of levels."""
        return 1 + max((piece.level for piece in self.pieces), default=-1)

    def to_json(self) -> bytes:
        """Return the index as JSON for the file's metadata."""
        content = {
            "version": _VERSION,
            "rows": FRAMES_PER_FINEST_BIN,
            "factor": BINS_PER_COARSER_BIN,
            "frames_sha256": self.frames_sha256,
            "tiles": self.tile_count,
            "estimated": self.has_estimates,
            "begin_ns": self.begin_ns,
            "pieces": [list(vars(piece).values()) for piece in self.pieces],
        }
        return json.dumps(content).encode()

    @classmethod
    def from_json(cls, text: bytes) -> Self:
        """Parse an index.

        Raises:
            ValueError: it is none.
            OtherVersionError: another version wrote it.
        """
        content: dict[str, Any] = json.loads(text)
        if (content["version"], content["rows"], content["factor"]) != (
            _VERSION,
            FRAMES_PER_FINEST_BIN,
            BINS_PER_COARSER_BIN,
        ):
            raise OtherVersionError(
                f"another version of foottile wrote it: {content['version']}",
                expected=f"version {_VERSION}",
                remedy="None needed: it is made again from the frames",
            )
        pieces = tuple(OverviewPiece(*row) for row in content["pieces"])
        return cls(
            content["frames_sha256"],
            content["tiles"],
            content["estimated"],
            content["begin_ns"],
            pieces,
        )


def encode_overview(levels: Sequence[Bins], *, tile_count: int, frames_sha256: str) -> pa.Buffer:
    """Return the bytes of an `overview.arrow`.

    Args:
        levels: bins of each level, the finest first, no level empty.
        tile_count: number of the array's tiles.
        frames_sha256: file hash of the frames.
    """
    sink = pa.BufferOutputStream()
    _write(sink, levels, tile_count, frames_sha256)
    return sink.getvalue()


def write_overview(
    path: Path, levels: Sequence[Bins], *, tile_count: int, frames_sha256: str
) -> None:
    """Write `overview.arrow` without building it in memory; an existing one is replaced.

    Args:
        path: the file.
        levels: as for `encode_overview`.
        tile_count: likewise.
        frames_sha256: likewise.

    Raises:
        StorageError: the disk is full or not writable; the old file is unchanged.
    """
    with open_for_atomic_write(path) as out:
        _write(out, levels, tile_count, frames_sha256)


def _write(
    sink: pa.NativeFile | io.BufferedWriter, levels: Sequence[Bins], tiles: int, frames_sha256: str
) -> None:
    types = bin_column_types(tiles, has_estimates="grf_n_min" in levels[0])
    text = _make_index(levels, types, tiles, frames_sha256).to_json()
    schema = pa.schema(
        [pa.field(name, pa.from_numpy_dtype(t), nullable=False) for name, t in types.items()],
        metadata={_KEY: text, _CHECK_KEY: hashlib.sha256(text).hexdigest().encode()},
    )
    with pa.ipc.new_file(sink, schema) as file:
        for _, bins in _split_into_pieces(levels, types):
            arrays = [pa.array(values) for values in bins.values()]
            file.write_batch(pa.RecordBatch.from_arrays(arrays, schema=schema))


def _make_index(
    levels: Sequence[Bins], types: BinColumnTypes, tiles: int, frames_sha256: str
) -> OverviewIndex:
    pieces = tuple(
        OverviewPiece(
            level,
            len(bins["part"]),
            int(bins["t_first_ns"].min()),
            int(bins["t_last_ns"].max()),
            _compute_crc32(bins),
        )
        for level, bins in _split_into_pieces(levels, types)
    )
    begin_ns = int(levels[0]["t_first_ns"][0])
    return OverviewIndex(frames_sha256, tiles, "grf_n_min" in types, begin_ns, pieces)


def _split_into_pieces(levels: Sequence[Bins], types: BinColumnTypes) -> Iterator[tuple[int, Bins]]:
    """Yield each level's number and its bins, some at a time, in the columns' order."""
    for level, bins in enumerate(levels):
        for at in range(0, len(bins["part"]), _PIECE_BINS):
            yield (
                level,
                {
                    name: np.ascontiguousarray(bins[name][at : at + _PIECE_BINS], type_)
                    for name, type_ in types.items()
                },
            )


def open_overview(path: Path) -> OverviewReader:
    """Open an `overview.arrow`.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: its index is damaged.
        OtherVersionError: another version wrote it.
        StorageError: it cannot be read now.
    """
    # Not through Python's file: Arrow reads a footer on a thread of its own, and a process that
    # ends while that one waits for Python is aborted.
    with open_regular_file(path), translate_read_errors_unless_missing(path):
        source = pa.OSFile(str(path), "r")
    return OverviewReader(source, where=str(path))


class OverviewReader:
    """Reader of an `overview.arrow`.

    Args:
        source: its bytes; closed with the reader.
        where: for errors.

    Raises:
        DamagedFileError: its index is damaged.
        OtherVersionError: another version wrote it.
    """

    def __init__(self, source: pa.NativeFile, *, where: str) -> None:
        self._source, self._where = source, where
        try:
            self._file = pa.ipc.open_file(source)
            self.index = _read_index(self._file)
        except OtherVersionError:
            source.close()
            raise
        except Exception as error:  # damaged bytes may cause any error
            source.close()
            raise self._damage_error(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def estimate_bin_count(
        self, level: int, begin_ns: int | None, end_ns: int | None, axis: TimeAxis = NODE_AXIS
    ) -> int:
        """Return about how many bins of a level are in a time range: those of its pieces."""
        return sum(
            self.index.pieces[i].bin_count for i in self._find_pieces(level, begin_ns, end_ns, axis)
        )

    def read_bins(
        self, level: int, begin_ns: int | None, end_ns: int | None, axis: TimeAxis = NODE_AXIS
    ) -> Bins:
        """Read the bins of a level with frames in a time range, instants on the time axis.

        Args:
            level: 0 is the finest.
            begin_ns: first instant on the axis; None: no bound.
            end_ns: behind the last; None: no bound.
            axis: of the session.

        Raises:
            DamagedFileError: a piece is damaged.
        """
        types = bin_column_types(self.index.tile_count, has_estimates=self.index.has_estimates)
        found = [{name: np.empty(0, type_) for name, type_ in types.items()}]
        for i in self._find_pieces(level, begin_ns, end_ns, axis):
            piece = shift_bins_to_axis(self._read_piece(i, list(types)), axis)
            found.append(select_bins(piece, begin_ns, end_ns))
        return concatenate_bins(found)

    def _find_pieces(
        self, level: int, begin_ns: int | None, end_ns: int | None, axis: TimeAxis
    ) -> list[int]:
        return [
            i
            for i, piece in enumerate(self.index.pieces)
            if piece.level == level
            and axis.may_overlap(piece.begin_ns, piece.end_ns, begin_ns, end_ns)
        ]

    def _read_piece(self, i: int, names: list[str]) -> Bins:
        try:
            batch = self._file.get_batch(i)
            bins = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in names}
        except Exception as error:  # damaged bytes may cause any error
            raise self._damage_error(f"piece {i}: {error}") from error
        entry = self.index.pieces[i]
        if len(batch) != entry.bin_count or _compute_crc32(bins) != entry.crc32:
            raise self._damage_error(f"the checksum of piece {i} is wrong")
        return bins

    def _damage_error(self, why: object) -> DamagedFileError:
        return DamagedFileError(
            f"is no overview: {' '.join(str(why).split())[:300]}",
            where=self._where,
            remedy="Delete it: it is made again from the frames",
        )


def _read_index(file: pa.ipc.RecordBatchFileReader) -> OverviewIndex:
    """Read and verify the index in a file's metadata.

    Raises:
        ValueError: its hash is wrong, or it is of another file.
        KeyError: there is none.
    """
    metadata = file.schema.metadata or {}
    text = metadata[_KEY]
    if hashlib.sha256(text).hexdigest().encode() != metadata[_CHECK_KEY]:
        raise ValueError("its index does not match its hash")
    index = OverviewIndex.from_json(text)
    if file.num_record_batches != len(index.pieces):
        raise ValueError("its index is of another number of pieces")
    return index


def _compute_crc32(bins: Bins) -> int:
    crc = 0
    for values in bins.values():
        crc = zlib.crc32(np.ascontiguousarray(values).data, crc)
    return crc
