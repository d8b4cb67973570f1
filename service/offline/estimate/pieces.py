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
from service.offline.estimate.prepared import Prepared, prepared
from service.offline.estimate.request import PIECE_FRAMES, EstimateRequest
from service.offline.estimate.session import Estimated, write_estimated
from service.offline.estimate.stretch import Piece
from service.sessions.pipeline import EstimateStream
from storage.checked_json import checked, with_check
from storage.durable import read_whole, whole_file, write_whole
from storage.file_hash import sha256_of
from storage.schema import ESTIMATES
from storage.sessions.file import SessionWriter
from storage.sessions.frame_order import in_order
from storage.sessions.reader import SessionReader

NAMES = ("json", "npz")
"""Suffixes of the files that the next chunk needs; joining needs the Parquet files too."""


@dataclass(frozen=True)
class _Done:
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


def has_pieces(source: Path, request: EstimateRequest, piece_frames: int) -> bool:
    """Return whether a session is longer than one chunk.

    Raises:
        FileFormatError: the file is no session.
    """
    if not request.part.is_all:
        return False
    with SessionReader(source, only_slices=True) as session:
        return session.frame_count > piece_frames and len(session.footer.group_rows) > 1


def make_piece(
    source: Path,
    folder: Path,
    request: EstimateRequest,
    *,
    piece_frames: int = PIECE_FRAMES,
    remark: Callable[[str], None],
) -> bool:
    """Estimate the next chunk of a session.

    Args:
        source: the session.
        folder: folder with the earlier chunks, at least their `NAMES`; the new
            chunk is written to it.
        request: options of the estimate.
        piece_frames: approximate number of frames; row groups are not split.
        remark: called with each remark.

    Returns:
        False if all chunks existed already.

    Raises:
        FootTileError: the session, scene, calibration or tare is not usable.
    """
    before = _pieces_in(folder)
    done, number = (before[-1].groups if before else 0), len(before)
    with SessionReader(source, only_slices=bool(before)) as session:
        rows = session.footer.group_rows
        if done == len(rows):
            return False
        what = prepared(session, request, remark)
        stream = _going_on(what, folder, before)
        taken: list[int] = []

        def source_frames() -> Iterator[Piece]:
            """Yield row groups until the chunk is full and a tare was found."""
            for group in range(done, len(rows)):
                is_full = sum(rows[each] for each in (*taken, group)) > piece_frames
                if taken and is_full and stream.plan is not None:
                    return
                taken.append(group)
                yield from session.batches(*what.kept, groups=[group])

        def given() -> Iterator[Piece]:
            yield from stream.run(in_order(source_frames(), where=str(source)), ends=False)
            if done + len(taken) == len(rows):
                yield from stream.run((), ends=True)

        frames = _write(folder / f"{number:04}.parquet", what, given())
    with whole_file(folder / f"{number:04}.npz") as file:
        np.savez(file, allow_pickle=False, **stream.kept())
    made = _Done(number, done + len(taken), frames, {})
    made.sha256.update(
        {end: sha256_of(folder / f"{number:04}.{end}") for end in _endings(made) if end != "json"}
    )
    text = with_check(json.dumps(vars(made)).encode())
    write_whole(folder / f"{number:04}.json", text)
    return True


def join_pieces(
    source: Path,
    folder: Path,
    out: Path,
    request: EstimateRequest,
    *,
    remark: Callable[[str], None],
) -> Estimated:
    """Join all chunks into one session, identical to the output of `estimate_session`.

    Raises:
        FootTileError: as for `estimate_session`; or a chunk is damaged.
    """
    pieces = _pieces_in(folder)
    with SessionReader(source, only_slices=True) as session:
        if not pieces or pieces[-1].groups != len(session.footer.group_rows):
            raise FileFormatError("chunks are missing", where=str(folder))
        what = prepared(session, request, remark)
        stream = _going_on(what, folder, pieces)
        ordered = in_order(_read(what, folder, pieces), where=str(source))
        frames = write_estimated(out, what, session.notes, stream, ordered, remark)
        begin_t_ns = session.span_ns()[0]
    assert stream.plan is not None  # noqa: S101  # it goes on with one
    return Estimated(frames, stream.plan, begin_t_ns)


def _write(path: Path, what: Prepared, given: Iterator[Piece]) -> int:
    first = next(given, None)
    if first is None:  # no output yet: the look-ahead is longer than the chunk
        return 0
    frames = 0
    with SessionWriter(path, what.info, {}) as writer:
        for batch, extra in chain((first,), given):
            writer.append(batch, extra)
            frames += len(batch)
    return frames


def _read(what: Prepared, folder: Path, pieces: list[_Done]) -> Iterator[Piece]:
    names = (*what.kept, *(column.name for column in ESTIMATES))
    for piece in pieces:
        if piece.frames:
            with SessionReader(_proven(folder, piece, "parquet")) as session:
                yield from session.batches(*names)


def _going_on(what: Prepared, folder: Path, before: list[_Done]) -> EstimateStream:
    stream = EstimateStream(what.info, what.options)
    if before:
        path = _proven(folder, before[-1], "npz")
        with np.load(path, allow_pickle=False) as kept:
            columns: Columns = dict(kept)
        try:
            stream.go_on(columns)
        except (KeyError, ValueError) as error:
            raise DamagedFileError(f"is of another session: {error}", where=str(path)) from error
    return stream


def _pieces_in(folder: Path) -> list[_Done]:
    """Return the finished chunks from the first one to the first gap."""
    found: list[_Done] = []
    while True:
        path = folder / f"{len(found):04}.json"
        try:
            index: dict[str, Any] = json.loads(checked(read_whole(path), where=str(path)).text)
        except FileNotFoundError:
            return found
        found.append(_Done(**index))


def _proven(folder: Path, piece: _Done, ending: str) -> Path:
    path = folder / f"{piece.number:04}.{ending}"
    try:
        is_same = sha256_of(path) == piece.sha256[ending]
    except FileNotFoundError:
        is_same = False
    if not is_same:
        raise DamagedFileError(
            "a chunk of a session has another hash than its index states",
            where=str(path),
            remedy="Delete its folder; the session is then estimated from its begin",
        )
    return path


def _endings(piece: _Done) -> tuple[str, ...]:
    return (*NAMES, "parquet") if piece.frames else NAMES
