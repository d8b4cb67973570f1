"""Route of a session's clocks: offset, drift and steps against the server's clock."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter, Response
from starlette.concurrency import run_in_threadpool

from service.api.routes.access import ServerState, present, problems, stored_table
from service.server.server import Server
from storage.clock.file import CLOCK_NAME
from storage.clock.table import ClockSummary
from storage.formats.written.parquet import PARQUET
from storage.sessions.beside import clock_beside
from storage.sessions.folder import FRAMES_NAME

router = APIRouter(prefix="/sessions", tags=["sessions"])

_PARQUET = PARQUET.media_type


@router.get(
    "/{session_id}/clock",
    operation_id="getClock",
    summary="Clocks",
    response_model=ClockSummary,
    responses={
        200: {"description": "Summary, or the stored table.", "content": {_PARQUET: {}}},
        **problems(
            _404="No such session, or its clock table is missing.",
            _409="The table is written when the session is sealed.",
        ),
    },
)
async def clock(
    session_id: str,
    server: ServerState,
    format: Literal["json", "parquet"] = "json",  # noqa: A002  # the query's name
) -> ClockSummary | Response:
    """Return offset and drift of every stream between steps; up to now while recording.

    `format=parquet` is `clock.parquet`, the stored measurements.
    """
    session = server.sessions.get(session_id)
    if format == "parquet":
        return stored_table(session, server.sessions.folder.path(session_id) / CLOCK_NAME)
    if session.sha256 is None:
        table = server.recorder.sources(session_id).clock_table()
        return await run_in_threadpool(table.summary)
    return await run_in_threadpool(_sealed, session_id, server)


def _sealed(session_id: str, server: Server) -> ClockSummary:
    for name in (CLOCK_NAME, FRAMES_NAME):
        present(server.sessions.folder.path(session_id) / name)
    with server.sessions.frames(session_id) as reader:
        return clock_beside(reader).summary()
