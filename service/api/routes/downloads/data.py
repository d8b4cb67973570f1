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
from service.api.problems import problem_response
from service.api.routes.common import (
    ServerState,
    file_response,
    has_matching_etag,
    problem_responses,
    require_file,
)
from service.api.routes.downloads.exports import (
    Chunks,
    DataQuery,
    compute_export_etag,
    export_response,
    make_file_stem,
    marker_headers,
    require_frames,
)
from service.server.server import Server
from service.sessions.inputs import SessionFrames
from service.sessions.preview import SessionPreview
from service.sessions.preview_frames import PreviewFrames
from storage.formats.export import Export, make_sealed_export
from storage.formats.markers import (
    PLACEMENT_COLUMNS,
    PlacedMarkers,
    place_markers,
    place_session_markers,
)
from storage.formats.slice import Slice
from storage.formats.writers.registry import FORMATS
from storage.formats.writers.tables import PARQUET
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
        **problem_responses(
            _404="No such session, or nothing was recorded.",
            _409="This format needs a sealed session.",
            _416="The range is outside the file.",
            _422="No such format or column, or a slice outside the session.",
        ),
    },
)
async def get_data(
    session_id: str,
    query: Annotated[DataQuery, Query()],
    request: Request,
    server: ServerState,
) -> Response:
    """Return a session in a selected format; `GET /formats` lists them.

    Parquet without slice, columns, server's clock or markers is the stored file: with ranges, a
    strong ETag that is its SHA-256, and a digest. Any other file is made on request and streamed;
    while a session is recorded it has the present frames. `Foottile-Complete` states whether frames
    are missing, `Foottile-Markers` the number of markers in it and of markers left out.
    """
    session = require_frames(server.sessions.get_session(session_id))
    ledger = server.recorder.get_ledger(session_id)
    complete = "lossy" if ledger.lossy else str(ledger.complete).lower()
    headers = {"Foottile-Complete": complete}
    if session.state != "sealed" and query.format_spec.needs_sealed:
        others = [each.name for each in FORMATS.values() if not each.needs_sealed]
        raise StateError(
            f"session {session_id} is {session.state}, and {query.format_spec.title} is available "
            "when it is sealed",
            remedy=f"Stop it, or ask for format={' or '.join(others)}",
        )
    if session.sha256 is not None and query.is_stored:
        return _stored_response(session, session.sha256, request, server, headers)
    return await _export_response(session, query, request, server, headers)


def _stored_response(
    session: Session, sha256: str, request: Request, server: Server, headers: dict[str, str]
) -> Response:
    path = require_file(server.sessions.folder.get_path(session.id) / FRAMES_NAME)
    headers |= {
        "ETag": f'"{sha256}"',
        "Cache-Control": f"private, max-age={_YEAR_S}, immutable",
        "Repr-Digest": f"sha-256=:{b64encode(bytes.fromhex(sha256)).decode()}:",
    }
    if has_matching_etag(request, sha256):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    size = path.stat().st_size
    wanted = request.headers.get("range")
    if wanted is not None:
        found = _SINGLE_RANGE.fullmatch(wanted.replace(" ", ""))
        if found is None or (found[2] and found[1] and int(found[2]) < int(found[1])):
            # RFC 9110 14.2: an invalid range, or several, are ignored.
            del MutableHeaders(scope=request.scope)["range"]
        elif (found[1] and int(found[1]) >= size) or found[3] == "0":
            return problem_response(
                request.url.path,
                HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
                f"the range {wanted[:80]!r} is outside the file's {size} bytes",
                {"Content-Range": f"bytes */{size}"},
            )
    answer = file_response(
        path,
        headers=headers,
        media_type=PARQUET.media_type,
        filename=f"{make_file_stem(session.name, session.id, Slice())}.parquet",
    )
    answer.chunk_size = _CHUNK
    return answer


async def _export_response(
    session: Session, query: DataQuery, request: Request, server: Server, headers: dict[str, str]
) -> Response:
    tag = await compute_export_etag(session, query, server)
    weak = "" if session.sha256 is not None else "W/"
    headers |= {"ETag": f'{weak}"{tag}"'}
    headers |= {"Cache-Control": "private, no-cache", "Accept-Ranges": "none"}
    if has_matching_etag(request, tag):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    markers = None
    if query.has_markers:
        markers = await run_in_threadpool(_place_markers, session, query, server)
        headers |= marker_headers([markers])
    stem = make_file_stem(session.name, session.id, query.slice)
    return await export_response(
        _write_export(session, query, server, markers), query, stem, headers
    )


def _place_markers(session: Session, query: DataQuery, server: Server) -> PlacedMarkers:
    if not session.markers:
        return PlacedMarkers(())
    if session.sha256 is not None:
        with server.sessions.open_frames(session.id, only_slices=True) as reader:
            return place_session_markers(reader, session.markers, query.slice)
    sources = server.recorder.collect_inputs_from_journals(session.id)
    times = (
        {name: getattr(frames, name) for name in PLACEMENT_COLUMNS} | {"part": columns["part"]}
        for frames, columns in SessionFrames(sources).iterate_raw_with_part()
    )
    axis = sources.compute_time_axis()
    return place_markers(session.markers, times, sources.make_clock_table(), query.slice, axis=axis)


def _write_export(
    session: Session, query: DataQuery, server: Server, markers: PlacedMarkers | None
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
            )
        )
        return
    with server.sessions.open_frames(
        session.id, only_slices=not query.slice.has_all_rows_and_columns
    ) as reader:
        export = make_sealed_export(
            reader, query.slice, clock=query.clock, markers=markers, options=query.options
        )
        yield from query.format_spec.encode(export)
