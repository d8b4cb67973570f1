"""Route of a session's overview: bins for plots at any zoom."""

from __future__ import annotations

import hashlib
import json
from functools import partial
from typing import Annotated

import pyarrow as pa
from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Header, Query, Request, Response
from pydantic import BaseModel, Field

from devices.errors import UnknownError, UsageError
from service.api.routes.common import (
    UNCHANGED,
    SecondsQuery,
    ServerState,
    has_matching_etag,
    problem_responses,
)
from service.api.static_files import (
    ARROW_STREAM,
    accepts_gzip,
    compress_gzip,
    encode_arrow_stream,
    encode_columns_json,
)
from service.server.server import Server
from service.sessions.overview import POINTS_MAX, BinnedSlice, bin_from_overview_or_rebuild
from service.version import SOFTWARE_VERSION
from storage.formats.slice import Slice
from storage.schema import Array
from storage.sessions.folder import Session
from storage.sessions.time_axis import Basis

router = APIRouter(prefix="/sessions", tags=["sessions"])

_ONE_AT_A_TIME = CapacityLimiter(1)
"""One thread: each thread that makes overviews keeps memory, and each takes milliseconds."""


class OverviewQuery(SecondsQuery):
    """Time interval, resolution and columns."""

    points: Annotated[int, Field(ge=1, le=POINTS_MAX)] = Field(
        default=1000,
        description="Least number of bins, if there are as many frames; at most four times as "
        "many.",
    )
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


class OverviewView(BaseModel):
    """Bins of consecutive frames (docs/api.md); unknown values are null."""

    session_id: str
    begin_t_ns: int = Field(description="`t_ns` of the session's first frame.")
    duration_s: float = Field(description="From the first frame to the last.")
    frames_in_bin: int = Field(description="Frames per bin; 1: each bin is a frame.")
    time_axis: list[PartShift] = Field(
        description="Shift of each part; all 0 unless the node's date was set between two."
    )
    serials: list[str] = Field(description="Serials of the tiles, in the order of the columns.")
    provisional: bool = Field(description="True: not sealed; frames and tares may still come.")
    catching_up: bool = Field(description="True: there are more frames; request again.")
    columns: dict[str, list[float | int | None]]


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
    session = server.sessions.get_session(session_id)
    if session.state == "sealed" and session.sha256 is None:
        raise UnknownError(f"session {session_id}: {session.problem}")
    as_arrow = ARROW_STREAM in accept
    as_gzip = not as_arrow and accepts_gzip(accept_encoding)
    if session.sha256 is None:
        return await _preview_response(session, query, server, as_arrow=as_arrow, as_gzip=as_gzip)
    server.previews.discard(session_id)
    etag_input = (
        f"{session.sha256}|{query.model_dump_json()}|{as_arrow}|{as_gzip}|{SOFTWARE_VERSION}"
    )
    tag = hashlib.sha256(etag_input.encode()).hexdigest()
    headers = {"ETag": f'"{tag}"', "Cache-Control": "private, no-cache"}
    headers |= {"Vary": "Accept, Accept-Encoding"}
    if has_matching_etag(request, tag):
        return Response(status_code=304, headers=headers)
    make = partial(_encode_sealed, session, query, server, as_arrow=as_arrow, as_gzip=as_gzip)
    content = await to_thread.run_sync(make, limiter=_ONE_AT_A_TIME)
    if as_gzip:
        headers |= {"Content-Encoding": "gzip"}
    media_type = ARROW_STREAM if as_arrow else "application/json"
    return Response(content, headers=headers, media_type=media_type)


async def _preview_response(
    session: Session, query: OverviewQuery, server: Server, *, as_arrow: bool, as_gzip: bool
) -> Response:
    sources = server.recorder.collect_inputs_from_journals(session.id)
    part = Slice(query.start_s, query.end_s)

    def make() -> bytes:
        so_far = server.previews.advance_preview_within_time_limit(sources)
        seen, serials = so_far.get_bins(part, query.points), list(sources.info.serials)
        flags = {"provisional": True, "catching_up": so_far.is_catching_up}
        return _encode(session, seen, serials, flags, query, as_arrow=as_arrow, as_gzip=as_gzip)

    content = await to_thread.run_sync(make, limiter=_ONE_AT_A_TIME)
    headers = {"Cache-Control": "no-store"} | ({"Content-Encoding": "gzip"} if as_gzip else {})
    return Response(
        content, headers=headers, media_type=ARROW_STREAM if as_arrow else "application/json"
    )


def _encode_sealed(
    session: Session, query: OverviewQuery, server: Server, *, as_arrow: bool, as_gzip: bool
) -> bytes:
    assert session.sha256 is not None  # noqa: S101  # asked before
    part = Slice(query.start_s, query.end_s)
    with server.sessions.open_frames(session.id, only_slices=True) as reader:
        seen = bin_from_overview_or_rebuild(
            reader, part, query.points, frames_sha256=session.sha256
        )
        serials = list(reader.info.serials)
    flags = {"provisional": False, "catching_up": False}
    return _encode(session, seen, serials, flags, query, as_arrow=as_arrow, as_gzip=as_gzip)


def _encode(
    session: Session,
    seen: BinnedSlice,
    serials: list[str],
    remarks: dict[str, bool],
    query: OverviewQuery,
    *,
    as_arrow: bool,
    as_gzip: bool,
) -> bytes:
    columns = _select_columns(_times_to_seconds(seen), query.columns)
    about = {
        "session_id": session.id,
        "begin_t_ns": seen.begin_ns,
        "duration_s": (seen.end_ns - seen.begin_ns) * 1e-9,
        "frames_in_bin": seen.frames_per_bin,
        "time_axis": seen.time_axis.to_json_list(),
        "serials": serials,
        **remarks,
    }
    if not as_arrow:
        text = encode_columns_json(about, columns)
        return compress_gzip(text) if as_gzip else text
    metadata = {"foottile.overview": json.dumps(about)}
    table = pa.table({name: pa.array(v) for name, v in columns.items()}, metadata=metadata)
    return encode_arrow_stream(table)


def _times_to_seconds(seen: BinnedSlice) -> dict[str, Array]:
    """Convert times to seconds after the first frame: JSON has no integers of that size."""
    bins = dict(seen.bins)
    times = {
        f"{name.removesuffix('_ns')}_s": (bins.pop(name) - seen.begin_ns) * 1e-9
        for name in seen.bins
        if name.endswith("_ns")
    }
    return times | bins


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
