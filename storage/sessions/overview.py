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
from storage.durable import open_own, read_errors, whole_file
from storage.sessions.pyramid import FACTOR, ROWS, Bins, bin_columns, joined, on_axis
from storage.sessions.time_axis import NODE_AXIS, TimeAxis

OVERVIEW_NAME = "overview.arrow"
_KEY, _CHECK_KEY = b"foottile.overview", b"foottile.overview_sha256"
_VERSION = 2
Types = Mapping[str, np.dtype[Any]]
_PIECE = 4096
"""Bins that are read and verified at a time."""


@dataclass(frozen=True)
class Piece:
    """Index entry of some bins of a level.

    Attributes:
        level: 0 is the finest.
        bins: number of bins.
        begin_ns: least `t_first_ns`.
        end_ns: greatest `t_last_ns`.
        crc: CRC-32 of their values.
    """

    level: int
    bins: int
    begin_ns: int
    end_ns: int
    crc: int


@dataclass(frozen=True)
class Index:
    """Index in the file's metadata.

    Attributes:
        frames_sha256: file hash of the frames it was made from.
        tiles: number of the array's tiles.
        estimated: True: its bins have forces; False: raw counts.
        begin_ns: `t_ns` of the first frame.
        pieces: in the order of the file.
    """

    frames_sha256: str
    tiles: int
    estimated: bool
    begin_ns: int
    pieces: tuple[Piece, ...]

    @property
    def levels(self) -> int:
        """Number of levels."""
        return 1 + max((piece.level for piece in self.pieces), default=-1)

    def to_json(self) -> bytes:
        """Return the index as JSON for the file's metadata."""
        content = {
            "version": _VERSION,
            "rows": ROWS,
            "factor": FACTOR,
            "frames_sha256": self.frames_sha256,
            "tiles": self.tiles,
            "estimated": self.estimated,
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
        if (content["version"], content["rows"], content["factor"]) != (_VERSION, ROWS, FACTOR):
            raise OtherVersionError(
                f"another version of foottile wrote it: {content['version']}",
                expected=f"version {_VERSION}",
                remedy="None needed: it is made again from the frames",
            )
        pieces = tuple(Piece(*row) for row in content["pieces"])
        return cls(
            content["frames_sha256"],
            content["tiles"],
            content["estimated"],
            content["begin_ns"],
            pieces,
        )


def overview_content(levels: Sequence[Bins], *, tiles: int, frames_sha256: str) -> pa.Buffer:
    """Return the bytes of an `overview.arrow`.

    Args:
        levels: bins of each level, the finest first, none of them empty.
        tiles: number of the array's tiles.
        frames_sha256: file hash of the frames.
    """
    sink = pa.BufferOutputStream()
    _write(sink, levels, tiles, frames_sha256)
    return sink.getvalue()


def write_overview(path: Path, levels: Sequence[Bins], *, tiles: int, frames_sha256: str) -> None:
    """Write `overview.arrow` without building it in memory; an existing one is replaced.

    Args:
        path: the file.
        levels: as for `overview_content`.
        tiles: likewise.
        frames_sha256: likewise.

    Raises:
        StorageError: the disk is full or not writable; the old file is unchanged.
    """
    with whole_file(path) as out:
        _write(out, levels, tiles, frames_sha256)


def _write(
    sink: pa.NativeFile | io.BufferedWriter, levels: Sequence[Bins], tiles: int, frames_sha256: str
) -> None:
    types = bin_columns(tiles, estimated="grf_n_min" in levels[0])
    text = _index_over(levels, types, tiles, frames_sha256).to_json()
    schema = pa.schema(
        [pa.field(name, pa.from_numpy_dtype(t), nullable=False) for name, t in types.items()],
        metadata={_KEY: text, _CHECK_KEY: hashlib.sha256(text).hexdigest().encode()},
    )
    with pa.ipc.new_file(sink, schema) as file:
        for _, bins in _pieces_of(levels, types):
            arrays = [pa.array(values) for values in bins.values()]
            file.write_batch(pa.RecordBatch.from_arrays(arrays, schema=schema))


def _index_over(levels: Sequence[Bins], types: Types, tiles: int, frames_sha256: str) -> Index:
    pieces = tuple(
        Piece(
            level,
            len(bins["part"]),
            int(bins["t_first_ns"].min()),
            int(bins["t_last_ns"].max()),
            _crc(bins),
        )
        for level, bins in _pieces_of(levels, types)
    )
    begin_ns = int(levels[0]["t_first_ns"][0])
    return Index(frames_sha256, tiles, "grf_n_min" in types, begin_ns, pieces)


def _pieces_of(levels: Sequence[Bins], types: Types) -> Iterator[tuple[int, Bins]]:
    """Yield each level's number and its bins, some at a time, in the columns' order."""
    for level, bins in enumerate(levels):
        for at in range(0, len(bins["part"]), _PIECE):
            yield (
                level,
                {
                    name: np.ascontiguousarray(bins[name][at : at + _PIECE], type_)
                    for name, type_ in types.items()
                },
            )


def open_overview(path: Path) -> Overview:
    """Open an `overview.arrow`.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: its index is damaged.
        OtherVersionError: another version wrote it.
        StorageError: it cannot be read now.
    """
    # Not through Python's file: Arrow reads a footer on a thread of its own, and a process that
    # ends while that one waits for Python is aborted.
    with open_own(path), read_errors(path):
        source = pa.OSFile(str(path), "r")
    return Overview(source, where=str(path))


class Overview:
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
            self.index = _index_of(self._file)
        except OtherVersionError:
            source.close()
            raise
        except Exception as error:  # damaged bytes may cause any error
            source.close()
            raise self._damaged(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def count(
        self,
        level: int,
        begin_ns: int | None,
        end_ns: int | None,
        axis: TimeAxis = NODE_AXIS,
    ) -> int:
        """Return about how many bins of a level are in a time range: those of its pieces."""
        return sum(self.index.pieces[i].bins for i in self._within(level, begin_ns, end_ns, axis))

    def bins(
        self,
        level: int,
        begin_ns: int | None,
        end_ns: int | None,
        axis: TimeAxis = NODE_AXIS,
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
        types = bin_columns(self.index.tiles, estimated=self.index.estimated)
        found = [{name: np.empty(0, type_) for name, type_ in types.items()}]
        for i in self._within(level, begin_ns, end_ns, axis):
            piece = on_axis(self._piece(i, list(types)), axis)
            rows = np.ones(len(piece["part"]), dtype=np.bool_)
            if begin_ns is not None:
                rows &= piece["t_last_ns"] >= begin_ns
            if end_ns is not None:
                rows &= piece["t_first_ns"] < end_ns
            found.append({name: values[rows] for name, values in piece.items()})
        return joined(found)

    def _within(
        self, level: int, begin_ns: int | None, end_ns: int | None, axis: TimeAxis
    ) -> list[int]:
        return [
            i
            for i, piece in enumerate(self.index.pieces)
            if piece.level == level
            and axis.may_overlap(piece.begin_ns, piece.end_ns, begin_ns, end_ns)
        ]

    def _piece(self, i: int, names: list[str]) -> Bins:
        try:
            batch = self._file.get_batch(i)
            bins = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in names}
        except Exception as error:  # damaged bytes may cause any error
            raise self._damaged(f"piece {i}: {error}") from error
        entry = self.index.pieces[i]
        if len(batch) != entry.bins or _crc(bins) != entry.crc:
            raise self._damaged(f"the checksum of piece {i} is wrong")
        return bins

    def _damaged(self, why: object) -> DamagedFileError:
        return DamagedFileError(
            f"is no overview: {' '.join(str(why).split())[:300]}",
            where=self._where,
            remedy="Delete it: it is made again from the frames",
        )


def _index_of(file: pa.ipc.RecordBatchFileReader) -> Index:
    """Read and verify the index in a file's metadata.

    Raises:
        ValueError: its hash is wrong, or it is of another file.
        KeyError: there is none.
    """
    metadata = file.schema.metadata or {}
    text = metadata[_KEY]
    if hashlib.sha256(text).hexdigest().encode() != metadata[_CHECK_KEY]:
        raise ValueError("its index does not match its hash")
    index = Index.from_json(text)
    if file.num_record_batches != len(index.pieces):
        raise ValueError("its index is of another number of pieces")
    return index


def _crc(bins: Bins) -> int:
    crc = 0
    for values in bins.values():
        crc = zlib.crc32(np.ascontiguousarray(values).data, crc)
    return crc
