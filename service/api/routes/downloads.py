"""Downloads: a session's sealed file as stored, a file made on request, several sessions as a zip.

Files in a zip are stored, not deflated: Parquet is compressed already. The directory of a zip file
is its end. If a session is damaged or removed meanwhile, the directory is never sent, so that no
program opens the incomplete archive.
"""

from __future__ import annotations

import hashlib
import time
import zipfile
from collections.abc import Generator, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from devices.errors import DamagedFileError, StorageError, UsageError
from service.api.routes.common import (
    UNCHANGED,
    ServerState,
    problem_responses,
    require_file,
    require_frames,
    require_sealed,
    stored_file_response,
)
from service.api.routes.exports import (
    Chunks,
    DataQuery,
    iterate_chunks,
    make_file_stem,
    respond_with_export,
)
from service.server.server import Server
from service.sessions.preview import SessionPreview
from service.sessions.preview_frames import PreviewFrames
from storage.clock.table import CLOCK_NAME
from storage.formats.export import Export, make_sealed_export
from storage.formats.markers import PlacedMarkers
from storage.formats.slice import Slice
from storage.formats.writers.format import DrainedBuffer
from storage.formats.writers.registry import FORMATS
from storage.formats.writers.tables import PARQUET
from storage.sessions.folder import FRAMES_NAME, WARM_UP_NAME, Session
from storage.sessions.metadata import MARKERS_NAME, SESSION_NAME, SUMS_NAME
from storage.sessions.stances import STANCES_NAME

router = APIRouter(prefix="/sessions", tags=["data"])

MEDIA_TYPES = [each.media_type for each in FORMATS.values()]


@router.get(
    "/{session_id}/data",
    summary="Download",
    response_class=Response,
    responses=problem_responses(
        {
            200: {
                "description": "The data.",
                "content": {media_type.split(";")[0]: {} for media_type in MEDIA_TYPES},
            },
            206: {"description": "A range of the stored file."},
        },
        UNCHANGED,
        _404="No such session, or nothing was recorded.",
        _409="This format needs a sealed session.",
        _416="The range is outside the file.",
        _422="No such format or column, or a slice outside the session.",
    ),
)
async def get_data(
    session_id: str, query: Annotated[DataQuery, Query()], request: Request, server: ServerState
) -> Response:
    """Return a session in a selected format; `GET /formats` lists them.

    Parquet without slice, columns, server's clock or markers is the stored file: with ranges, a
    strong ETag that is its SHA-256, and a digest. Any other file is made on request and streamed;
    while a session is recorded it has the present frames. `Foottile-Complete` states whether frames
    are missing, `Foottile-Markers` the number of markers in it and of markers left out,
    `Foottile-Remarks` the gaps that a format without unknown values filled, and rows left out.
    """
    session = require_frames(server.sessions.get_session(session_id))
    ledger = server.recorder.get_ledger(session_id)
    complete = "lossy" if ledger.lossy else str(ledger.complete).lower()
    headers = {"Foottile-Complete": complete}
    if query.format_spec.needs_sealed:
        others = " or ".join(each.name for each in FORMATS.values() if not each.needs_sealed)
        remedy = f"Stop it, or ask for format={others}"
        require_sealed(session, f"{query.format_spec.title} is", remedy)
    if session.sha256 is not None and query.is_stored:
        return _stored_response(session, session.sha256, request, server, headers)
    return await respond_with_export(
        [session],
        [0.0],
        lambda markers, remarks: _write_export(
            session, query, server, markers[0] if markers else None, remarks
        ),
        query,
        request,
        server,
        make_file_stem(session.name, session.id, query.slice),
        headers,
    )


def _stored_response(
    session: Session, sha256: str, request: Request, server: Server, headers: dict[str, str]
) -> Response:
    return stored_file_response(
        request,
        require_file(server.sessions.folder.get_path(session.id) / FRAMES_NAME),
        sha256,
        media_type=PARQUET.media_type,
        filename=f"{make_file_stem(session.name, session.id, Slice())}.parquet",
        headers=headers,
    )


def _write_export(
    session: Session,
    query: DataQuery,
    server: Server,
    markers: PlacedMarkers | None,
    remarks: list[str],
) -> Chunks:
    if session.sha256 is None:
        sources = server.recorder.collect_inputs_from_journals(session.id)
        clock = sources.make_clock_table() if query.clock == "server" else None
        # A whole session is estimated once: no cached preview is needed.
        is_some, so_fars = query.slice.has_time_bounds, server.previews
        so_far = (
            so_fars.advance_unless_catching_up(sources)
            if is_some
            else SessionPreview(sources, server.data)
        )
        frames = PreviewFrames(so_far, sources, query.slice)
        source = {"session": session.id, "state": session.state}
        content = frames.make_one_pass_source()  # reads the first frames, which sets `notes`
        yield from query.format_spec.encode(
            Export(
                content,
                sources.info,
                frames.notes,
                query.slice,
                clock,
                markers,
                source,
                query.options,
                remarks=remarks,
            )
        )
        return
    with server.sessions.open_frames(
        session.id, only_slices=not query.slice.has_all_rows_and_columns
    ) as reader:
        export = make_sealed_export(
            reader, query.slice, clock=query.clock, markers=markers, options=query.options
        )
        yield from query.format_spec.encode(replace(export, remarks=remarks))


