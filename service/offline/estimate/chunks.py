"""Estimation of a long session in consecutive chunks; each continues from the previous state.

The result is bit-identical for any chunk size. After a kill, any machine continues with at most one
chunk repeated. Chunks cannot run in parallel, because each needs the model state of the one before.

A chunk consists of a sealed file of frames with estimates, `0000.parquet`, the estimator's state,
`0000.npz`, and, written last, an index with the hashes of both, `0000.json`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from devices.errors import DamagedFileError, FileFormatError
from service.estimation.records import Columns
from service.offline.estimate.estimation_range import BatchWithColumns
from service.offline.estimate.preparation import PreparedEstimate, prepare_estimate
from service.offline.estimate.request import CHUNK_FRAMES, EstimateRequest
from service.offline.estimate.session import EstimateResult, write_estimates
from service.sessions.pipeline import EstimateStream
from storage.checksummed_json import append_json_checksum, verify_and_strip_json_checksum
from storage.durable_files import open_for_atomic_write, read_small_file, write_atomically
from storage.parquet_hash import compute_sha256
from storage.schema import ESTIMATE_COLUMNS
from storage.sessions.frame_order import iterate_checking_order
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter

NEEDED_SUFFIXES = ("json", "npz")
"""Suffixes of the files that the next chunk needs; joining needs the Parquet files too."""


@dataclass(frozen=True)
class _ChunkIndex:
    """Index of a finished chunk.

    Attributes:
        number: index, from 0.
        groups: number of the session's row groups up to its end.
        frames: number of its output frames.
        sha256: hashes of its files by suffix.
    """

    number: int
    groups: int
    frames: int
    sha256: dict[str, str]


def needs_chunks(source: Path, request: EstimateRequest, chunk_frames: int) -> bool:
    """Return whether a session is longer than one chunk.

    Raises:
        FileFormatError: the file is no session.
    """
    if not request.part.is_unrestricted:
        return False
    with SealedFileReader(source, only_slices=True) as session:
        return session.frame_count > chunk_frames and len(session.footer.rows_by_group) > 1


def estimate_next_chunk(
    source: Path,
    chunks_folder: Path,
    request: EstimateRequest,
    *,
    chunk_frames: int = CHUNK_FRAMES,
    on_remark: Callable[[str], None],
) -> bool:
    """Estimate the next chunk of a session.

    Args:
        source: the session.
        chunks_folder: folder with the earlier chunks, at least their `NEEDED_SUFFIXES`; the new
            chunk is written to it.
        request: options of the estimate.
        chunk_frames: approximate number of frames; row groups are not split.
        on_remark: called with each remark.

    Returns:
        False if all chunks existed already.

    Raises:
        FootTileError: the session, scene, calibration or tare is not usable.
    """
    before = _list_finished_chunks(chunks_folder)
    done, number = (before[-1].groups if before else 0), len(before)
    with SealedFileReader(source, only_slices=bool(before)) as session:
        rows = session.footer.rows_by_group
        if done == len(rows):
            return False
        what = prepare_estimate(session, request, on_remark)
        stream = _resume_stream(what, chunks_folder, before)
        taken: list[int] = []

        def source_frames() -> Iterator[BatchWithColumns]:
            """Yield row groups until the chunk is full and a tare was found."""
            for group in range(done, len(rows)):
                is_full = sum(rows[each] for each in (*taken, group)) > chunk_frames
                if taken and is_full and stream.plan is not None:
                    return
                taken.append(group)
                yield from session.read_batches(*what.kept_columns, row_groups=[group])

        def yield_estimates() -> Iterator[BatchWithColumns]:
            yield from stream.estimate_batches(
                iterate_checking_order(source_frames(), where=str(source)), is_final=False
            )
            if done + len(taken) == len(rows):
                yield from stream.estimate_batches((), is_final=True)

        frames = _write_frames(chunks_folder / f"{number:04}.parquet", what, yield_estimates())
    with open_for_atomic_write(chunks_folder / f"{number:04}.npz") as file:
        np.savez(file, allow_pickle=False, **stream.state_dict())
    made = _ChunkIndex(number, done + len(taken), frames, {})
    made.sha256.update(
        {
            end: compute_sha256(chunks_folder / f"{number:04}.{end}")
            for end in _list_suffixes(made)
            if end != "json"
        }
    )
    text = append_json_checksum(json.dumps(vars(made)).encode())
    write_atomically(chunks_folder / f"{number:04}.json", text)
    return True


def join_chunks(
    source: Path,
    chunks_folder: Path,
    out: Path,
    request: EstimateRequest,
    *,
    on_remark: Callable[[str], None],
) -> EstimateResult:
    """Join all chunks into one session, identical to the output of `estimate_session`.

    Raises:
        FootTileError: as for `estimate_session`; or a chunk is damaged.
    """
    pieces = _list_finished_chunks(chunks_folder)
    with SealedFileReader(source, only_slices=True) as session:
        if not pieces or pieces[-1].groups != len(session.footer.rows_by_group):
            raise FileFormatError("chunks are missing", where=str(chunks_folder))
        what = prepare_estimate(session, request, on_remark)
        stream = _resume_stream(what, chunks_folder, pieces)
        ordered = iterate_checking_order(
            _read_chunks(what, chunks_folder, pieces), where=str(source)
        )
        frames = write_estimates(out, what, session.notes, stream, ordered, on_remark)
        begin_t_ns = session.read_span_ns()[0]
    assert stream.plan is not None  # noqa: S101  # it goes on with one
    return EstimateResult(frames, stream.plan, begin_t_ns)


def _write_frames(path: Path, what: PreparedEstimate, given: Iterator[BatchWithColumns]) -> int:
    first = next(given, None)
    if first is None:  # no output yet: the look-ahead is longer than the chunk
        return 0
    frames = 0
    with SealedFileWriter(path, what.info, {}) as writer:
        for batch, extra in chain((first,), given):
            writer.append_frames(batch, extra)
            frames += len(batch)
    return frames


def _read_chunks(
    what: PreparedEstimate, folder: Path, pieces: list[_ChunkIndex]
) -> Iterator[BatchWithColumns]:
    names = (*what.kept_columns, *(column.name for column in ESTIMATE_COLUMNS))
    for piece in pieces:
        if piece.frames:
            with SealedFileReader(_verify_file(folder, piece, "parquet")) as session:
                yield from session.read_batches(*names)


def _resume_stream(
    what: PreparedEstimate, folder: Path, before: list[_ChunkIndex]
) -> EstimateStream:
    stream = EstimateStream(what.info, what.options)
    if before:
        path = _verify_file(folder, before[-1], "npz")
        with np.load(path, allow_pickle=False) as kept:
            columns: Columns = dict(kept)
        try:
            stream.load_state(columns)
        except (KeyError, ValueError) as error:
            raise DamagedFileError(f"is of another session: {error}", where=str(path)) from error
    return stream


def _list_finished_chunks(folder: Path) -> list[_ChunkIndex]:
    """Return the finished chunks from the first one to the first gap."""
    found: list[_ChunkIndex] = []
    while True:
        path = folder / f"{len(found):04}.json"
        try:
            index: dict[str, Any] = json.loads(
                verify_and_strip_json_checksum(read_small_file(path), where=str(path))
            )
        except FileNotFoundError:
            return found
        found.append(_ChunkIndex(**index))


def _verify_file(folder: Path, piece: _ChunkIndex, ending: str) -> Path:
    path = folder / f"{piece.number:04}.{ending}"
    try:
        is_same = compute_sha256(path) == piece.sha256[ending]
    except FileNotFoundError:
        is_same = False
    if not is_same:
        raise DamagedFileError(
            "a chunk of a session has another hash than its index states",
            where=str(path),
            remedy="Delete its folder; the session is then estimated from its begin",
        )
    return path


def _list_suffixes(piece: _ChunkIndex) -> tuple[str, ...]:
    return (*NEEDED_SUFFIXES, "parquet") if piece.frames else NEEDED_SUFFIXES
