"""Route of a session's array: tiles, ranges, look-ahead."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from devices.errors import FootTileError, UnknownError
from devices.frames import ArrayInfo, ServoInfo
from service.api.routes.common import ServerState, problem_responses
from service.estimation import LIVE_LAG_MS
from service.estimation.calibration import Calibration
from service.private_paths import PublicText
from service.server.broadcast.views import (
    CalibrationView,
    TileView,
    View,
    absolute_scale,
    make_tile_views,
)
from service.server.estimates.ranges import TileRanges
from service.server.server import Server

router = APIRouter(prefix="/sessions", tags=["sessions"])


class ArrayView(View):
    """Array of a session, and facts of its estimates."""

    session_id: str
    node: str
    tiles: list[TileView]
    servo: ServoInfo | None
    nominal_rate_hz: float
    calibration: CalibrationView | None
    lag_ms: float | None = Field(
        description="Look-ahead of the estimates: each uses readings up to this time after its "
        "frame; null: no estimates."
    )
    estimates_problem: PublicText | None = Field(description="Reason why there are no estimates.")


@router.get(
    "/{session_id}/tiles",
    operation_id="listTiles",
    summary="Tiles",
    responses=problem_responses(
        _404="No such session, or nothing was recorded.", _409="It is damaged."
    ),
)
async def list_tiles(session_id: str, server: ServerState) -> ArrayView:
    """Return the tiles' positions and ranges, and the look-ahead of the estimates."""
    session = server.sessions.get_session(session_id)
    if session.state == "sealed" and session.sha256 is None:
        raise UnknownError(f"session {session_id}: {session.problem}")
    if session.state == "sealed":
        return await run_in_threadpool(_read_sealed, session_id, server)
    sources = server.recorder.collect_inputs(session_id)
    content = sources.calibration
    lag_ms = None if content is None else LIVE_LAG_MS
    return _make_view(session_id, sources.info, content, lag_ms, sources.problem)


def _read_sealed(session_id: str, server: Server) -> ArrayView:
    with server.sessions.open_frames(session_id, only_slices=True) as reader:
        info, notes, estimated = reader.info, reader.notes, reader.has_columns("grf_n")
    if not estimated:
        reason = str(notes.get("estimates", "no estimates")).removeprefix("no estimates: ")
        return _make_view(session_id, info, _parse_calibration(notes), None, reason)
    lag_ms = notes.get("lag_ms")
    known_ms = float(lag_ms) if isinstance(lag_ms, int | float) else None
    return _make_view(session_id, info, _parse_calibration(notes), known_ms, None)


def _parse_calibration(notes: dict[str, Any]) -> Calibration | None:
    try:
        return Calibration.model_validate(notes["calibration"])
    except (KeyError, FootTileError, ValueError):  # none, or of another version
        return None


def _make_view(
    session_id: str,
    info: ArrayInfo,
    calibration: Calibration | None,
    lag_ms: float | None,
    problem: str | None,
) -> ArrayView:
    try:
        ranges = None if calibration is None else TileRanges.from_calibration(info, calibration)
    except FootTileError:  # it is of other tiles
        ranges = None
    calibration_view = None
    if calibration is not None and ranges is not None:
        scale = absolute_scale(ranges)
        calibration_view = CalibrationView(
            id=calibration.id, name=calibration.name, absolute_scale=scale
        )
    return ArrayView(
        session_id=session_id,
        node=info.node,
        tiles=make_tile_views(info, ranges),
        servo=info.servo,
        nominal_rate_hz=info.nominal_rate_hz,
        calibration=calibration_view,
        lag_ms=lag_ms,
        estimates_problem=problem,
    )
