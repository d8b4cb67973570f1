"""Data of a take: all sessions in one file, on one time axis."""

from __future__ import annotations

import hashlib
from contextlib import ExitStack
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from devices.errors import StateError
from service.api.routes.common import ServerState, has_matching_etag, problem_responses
from service.api.routes.downloads.exports import (
    Chunks,
    TakeDataQuery,
    compute_export_etag,
    export_response,
    make_file_stem,
    marker_headers,
    require_frames,
)
from service.server.server import Server
from storage.formats.markers import PlacedMarkers
from storage.formats.sealed_export import make_sealed_export, place_session_markers
from storage.formats.writers.registry import FORMATS, MULTI_SESSION_FORMATS
from storage.sessions.folder import Session

router = APIRouter(prefix="/takes", tags=["data"])


@router.get(
    "/{take_id}/data",
    operation_id="getTakeData",
    summary="Download all of a take as one file",
    response_class=Response,
    responses={
        200: {
            "description": "The data.",
            "content": {FORMATS[name].media_type: {} for name in MULTI_SESSION_FORMATS},
        },
        304: {"description": "Unchanged."},
        **problem_responses(
            _404="No such take, or one of its sessions has no frames.",
            _409="One of its sessions is not sealed.",
            _422="A format for one session only, or a session that cannot be in it.",
        ),
    },
)
async def get_take_data(
    take_id: str, query: Annotated[TakeDataQuery, Query()], request: Request, server: ServerState
) -> Response:
    """Return the sessions of a take on the server's time axis, each with its uncertainty.

    They are in the order of their nodes, without those in the trash. Seconds count from each
    session's first frame. `Foottile-Complete` is `lossy` if one of the sessions is.
    """
    to = query.format_spec
    sessions = [require_frames(session) for session in server.takes.get_take(take_id).sessions]
    for session in sessions:
        if session.sha256 is None:
            raise StateError(
                f"session {session.id} of {session.node} is {session.state}, and {to.title} of a "
                "take is available when all of it is sealed",
                remedy="Stop it, or ask for each session by itself",
            )
    is_lossy = any(server.recorder.get_ledger(session.id).lossy for session in sessions)
    tags = [await compute_export_etag(session, query, server) for session in sessions]
    tag = hashlib.sha256("|".join(tags).encode()).hexdigest()
    headers = {
        "Foottile-Complete": "lossy" if is_lossy else "true",
        "ETag": f'"{tag}"',
        "Cache-Control": "private, no-cache",
        "Accept-Ranges": "none",
    }
    if has_matching_etag(request, tag):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    markers = None
    if query.has_markers:
        markers = [
            await run_in_threadpool(_place_markers, each, query, server) for each in sessions
        ]
        headers |= marker_headers(markers)
    chunks = _write_exports(sessions, query, server, markers)
    stem = make_file_stem(sessions[0].name, f"take-{take_id}", query.slice)
    return await export_response(chunks, query, stem, headers)


def _place_markers(session: Session, query: TakeDataQuery, server: Server) -> PlacedMarkers:
    with server.sessions.open_frames(session.id, only_slices=True) as reader:
        return place_session_markers(reader, session.markers, query.slice)


def _write_exports(
    sessions: list[Session],
    query: TakeDataQuery,
    server: Server,
    markers: list[PlacedMarkers] | None,
) -> Chunks:
    part = query.slice
    with ExitStack() as opened:
        exports = [
            make_sealed_export(
                opened.enter_context(
                    server.sessions.open_frames(session.id, only_slices=not part.is_unrestricted)
                ),
                part,
                clock=query.clock_name,
                markers=None if markers is None else markers[number],
                options=query.options,
            )
            for number, session in enumerate(sessions)
        ]
        yield from query.format_spec.encode_together(exports)
