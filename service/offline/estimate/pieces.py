"""A long session in pieces: each goes on with the state that the one before has kept.

Any cut gives the same bits, so what is joined in the end is what one process would have made; and
whoever takes the session up after a kill, on whichever machine, has one piece to do again. Pieces
follow one another: no model can begin before what it remembers is there.

A piece is a sealed file of its frames with their estimates, `0000.parquet`, what its stream
remembers, `0000.npz`, and last, naming both by their hashes, `0000.json`.
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
"""What the next piece needs of those before; to join them their frames are needed as well."""


@dataclass(frozen=True)
class _Done:
    """A piece that is there.

    Attributes:
        number: from 0.
        groups: row groups of the session up to its end.
        frames: that it gives.
        sha256: of its files by their endings.
    """

    number: int
    groups: int
    frames: int
    sha256: dict[str, str]


def has_pieces(source: Path, request: EstimateRequest, piece_frames: int) -> bool:
    """Is a session worth more than one piece?

    Raises:
        FileFormatError: it is none.
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
    """Estimate the next piece of a session.

    Args:
        source: the session.
        folder: has the pieces before, or what `NAMES` says of them, and gets this one.
        request: how.
        piece_frames: of a piece, about: row groups are not cut.
        remark: told what is worth knowing.

    Returns:
        Whether there was one left.

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
            """Row groups until the piece is full; and on until there is a tare, however late."""
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
    """Write the session of which all pieces are there, as `estimate_session` would have.

    Raises:
        FootTileError: as for `estimate_session`; or a piece is damaged.
    """
    pieces = _pieces_in(folder)
    with SessionReader(source, only_slices=True) as session:
        if not pieces or pieces[-1].groups != len(session.footer.group_rows):
            raise FileFormatError("not all pieces are there", where=str(folder))
        what = prepared(session, request, remark)
        stream = _going_on(what, folder, pieces)
        ordered = in_order(_read(what, folder, pieces), where=str(source))
        frames = write_estimated(out, what, session.notes, stream, ordered, remark)
        begin_t_ns = session.span_ns()[0]
    assert stream.plan is not None  # noqa: S101  # it goes on with one
    return Estimated(frames, stream.plan, begin_t_ns)


def _write(path: Path, what: Prepared, given: Iterator[Piece]) -> int:
    first = next(given, None)
    if first is None:  # all still wait: the look-ahead is longer than the piece
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
    """Those that follow one another from the first on."""
    found: list[_Done] = []
    while True:
        path = folder / f"{len(found):04}.json"
        try:
            said: dict[str, Any] = json.loads(checked(read_whole(path), where=str(path)).text)
        except FileNotFoundError:
            return found
        found.append(_Done(**said))


def _proven(folder: Path, piece: _Done, ending: str) -> Path:
    path = folder / f"{piece.number:04}.{ending}"
    try:
        is_same = sha256_of(path) == piece.sha256[ending]
    except FileNotFoundError:
        is_same = False
    if not is_same:
        raise DamagedFileError(
            "a piece of a session is not the one that was made",
            where=str(path),
            remedy="Delete its folder: the session is begun again",
        )
    return path


def _endings(piece: _Done) -> tuple[str, ...]:
    return (*NAMES, "parquet") if piece.frames else NAMES
