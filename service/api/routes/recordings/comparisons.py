"""Routes of comparisons made by `foottile compare`: figures, and the reference at any zoom."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Query, Response
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool

from devices.errors import FileFormatError, UnknownError
from service.api.routes.common import (
    ServerState,
    problem_responses,
    require_sealed,
    run_with_usage_errors,
)
from service.api.routes.recordings.overview import (
    BinsView,
    PointsQuery,
    describe_bins,
    times_to_seconds,
)
from service.api.static_files import encode_columns_json
from service.server.server import Server
from service.user_folders import PublicText
from storage.formats.slice import Slice
from storage.sessions.comparisons import (
    SERIES_NAME,
    find_comparison_folder,
    find_comparison_folders,
    read_comparison_report,
)
from storage.sessions.folder import Session

router = APIRouter(prefix="/sessions", tags=["sessions"])

_ONE_AT_A_TIME = CapacityLimiter(1)
"""One thread: a series is read whole once."""
_PROBLEMS = problem_responses(
    _404="No such session or comparison, or nothing was recorded.",
    _409="The session is not sealed.",
    _422="Damaged files of the comparison, or a slice that ends before it begins.",
)


class ComparisonView(BaseModel):
    """Comparison in the list."""

    name: str = Field(description="Name of its reference.")
    problem: PublicText | None = Field(description="Reason why it cannot be read; null: it can.")
    matches_current_data: bool | None = Field(
        description="False: the session's frames were different then; null: unknown."
    )
    missed: list[str] = Field(description="Missed limits, as text.")


class ComparisonsView(BaseModel):
    """Comparisons of a session."""

    items: list[ComparisonView]


class ReportView(ComparisonView):
    """Results of a comparison (docs/compare.md)."""

    has_series: bool = Field(description="True: the compared values are there, frame by frame.")
    report: dict[str, Any] = Field(description="Content of `compare.json`.")


@router.get(
    "/{session_id}/comparisons",
    summary="Comparisons",
    responses=problem_responses(_404="No such session.", _409="Its files are damaged."),
)
async def list_comparisons(session_id: str, server: ServerState) -> ComparisonsView:
    """Return the session's comparisons, made by `foottile compare`, by name."""
    session = server.sessions.get_session(session_id)
    return ComparisonsView(items=await run_in_threadpool(_list_comparisons, session, server))


@router.get("/{session_id}/comparisons/{name}", summary="A comparison", responses=_PROBLEMS)
async def get_comparison(session_id: str, name: str, server: ServerState) -> ReportView:
    """Return alignment, figures with their intervals, trials and limits."""
    session = server.sessions.get_session(session_id)
    return await run_in_threadpool(
        run_with_usage_errors, partial(_make_report, session, name, server)
    )


@router.get(
    "/{session_id}/comparisons/{name}/series",
    summary="The reference at any zoom",
    response_model=BinsView,
    responses=_PROBLEMS,
)
async def get_comparison_series(
    session_id: str, name: str, query: Annotated[PointsQuery, Query()], server: ServerState
) -> Response:
    """Return minimum and maximum of the reference, and of ours minus it, aligned in time."""
    session = require_sealed(server.sessions.get_session(session_id), "the reference is")
    make = partial(run_with_usage_errors, partial(_encode_series, session, name, query, server))
    content = await to_thread.run_sync(make, limiter=_ONE_AT_A_TIME)
    return Response(content, media_type="application/json")


def _list_comparisons(session: Session, server: Server) -> list[ComparisonView]:
    folders = find_comparison_folders(server.sessions.folder.get_path(session.id))
    frames = _read_frames_hash(session, server) if folders else None
    found = []
    for name, folder in folders.items():
        try:
            found.append(_make_view(frames, name, read_comparison_report(folder)))
        except FileFormatError as error:
            found.append(
                ComparisonView(name=name, problem=str(error), matches_current_data=None, missed=[])
            )
    return found


def _read_frames_hash(session: Session, server: Server) -> object:
    """Return the hash that the frames state; None if they cannot be read."""
    try:
        with server.sessions.open_frames(session.id, only_slices=True) as reader:
            return reader.session_id_and_hashes["file_sha256"]
    except FileFormatError:
        return None


def _make_view(frames: object, name: str, content: dict[str, Any]) -> ComparisonView:
    compared_sha256 = content["session"].get("file_sha256")
    missed = content.get("missed")
    return ComparisonView(
        name=name,
        problem=None,
        matches_current_data=compared_sha256 == frames
        if isinstance(compared_sha256, str) and frames is not None
        else None,
        missed=[str(line) for line in missed] if isinstance(missed, list) else [],
    )


def _make_report(session: Session, name: str, server: Server) -> ReportView:
    folder = find_comparison_folder(server.sessions.folder.get_path(session.id), name)
    content = read_comparison_report(folder)
    return ReportView(
        **_make_view(_read_frames_hash(session, server), name, content).model_dump(),
        has_series=(folder / SERIES_NAME).is_file(),
        report={key: value for key, value in content.items() if key != "session"}
        | {"reference": Path(str(content["reference"])).name},
    )


def _encode_series(session: Session, name: str, query: PointsQuery, server: Server) -> bytes:
    cached = server.comparison_series.get_or_read(
        find_comparison_folder(server.sessions.folder.get_path(session.id), name)
    )
    if cached is None:
        raise UnknownError(
            f"the comparison with {name!r} has no series",
            remedy="It has too many frames: compare parts of it",
        )
    with server.sessions.open_frames(session.id, only_slices=True) as reader:
        begin_ns, end_ns = reader.read_span_on_axis_ns()
    part = Slice(query.start_s, query.end_s)
    bins, size = cached.get_bins(*part.compute_bounds_ns(begin_ns), query.points)
    columns = {column: values for column, values in bins.items() if column != "part"}
    return encode_columns_json(
        describe_bins(session, begin_ns, end_ns, size), times_to_seconds(columns, begin_ns)
    )
