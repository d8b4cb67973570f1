"""Route of a session's overview: bins for plots at any zoom."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated, Any

import pyarrow as pa
from anyio import CapacityLimiter
from fastapi import APIRouter, Header, Query, Request, Response
from pydantic import BaseModel, Field

from devices.chips.pressure_chips import Compensation
from devices.errors import UsageError
from devices.frames import TileInfo
from service.api.routes.common import (
    JSON,
    UNCHANGED,
    SecondsQuery,
    ServerState,
    numbers_response,
    problem_responses,
    require_frames,
)
from service.api.static_files import ARROW_STREAM, encode_arrow_stream, encode_columns_json
from service.server.server import Server
from service.sessions.inputs import SessionInputs
from service.sessions.overview import POINTS_MAX, BinnedSlice, bin_from_overview_or_rebuild
from storage.formats.slice import Slice
from storage.schema import Array
from storage.sessions.folder import Session
from storage.sessions.time_axis import Basis

router = APIRouter(prefix="/sessions", tags=["sessions"])

_ONE_AT_A_TIME = CapacityLimiter(1)
"""One thread: each thread that makes overviews keeps memory, and each takes milliseconds."""


class PointsQuery(SecondsQuery):
    """Time interval and resolution."""

    points: Annotated[int, Field(ge=1, le=POINTS_MAX)] = Field(
        default=1000,
        description="Least number of bins, if there are as many frames; at most four times as "
        "many.",
    )


class OverviewQuery(PointsQuery):
    """Time interval, resolution and columns."""

    columns: str | None = Field(
        default=None,
        description="Prefixes of names, comma-separated; `t_first_s` and `t_last_s` always.",
        examples=["grf_n,force_n"],
    )


class PartShift(BaseModel):
    """Shift of a part of the session on its time axis."""

    part: int
    shift_ns: int = Field(description="Added to `t_ns` of its frames.")
    by: Basis = Field(
        description="Basis: `node`: the node's date was right; `server`: the server's clock; "
        "`joined`: unknown, the part begins at the end of the one before."
    )


class BinsView(BaseModel):
    """Bins of consecutive frames (docs/api.md); unknown values are null."""

    session_id: str
    begin_t_ns: int = Field(description="`t_ns` of the session's first frame.")
    duration_s: float = Field(description="From the first frame to the last.")
    frames_in_bin: int = Field(description="Frames per bin; 1: each bin is a frame.")
    columns: dict[str, list[float | int | None]]


class OverviewView(BinsView):
    """Bins of every column (docs/api.md); unknown values are null."""

    time_axis: list[PartShift] = Field(
        description="Shift of each part; all 0 unless the node's date was set between two."
    )
    serials: list[str] = Field(description="Serials of the tiles, in the order of the columns.")
    counts_fall: list[bool] = Field(
        description="Whether a load lowers the raw counts of each tile's chip."
    )
    provisional: bool = Field(description="True: not sealed; frames and tares may still come.")
    catching_up: bool = Field(description="True: there are more frames; request again.")


@router.get(
    "/{session_id}/timeseries",
    summary="Time series at any zoom",
    response_model=OverviewView,
    responses=problem_responses(
        {200: {"description": "Bins, in the order of the frames.", "content": {ARROW_STREAM: {}}}},
        UNCHANGED,
        _404="No such session, or nothing was recorded.",
        _409="No frames yet, or damaged ones.",
        _422="No such column, or a slice that ends before it begins.",
    ),
)
async def get_timeseries(
    session_id: str,
    query: Annotated[OverviewQuery, Query()],
    request: Request,
    server: ServerState,
    accept: Annotated[str, Header(description="The Arrow media type for an Arrow stream.")] = "",
    accept_encoding: Annotated[str, Header(description="With gzip, JSON is compressed.")] = "",
) -> Response:
    """Return minimum and maximum of every column per bin, so that no peak hides.

    At full zoom each bin is a frame. The cost does not depend on the session's length. An unsealed
    session has its present frames, `provisional`: some ten thousand bins, with more frames each the
    longer it is.
    """
    session = require_frames(server.sessions.get_session(session_id))
    media_type = ARROW_STREAM if ARROW_STREAM in accept else JSON
    if session.sha256 is None:
        sources = server.recorder.collect_inputs_from_journals(session.id)
        make, key = partial(_encode_preview, session, query, server, sources, media_type), None
    else:
        server.previews.discard(session_id)
        make = partial(_encode_sealed, session, query, server, media_type)
        key = f"{session.sha256}|{query.model_dump_json()}"
    return await numbers_response(
        request,
        make,
        _ONE_AT_A_TIME,
        sealed_key=key,
        media_type=media_type,
        accept_encoding=accept_encoding,
    )


def _encode_preview(
    session: Session, query: OverviewQuery, server: Server, sources: SessionInputs, media_type: str
) -> bytes:
    so_far = server.previews.advance_preview_within_time_limit(sources)
    seen = so_far.get_bins(Slice(query.start_s, query.end_s), query.points)
    flags = {"provisional": True, "catching_up": so_far.is_catching_up}
    return _encode(session, seen, sources.info.tiles, flags, query, media_type)


def _encode_sealed(
    session: Session, query: OverviewQuery, server: Server, media_type: str
) -> bytes:
    assert session.sha256 is not None  # noqa: S101  # asked before
    part = Slice(query.start_s, query.end_s)
    with server.sessions.open_frames(session.id, only_slices=True) as reader:
        seen = bin_from_overview_or_rebuild(
            reader, part, query.points, frames_sha256=session.sha256
        )
        tiles = reader.info.tiles
    flags = {"provisional": False, "catching_up": False}
    return _encode(session, seen, tiles, flags, query, media_type)


def _encode(
    session: Session,
    seen: BinnedSlice,
    tiles: Sequence[TileInfo],
    remarks: dict[str, bool],
    query: OverviewQuery,
    media_type: str,
) -> bytes:
    chips = Compensation(tiles)
    kpa_per_count = chips.law.compute_kpa_per_count(chips.temperature_raw_usual)
    columns = _select_columns(times_to_seconds(seen.bins, seen.begin_ns), query.columns)
    about = describe_bins(session, seen.begin_ns, seen.end_ns, seen.frames_per_bin) | {
        "time_axis": seen.time_axis.to_json_list(),
        "serials": [tile.serial for tile in tiles],
        "counts_fall": (kpa_per_count < 0.0).tolist(),
        **remarks,
    }
    if media_type != ARROW_STREAM:
        return encode_columns_json(about, columns)
    metadata = {"foottile.overview": json.dumps(about)}
    table = pa.table({name: pa.array(v) for name, v in columns.items()}, metadata=metadata)
    return encode_arrow_stream(table)


def describe_bins(session: Session, begin_ns: int, end_ns: int, size: int) -> dict[str, Any]:
    """Return the fields of a `BinsView` but its columns."""
    return {
        "session_id": session.id,
        "begin_t_ns": begin_ns,
        "duration_s": (end_ns - begin_ns) * 1e-9,
        "frames_in_bin": size,
    }


def times_to_seconds(bins: Mapping[str, Array], begin_ns: int) -> dict[str, Array]:
    """Convert times to seconds after the first frame: JSON has no integers of that size."""
    times = [name for name in bins if name.endswith("_ns")]
    return {f"{name.removesuffix('_ns')}_s": (bins[name] - begin_ns) * 1e-9 for name in times} | {
        name: values for name, values in bins.items() if name not in times
    }


def _select_columns(columns: dict[str, Array], wanted: str | None) -> dict[str, Array]:
    names = [name.strip() for name in (wanted or "").split(",") if name.strip()]
    for begin in names:
        if not any(name.startswith(begin) for name in columns):
            raise UsageError(f"no column begins with {begin!r}", expected=", ".join(columns))
    always = ("t_first_s", "t_last_s")
    return {
        name: values
        for name, values in columns.items()
        if not names or name in always or name.startswith(tuple(names))
    }
