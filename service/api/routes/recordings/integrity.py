"""Routes of a session's array and clocks, and the verification of its files."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Response
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from devices.errors import FileFormatError, FootTileError, UnknownError
from devices.frames import ArrayInfo, ServoInfo
from service.api.routes.common import (
    ServerState,
    problem_responses,
    require_file,
    require_frames,
    require_sealed,
    stored_table_response,
)
from service.estimation import LIVE_LAG_MS
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import TareSource
from service.protocol.live import CalibrationView, TileView, View
from service.server.broadcast.views import make_calibration_view, make_tile_views
from service.server.estimates.live_estimator import TileRanges
from service.server.server import Server
from service.user_folders import PublicText
from storage.clock.table import CLOCK_NAME, ClockSummary
from storage.formats.writers.tables import PARQUET
from storage.sessions.folder import FRAMES_NAME, WARM_UP_NAME, Ledger
from storage.sessions.metadata import load_clock_table
from storage.verify.session import verify_session

router = APIRouter(prefix="/sessions", tags=["sessions"])


class SessionTareView(View):
    """Tare that was in force during a session."""

    t_ns: int = Field(description="End of the interval of the tare, node's UTC.")
    source: TareSource = Field(
        description="unloaded: by hand; flight, recognised: automatic; lead: of an emulation; "
        "interval: of an estimate (`--tare-s`); lost: damaged on the disk."
    )


class ArrayView(View):
    """Array of a session, and facts of its estimates."""

    session_id: str
    node: str
    tiles: list[TileView]
    servo: ServoInfo | None
    nominal_rate_hz: float
    calibration: CalibrationView | None
    tares: list[SessionTareView] = Field(description="Tares of the estimates, oldest first.")
    lag_ms: float | None = Field(
        description="Look-ahead of the estimates: each uses readings up to this time after its "
        "frame; null: no estimates."
    )
    estimates_problem: PublicText | None = Field(description="Reason why there are no estimates.")


@router.get(
    "/{session_id}/tiles",
    summary="Tiles",
    responses=problem_responses(
        _404="No such session, or nothing was recorded.", _409="It is damaged."
    ),
)
async def list_tiles(session_id: str, server: ServerState) -> ArrayView:
    """Return the tiles' positions and ranges, and the look-ahead of the estimates."""
    session = require_frames(server.sessions.get_session(session_id))
    if session.state == "sealed":
        return await run_in_threadpool(_read_sealed_array, session_id, server)
    sources = server.recorder.collect_inputs_from_journals(session_id)
    content = sources.calibration
    lag_ms = None if content is None else LIVE_LAG_MS
    tares = [SessionTareView(t_ns=tare.t_ns, source=tare.source) for tare in sources.tares]
    return _make_view(session_id, sources.info, content, tares, lag_ms, sources.problem)


def _read_sealed_array(session_id: str, server: Server) -> ArrayView:
    with server.sessions.open_frames(session_id, only_slices=True) as reader:
        info, notes, estimated = reader.info, reader.notes, reader.has_columns("grf_n")
    if not estimated:
        reason = str(notes.get("estimates", "no estimates")).removeprefix("no estimates: ")
        return _make_view(session_id, info, _parse_calibration(notes), [], None, reason)
    lag_ms = notes.get("lag_ms")
    known_ms = float(lag_ms) if isinstance(lag_ms, int | float) else None
    return _make_view(
        session_id, info, _parse_calibration(notes), _parse_tares(notes), known_ms, None
    )


def _parse_calibration(notes: dict[str, Any]) -> Calibration | None:
    try:
        return Calibration.model_validate(notes["calibration"])
    except (KeyError, FootTileError, ValueError):  # none, or of another version
        return None


def _parse_tares(notes: dict[str, Any]) -> list[SessionTareView]:
    try:
        return [
            SessionTareView(t_ns=tare["t_ns"], source=tare["source"]) for tare in notes["tares"]
        ]
    except (KeyError, TypeError, ValueError):  # none, or of another version
        return []


def _make_view(
    session_id: str,
    info: ArrayInfo,
    calibration: Calibration | None,
    tares: list[SessionTareView],
    lag_ms: float | None,
    problem: str | None,
) -> ArrayView:
    try:
        ranges = None if calibration is None else TileRanges.from_calibration(info, calibration)
    except FootTileError:  # it is of other tiles
        ranges = None
    calibration_id = None if calibration is None else calibration.id
    return ArrayView(
        session_id=session_id,
        node=info.node,
        tiles=make_tile_views(info, ranges),
        servo=info.servo,
        nominal_rate_hz=info.nominal_rate_hz,
        calibration=make_calibration_view(calibration, calibration_id, ranges),
        tares=tares,
        lag_ms=lag_ms,
        estimates_problem=problem,
    )


_PARQUET = PARQUET.media_type


@router.get(
    "/{session_id}/clock",
    summary="Clocks",
    response_model=ClockSummary,
    responses=problem_responses(
        {200: {"description": "Summary, or the stored table.", "content": {_PARQUET: {}}}},
        _404="No such session, or its clock table is missing.",
        _409="The table is written when the session is sealed.",
    ),
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
        table = server.recorder.collect_inputs_from_journals(session_id).make_clock_table()
        return await run_in_threadpool(table.summarize_streams)
    return await run_in_threadpool(_read_sealed_clock, session_id, server)


@router.get(
    "/{session_id}/warm-up",
    summary="Frames before the session",
    response_class=Response,
    responses=problem_responses(
        {200: {"description": "The stored frames.", "content": {_PARQUET: {}}}},
        _404="No such session, or its models had no history.",
        _409="They are stored when the session is sealed.",
    ),
)
async def get_warm_up(session_id: str, server: ServerState) -> Response:
    """Return `warm_up.parquet`: the frames from which the session's models had their history."""
    session = server.sessions.get_session(session_id)
    return stored_table_response(
        session, server.sessions.folder.get_path(session_id) / WARM_UP_NAME
    )


def _read_sealed_clock(session_id: str, server: Server) -> ClockSummary:
    for name in (CLOCK_NAME, FRAMES_NAME):
        require_file(server.sessions.folder.get_path(session_id) / name)
    with server.sessions.open_frames(session_id) as reader:
        return load_clock_table(reader).summarize_streams()


_ONE_AT_A_TIME = CapacityLimiter(1)
"""One thread: verification reads every frame."""


class VerificationView(Ledger):
    """Result of the verification: the ledger, and the problems found."""

    id: str | None
    problems: list[PublicText] = Field(description="Problems found; none: the files are intact.")
    sha256: str | None = Field(
        description="Present hash of the file of frames; null: there is none."
    )


@router.get(
    "/{session_id}/verification",
    summary="Verify files",
    response_model=VerificationView,
    responses=problem_responses(_404="No such session.", _409="The session is not sealed."),
)
async def get_verification(session_id: str, server: ServerState) -> dict[str, Any]:
    """Read all files of a sealed session, and compare them with one another and their hashes.

    Errors are in `problems`; no file is changed. A million frames take about a second; requests run
    one after the other. This proves nothing about the server itself: `foottile pull` and `foottile
    verify` do the same on another machine.
    """
    require_sealed(server.sessions.get_session(session_id), "verification is")
    read = partial(verify_session, server.sessions.folder.get_path(session_id))
    try:
        report = await to_thread.run_sync(read, limiter=_ONE_AT_A_TIME)
    except FileFormatError as error:  # it was deleted meanwhile
        raise UnknownError(f"session {session_id}: {error.what}", where=error.where) from error
    content = report.to_json_dict()
    del content["unproven"]  # a server has all of a session's files
    return content
