"""Data of a session: the sealed file as stored, or a file made on request."""

from __future__ import annotations

import re
from base64 import b64encode
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders

from devices.errors import StateError
from service.api.problems import problem
from service.api.routes.access import ServerState, file_answer, has_it, present, problems
from service.api.routes.downloads.data_query import DataQuery
from service.api.routes.downloads.made import (
    Chunks,
    file_stem,
    known,
    made,
    said_of_marks,
    tag_of_made,
)
from service.server.server import Server
from service.sessions.frames import SessionFrames
from service.sessions.frames_so_far import FramesSoFar
from service.sessions.so_far import SoFar
from storage.formats.export import Export
from storage.formats.marks import TIMES, Marks, place
from storage.formats.sealed import export_of, marks_of
from storage.formats.slice import Slice
from storage.formats.written.parquet import PARQUET
from storage.formats.written.registry import FORMATS
from storage.sessions.folder import FRAMES_NAME, Session

router = APIRouter(prefix="/sessions", tags=["data"])

_CHUNK = 256 << 10  # three times the default's throughput (performance.md)
_SINGLE_RANGE = re.compile(r"bytes=(?:(\d{1,18})-(\d{0,18})|-(\d{1,18}))")
_YEAR_S = 31_536_000
MEDIA_TYPES = [each.media_type for each in FORMATS.values()]


@router.get(
    "/{session_id}/data",
    operation_id="getData",
    summary="Download",
    response_class=Response,
    responses={
        200: {
            "description": "The data.",
            "content": {media_type.split(";")[0]: {} for media_type in MEDIA_TYPES},
        },
        206: {"description": "A range of the stored file."},
        304: {"description": "Unchanged."},
        **problems(
            _404="No such session, or nothing was recorded.",
            _409="This format needs a sealed session.",
            _416="The range is outside the file.",
            _422="No such format or column, or a slice outside the session.",
        ),
    },
)
async def data(
    session_id: str,
    query: Annotated[DataQuery, Query()],
    request: Request,
    server: ServerState,
) -> Response:
    """Return a session in a selected format; `GET /formats` lists them.

    Parquet without slice, columns, server's clock or marks is the stored file: with ranges, a
    strong ETag that is its SHA-256, and a digest. Any other file is made on request and streamed;
    while a session is recorded it has the present frames. `Foottile-Complete` states whether frames
    are missing, `Foottile-Marks` the number of markers in it and of markers left out.
    """
    session = known(server.sessions.get(session_id))
    ledger = server.recorder.ledger(session_id)
    complete = "lossy" if ledger.lossy else str(ledger.complete).lower()
    headers = {"Foottile-Complete": complete}
    if session.state != "sealed" and query.to.needs_sealed:
        others = [each.name for each in FORMATS.values() if not each.needs_sealed]
        raise StateError(
            f"session {session_id} is {session.state}, and {query.to.title} is available when it "
            "is sealed",
            remedy=f"Stop it, or ask for format={' or '.join(others)}",
        )
    if session.sha256 is not None and query.is_stored:
        return _stored(session, session.sha256, request, server, headers)
    return await _made(session, query, request, server, headers)


def _stored(
    session: Session, sha256: str, request: Request, server: Server, headers: dict[str, str]
) -> Response:
    path = present(server.sessions.folder.path(session.id) / FRAMES_NAME)
    headers |= {
        "ETag": f'"{sha256}"',
        "Cache-Control": f"private, max-age={_YEAR_S}, immutable",
        "Repr-Digest": f"sha-256=:{b64encode(bytes.fromhex(sha256)).decode()}:",
    }
    if has_it(request, sha256):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    size = path.stat().st_size
    wanted = request.headers.get("range")
    if wanted is not None:
        found = _SINGLE_RANGE.fullmatch(wanted.replace(" ", ""))
        if found is None or (found[2] and found[1] and int(found[2]) < int(found[1])):
            # RFC 9110 14.2: an invalid range, or several, are ignored.
            del MutableHeaders(scope=request.scope)["range"]
        elif (found[1] and int(found[1]) >= size) or found[3] == "0":
            return problem(
                request.url.path,
                HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
                f"the range {wanted[:80]!r} is outside the file's {size} bytes",
                {"Content-Range": f"bytes */{size}"},
            )
    answer = file_answer(
        path,
        headers=headers,
        media_type=PARQUET.media_type,
        filename=f"{file_stem(session.name, session.id, Slice())}.parquet",
    )
    answer.chunk_size = _CHUNK
    return answer


async def _made(
    session: Session, query: DataQuery, request: Request, server: Server, headers: dict[str, str]
) -> Response:
    tag = await tag_of_made(session, query, server)
    weak = "" if session.sha256 is not None else "W/"
    headers |= {"ETag": f'{weak}"{tag}"'}
    headers |= {"Cache-Control": "private, no-cache", "Accept-Ranges": "none"}
    if has_it(request, tag):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    marks = None
    if query.has_marks:
        marks = await run_in_threadpool(_marks, session, query, server)
        headers |= said_of_marks([marks])
    stem = file_stem(session.name, session.id, query.slice)
    return await made(_chunks(session, query, server, marks), query, stem, headers)


def _marks(session: Session, query: DataQuery, server: Server) -> Marks:
    if not session.events:
        return Marks(())
    if session.sha256 is not None:
        with server.sessions.frames(session.id, only_slices=True) as reader:
            return marks_of(reader, session.events, query.slice)
    sources = server.recorder.sources(session.id)
    times = (
        {name: getattr(frames, name) for name in TIMES} | {"part": columns["part"]}
        for frames, columns in SessionFrames(sources).raw()
    )
    axis = sources.time_axis()
    return place(session.events, times, sources.clock_table(), query.slice, axis=axis)


def _chunks(session: Session, query: DataQuery, server: Server, marks: Marks | None) -> Chunks:
    if session.sha256 is None:
        sources = server.recorder.sources(session.id)
        clock = sources.clock_table() if query.clock == "server" else None
        # A whole session is estimated once: no cached preview is needed.
        is_some, so_fars = query.slice.is_some, server.so_fars
        so_far = so_fars.nearly(sources) if is_some else SoFar(sources, server.data)
        frames = FramesSoFar(so_far, sources, query.slice)
        source = {"session": session.id, "state": session.state}
        content = frames.content()  # reads the first frames, which sets `notes`
        yield from query.to.written(
            Export(
                content,
                sources.info,
                frames.notes,
                query.slice,
                clock,
                marks,
                source,
                query.options,
            )
        )
        return
    with server.sessions.frames(session.id, only_slices=not query.slice.is_all) as reader:
        export = export_of(
            reader, query.slice, clock=query.clock, marks=marks, options=query.options
        )
        yield from query.to.written(export)
