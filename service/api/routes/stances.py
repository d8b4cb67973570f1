"""Stances of a sealed session: when the foot stood, and how hard."""

from __future__ import annotations

from typing import Annotated, Any

import pyarrow as pa
from fastapi import APIRouter, Header, Response
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from devices.errors import StateError, UnknownError
from service.api.routes.access import ServerState, problems
from service.sessions.stances import stances_of_session
from storage.formats.export import MEDIA_TYPES

router = APIRouter(prefix="/sessions", tags=["sessions"])

_ARROW = MEDIA_TYPES["arrow"]


class StanceView(BaseModel):
    """One stance (docs/formats.md); what is not known is null."""

    number: int
    part: int
    begin_t_ns: int
    end_t_ns: int
    duration_s: float
    peak_grf_n: float | None
    peak_t_ns: int | None
    peak_sigma_n: float | None
    impulse_n_s: float | None
    cop_x_first_m: float | None
    cop_x_last_m: float | None
    cop_x_range_m: float | None
    frames: int
    unknown_frames: int
    missing_frames: int
    estimate_status: int
    begun: bool
    ended: bool
    is_whole: bool


@router.get(
    "/{session_id}/stances",
    operation_id="getStances",
    summary="Stances",
    response_model=list[StanceView],
    responses={
        200: {"description": "All stances, in their order.", "content": {_ARROW: {}}},
        **problems(
            _404="No such session, nothing was recorded, or it has no estimates.",
            _409="Stances are counted when the session is sealed.",
        ),
    },
)
async def stances(
    session_id: str,
    server: ServerState,
    accept: Annotated[str, Header(description="The Arrow media type for an Arrow stream.")] = "",
) -> Response | list[dict[str, Any]]:
    """Stances as JSON, or as an Arrow stream if `Accept` names its media type.

    Of a session that was sealed before there were any they are made from its frames.
    """
    session = server.sessions.get(session_id)
    if session.state != "sealed":
        raise StateError(
            f"session {session_id} is {session.state}, and its stances are counted when it is "
            "sealed",
            remedy="Stop it",
        )
    if session.sha256 is None:
        raise UnknownError(f"session {session_id}: {session.problem}")
    folder = server.sessions.folder.path(session_id)
    table = await run_in_threadpool(stances_of_session, folder, frames_sha256=session.sha256)
    if _ARROW in accept:
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, table.schema) as stream:
            stream.write_table(table)
        return Response(sink.getvalue().to_pybytes(), media_type=_ARROW)
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows
