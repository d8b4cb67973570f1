"""Routes of a sealed session's stances: list, and overlay."""

from __future__ import annotations

import json
import math
from functools import partial
from typing import Annotated, Any

import numpy as np
from anyio import CapacityLimiter
from fastapi import APIRouter, Header, Query, Request, Response
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool

from devices.arrays import Floats
from devices.types import StrictModel
from service.api.routes.common import (
    UNCHANGED,
    ServerState,
    numbers_response,
    problem_responses,
    require_frames,
    require_sealed,
)
from service.api.static_files import ARROW_STREAM, encode_arrow_stream
from service.server.server import Server
from service.sessions.stances import load_stances, overlay_stances
from storage.sessions.folder import Session

router = APIRouter(prefix="/sessions", tags=["sessions"])

_ONE_AT_A_TIME = CapacityLimiter(1)
"""One thread: an overlay reads every loaded frame."""
_DIGITS = 6
"""Decimal places in SI units: micrometres and micronewtons."""


class StanceView(BaseModel):
    """Stance (docs/formats.md); unknown values are null."""

    number: int
    part: int
    begin_t_ns: int
    end_t_ns: int
    duration_s: float
    duration_sigma_s: float | None
    peak_grf_n: float | None
    peak_t_ns: int | None
    peak_sigma_n: float | None
    impulse_n_s: float | None
    impulse_sigma_n_s: float | None
    cop_x_first_m: float | None
    cop_x_last_m: float | None
    cop_x_range_m: float | None
    cop_x_range_sigma_m: float | None
    frames: int
    unknown_frames: int
    missing_frames: int
    gap_s: float
    estimate_flags: int
    begun: bool
    ended: bool
    is_whole: bool


@router.get(
    "/{session_id}/stances",
    summary="Stances",
    response_model=list[StanceView],
    responses=problem_responses(
        {200: {"description": "All stances, in order of time.", "content": {ARROW_STREAM: {}}}},
        _404="No such session, nothing was recorded, or it has no estimates.",
        _409="Stances are counted when the session is sealed.",
    ),
)
async def get_stances(
    session_id: str,
    server: ServerState,
    accept: Annotated[str, Header(description="The Arrow media type for an Arrow stream.")] = "",
) -> Response | list[dict[str, Any]]:
    """Return stances as JSON, or as an Arrow stream if `Accept` names its media type.

    Missing stances are computed from the frames.
    """
    session = _get_sealed_with_frames(session_id, server)
    folder = server.sessions.folder.get_path(session_id)
    table = await run_in_threadpool(load_stances, folder, frames_sha256=session.sha256)
    if ARROW_STREAM in accept:
        return Response(encode_arrow_stream(table), media_type=ARROW_STREAM)
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows


class OverlayQuery(StrictModel):
    """Resolution, and number of single curves."""

    points: Annotated[int, Field(ge=2, le=1001)] = Field(
        default=101, description="Number of percentages from 0 to 100, both included."
    )
    curves: Annotated[int, Field(ge=0, le=1000)] = Field(
        default=60,
        description="Limit of single curves, evenly spread over the session. Mean and spread are "
        "over all stances.",
    )


class SpreadView(BaseModel):
    """Mean and spread of one quantity at every percentage; unknown values are null."""

    mean: list[float | None]
    sd: list[float | None] = Field(description="Standard deviation over stances, with n - 1.")
    count: list[int] = Field(description="Number of stances with a value.")


class CurveView(BaseModel):
    """Curve of one stance at every percentage; unknown values are null."""

    number: int
    grf_n: list[float | None]
    cop_x_m: list[float | None]
    cop_y_m: list[float | None]


class OverlayView(BaseModel):
    """Overlay of stances, from 0 to 100 % of their duration."""

    session_id: str
    points: int
    whole: int = Field(description="Number of stances that can be overlaid.")
    overlaid: int = Field(
        description="Number of stances in mean and spread: all, or 4000 evenly spread over the "
        "session."
    )
    not_whole: int = Field(description="Number of stances left out as incomplete.")
    too_short: int = Field(description="Number of stances left out as a single frame.")
    spread: dict[str, SpreadView] = Field(
        description="Mean and spread of `grf_n`, `cop_x_m` and `cop_y_m`."
    )
    curves: list[CurveView]


@router.get(
    "/{session_id}/stances/overlay",
    summary="Overlay of stances",
    response_model=OverlayView,
    responses=problem_responses(
        UNCHANGED,
        _404="No such session, nothing was recorded, or it has no estimates.",
        _409="Stances are counted when the session is sealed.",
    ),
)
async def get_stances_overlay(
    session_id: str,
    query: Annotated[OverlayQuery, Query()],
    request: Request,
    server: ServerState,
    accept_encoding: Annotated[
        str, Header(description="With gzip, the answer is compressed.")
    ] = "",
) -> Response:
    """Return GRF and COP of the whole stances, normalised to 0 to 100 % of their duration.

    Values between two frames are interpolated linearly.
    """
    session = _get_sealed_with_frames(session_id, server)
    make = partial(_encode_overlay, session, query, server)
    key = f"{session.sha256}|{query.model_dump_json()}"
    return await numbers_response(
        request, make, _ONE_AT_A_TIME, sealed_key=key, accept_encoding=accept_encoding
    )


def _get_sealed_with_frames(session_id: str, server: Server) -> Session:
    session = server.sessions.get_session(session_id)
    return require_frames(require_sealed(session, "its stances are"))


def _encode_overlay(session: Session, query: OverlayQuery, server: Server) -> bytes:
    folder = server.sessions.folder.get_path(session.id)
    table = load_stances(folder, frames_sha256=session.sha256)
    with server.sessions.open_frames(session.id, only_slices=True) as reader:
        found = overlay_stances(reader, table, points=query.points, curves=query.curves)
    content = {
        "session_id": session.id,
        "points": query.points,
        "whole": found.whole_count,
        "overlaid": found.overlaid_count,
        "not_whole": found.partial_count,
        "too_short": found.too_short_count,
        "spread": {
            name: {
                "mean": _round_to_list(spread.mean),
                "sd": _round_to_list(spread.sd),
                "count": spread.count.tolist(),
            }
            for name, spread in found.overlay.statistics.items()
        },
        "curves": [
            {"number": number}
            | {name: _round_to_list(curves[i]) for name, curves in found.overlay.curves.items()}
            for i, number in enumerate(found.numbers)
        ],
    }
    return json.dumps(content, allow_nan=False, separators=(",", ":")).encode()


def _round_to_list(values: Floats) -> list[float | None]:
    rounded: list[float] = np.round(values, _DIGITS).tolist()
    return [None if math.isnan(value) else value for value in rounded]