_ZIP_CHUNK_BYTES = 1 << 20
_ZIP_DATES_S = (315_619_200, 4_354_732_800)
"""Range of dates of a zip file: 2 January 1980 to 30 December 2107, in any time zone.

Files of 1970, from a machine without a clock, get the nearest date.
"""
_SIDECARS = (MARKERS_NAME, CLOCK_NAME, WARM_UP_NAME, STANCES_NAME, SUMS_NAME)
"""Files beside the frames. Each can be verified; without estimates there are no stances."""


@dataclass(frozen=True)
class ZippedSession:
    """Sealed session to put into a zip file."""

    folder: Path
    frames_sha256: str
    """SHA-256 of its frames' file."""


def stream_zip(sessions: Iterable[ZippedSession]) -> Generator[bytes, None, None]:
    """Yield a zip file in chunks: a folder for each session, which `foottile verify` accepts.

    Raises:
        DamagedFileError: a session's frames differ from the sealed ones.
        StorageError: a file cannot be read, or was removed.
    """
    sink = DrainedBuffer()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED, allowZip64=True) as file:
        for session in sessions:
            yield from _put(file, sink, session.folder / FRAMES_NAME, session.frames_sha256)
            for name in _SIDECARS:
                if (session.folder / name).is_file():
                    yield from _put(file, sink, session.folder / name)
            # Last: if the session is removed meanwhile, this file fails, whatever was sent before.
            yield from _put(file, sink, session.folder / SESSION_NAME)
    yield sink.drain()


def _put(
    file: zipfile.ZipFile, sink: DrainedBuffer, path: Path, sha256: str | None = None
) -> Generator[bytes, None, None]:
    found = hashlib.sha256()
    try:
        dated_s = min(max(int(path.stat().st_mtime), _ZIP_DATES_S[0]), _ZIP_DATES_S[1])
        about = zipfile.ZipInfo(f"{path.parent.name}/{path.name}", time.localtime(dated_s)[:6])
        about.external_attr = 0o644 << 16
        with path.open("rb") as source, file.open(about, "w", force_zip64=True) as entry:
            while piece := source.read(_ZIP_CHUNK_BYTES):
                found.update(piece)
                entry.write(piece)
                yield sink.drain()
    except OSError as error:
        raise StorageError(
            f"cannot be read: {error}", where=str(path), remedy="Leave this session out"
        ) from error
    if sha256 is not None and found.hexdigest() != sha256:
        raise DamagedFileError("its bytes are not those that were sealed", where=str(path))
    yield sink.drain()


zip_router = APIRouter(prefix="/sessions", tags=["data"])

IDS_MAX = 1000
"""Limit of ids: the size of a request's headers."""


@zip_router.get(
    "/zip",
    summary="Download several as one zip file",
    response_class=Response,
    responses=problem_responses(
        {
            200: {
                "description": "The files of each, in a folder.",
                "content": {"application/zip": {}},
            }
        },
        _404="No such session.",
        _409="One is not sealed yet, or its files are damaged.",
        _422="No ids, or too many.",
    ),
)
async def zip_sessions(
    ids: Annotated[
        str, Query(max_length=24 * IDS_MAX, description=f"With commas between; {IDS_MAX} at most.")
    ],
    server: ServerState,
) -> StreamingResponse:
    """Stream the files of sessions as they are: a folder each, as for `foottile verify`.

    A session that is damaged or deleted meanwhile aborts the download; the partial file opens as no
    zip file.
    """
    names = list(dict.fromkeys(name.strip() for name in ids.split(",") if name.strip()))
    if not 1 <= len(names) <= IDS_MAX:
        raise UsageError(f"{len(names)} sessions", expected=f"ids of 1 to {IDS_MAX}")
    chosen = [
        _make_zipped_session(
            server.sessions.get_session(name), server.sessions.folder.get_path(name)
        )
        for name in names
    ]
    name = names[0] if len(names) == 1 else f"foottile-{len(names)}-sessions"
    headers = {
        "Content-Disposition": f'attachment; filename="{name}.zip"',
        "Cache-Control": "private, no-store",
    }
    pieces = stream_zip(chosen)
    # The first chunk now: a damaged file is then an answer, not a broken download.
    first = await run_in_threadpool(next, pieces)
    return StreamingResponse(
        iterate_chunks(pieces, first), headers=headers, media_type="application/zip"
    )


def _make_zipped_session(session: Session, folder: Path) -> ZippedSession:
    require_frames(require_sealed(session, "a zip file of it is", "Stop it, or leave it out"))
    assert session.sha256 is not None  # noqa: S101  # it has frames
    require_file(folder / FRAMES_NAME)
    return ZippedSession(folder, session.sha256)
