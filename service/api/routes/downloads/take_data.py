"""Data of a take: all sessions in one file, on one time axis."""

from __future__ import annotations

import hashlib
from contextlib import ExitStack
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from devices.errors import StateError
from service.api.routes.access import ServerState, has_it, problems
from service.api.routes.downloads.data_query import TakeDataQuery
from service.api.routes.downloads.made import (
    Chunks,
    file_stem,
    known,
    made,
    said_of_marks,
    tag_of_made,
)
from service.server.server import Server
from storage.formats.marks import Marks
from storage.formats.sealed import export_of, marks_of
from storage.formats.written.registry import FORMATS, SEVERAL
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
            "content": {FORMATS[name].media_type: {} for name in SEVERAL},
        },
        304: {"description": "Unchanged."},
        **problems(
            _404="No such take, or one of its sessions has no frames.",
            _409="One of its sessions is not sealed.",
            _422="A format for one session only, or a session that cannot be in it.",
        ),
    },
)
async def take_data(
    take_id: str, query: Annotated[TakeDataQuery, Query()], request: Request, server: ServerState
) -> Response:
    """Return the sessions of a take on the server's time axis, each with its uncertainty.

    They are in the order of their nodes, without those in the trash. Seconds count from each
    session's first frame. `Foottile-Complete` is `lossy` if one of the sessions is.
    """
    to = query.to
    sessions = [known(session) for session in server.takes.get(take_id).sessions]
    for session in sessions:
        if session.sha256 is None:
            raise StateError(
                f"session {session.id} of {session.node} is {session.state}, and {to.title} of a "
                "take is available when all of it is sealed",
                remedy="Stop it, or ask for each session by itself",
            )
    is_lossy = any(server.recorder.ledger(session.id).lossy for session in sessions)
    tags = [await tag_of_made(session, query, server) for session in sessions]
    tag = hashlib.sha256("|".join(tags).encode()).hexdigest()
    headers = {
        "Foottile-Complete": "lossy" if is_lossy else "true",
        "ETag": f'"{tag}"',
        "Cache-Control": "private, no-cache",
        "Accept-Ranges": "none",
    }
    if has_it(request, tag):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    marks = None
    if query.has_marks:
        marks = [await run_in_threadpool(_marks, each, query, server) for each in sessions]
        headers |= said_of_marks(marks)
    chunks = _chunks(sessions, query, server, marks)
    stem = file_stem(sessions[0].name, f"take-{take_id}", query.slice)
    return await made(chunks, query, stem, headers)


def _marks(session: Session, query: TakeDataQuery, server: Server) -> Marks:
    with server.sessions.frames(session.id, only_slices=True) as reader:
        return marks_of(reader, session.events, query.slice)


def _chunks(
    sessions: list[Session], query: TakeDataQuery, server: Server, marks: list[Marks] | None
) -> Chunks:
    part = query.slice
    with ExitStack() as opened:
        exports = [
            export_of(
                opened.enter_context(
                    server.sessions.frames(session.id, only_slices=not part.is_all)
                ),
                part,
                clock=query.clock_name,
                marks=None if marks is None else marks[number],
                options=query.options,
            )
            for number, session in enumerate(sessions)
        ]
        yield from query.to.written_together(exports)
