"""Route of a session's clocks: offset, drift and steps against the server's clock."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter, Response
from starlette.concurrency import run_in_threadpool

from service.api.routes.common import (
    ServerState,
    problem_responses,
    require_file,
    stored_table_response,
)
from service.server.server import Server
from storage.clock.file import CLOCK_NAME
from storage.clock.table import ClockSummary
from storage.formats.writers.parquet import PARQUET
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.sidecars import load_clock_table

router = APIRouter(prefix="/sessions", tags=["sessions"])

_PARQUET = PARQUET.media_type


@router.get(
    "/{session_id}/clock",
    operation_id="getClock",
    summary="Clocks",
    response_model=ClockSummary,
    responses={
        200: {"description": "Summary, or the stored table.", "content": {_PARQUET: {}}},
        **problem_responses(
            _404="No such session, or its clock table is missing.",
            _409="The table is written when the session is sealed.",
        ),
    },
)
async def get_clock(
    session_id: str,
    server: ServerState,
    format: Literal["json", "parquet"] = "json",  # noqa: A002  # the query's name
) -> ClockSummary | Response:
    """Return offset and drift of every stream between steps; up to now while recording.

    `format=parquet` is `clock.parquet`, the stored measurements.
    """
    session = server.sessions.get_session(session_id)
    if format == "parquet":
        return stored_table_response(
            session, server.sessions.folder.get_path(session_id) / CLOCK_NAME
        )
    if session.sha256 is None:
        table = server.recorder.collect_inputs(session_id).make_clock_table()
        return await run_in_threadpool(table.summarize_streams)
    return await run_in_threadpool(_read_sealed, session_id, server)


def _read_sealed(session_id: str, server: Server) -> ClockSummary:
    for name in (CLOCK_NAME, FRAMES_NAME):
        require_file(server.sessions.folder.get_path(session_id) / name)
    with server.sessions.open_frames(session_id) as reader:
        return load_clock_table(reader).summarize_streams()
