"""Routes of calibrations: upload, fit, download, assign."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated, Literal

from fastapi import APIRouter, Header, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import Field, StringConstraints

from devices.clock import server_utc_ns
from devices.errors import CalibrationError, FootTileError, UsageError
from devices.types import StrictModel
from service.api.routes.common import (
    FULL,
    NO_CONTENT,
    UNCHANGED,
    Name,
    ServerState,
    has_matching_etag,
    parse_if_match,
    problem_responses,
)
from service.estimation import LIVE_LAG_MS
from service.estimation.calibration import Calibration
from service.protocol.live import CalibrationSource, CalibrationView, View
from service.server.broadcast.views import Page, make_calibration_view
from service.server.calibrations import JOB_SESSIONS_MAX, CalibrationSummaryView
from service.server.node import ServerNode
from service.server.session_store import check_revision
from service.sessions.calibration_file import encode_calibration, parse_calibration
from service.sessions.estimate_stream import EstimateOptions, EstimateStream
from service.user_folders import PublicText

router = APIRouter(tags=["calibrations"])

_NO_CALIBRATION = "none"
"""Id for the absence of a calibration."""
_UNKNOWN = problem_responses(_404="No such calibration.", _409="Its file is damaged.")
_NO_NODE = problem_responses(_404="No such node.")

SessionId = Annotated[str, StringConstraints(max_length=100)]


class StartFit(StrictModel):
    """Request to fit a calibration."""

    sessions: Annotated[tuple[SessionId, ...], Field(min_length=1, max_length=JOB_SESSIONS_MAX)] = (
        Field(description="Test-rig recordings; repeats of a tile may be spread over several.")
    )
    name: Name = Field(examples=["left leg, November"])
    reference: Name = Field(default="not stated", description="Force sensor.")
    reference_delay_ms: Annotated[float, Field(ge=-1000, le=1000, strict=True)] | None = Field(
        default=None,
        description="Delay of its readings; unknown if left out, which increases the uncertainty.",
    )
    reference_delay_sigma_ms: Annotated[float, Field(ge=0, le=1000, strict=True)] = Field(
        default=0.1, description="Standard uncertainty of the delay."
    )


class FitView(View):
    """Calibration job, running or ended."""

    id: str
    name: str
    sessions: list[str]
    state: Literal["running", "done", "failed", "cancelled"]
    started_t_ns: int = Field(description="Server's UTC.")
    ended_t_ns: int | None
    log: list[PublicText] = Field(description="Log of the job, a line per tile.")
    calibration_id: str | None = Field(description="Id of the calibration, once it is done.")
    problem: PublicText | None = Field(description="Reason of a failure.")


class AssignCalibration(StrictModel):
    """Request to assign a calibration to a node."""

    id: Annotated[str, StringConstraints(max_length=100)] = Field(
        description="Id of a calibration on the server."
    )


class NodeCalibrationView(View):
    """Calibration of a node."""

    node: str
    source: CalibrationSource = Field(
        description="Origin: the node itself, or the server, where one was assigned."
    )
    assigned_t_ns: int | None = Field(description="Time of the assignment, server's UTC.")
    calibration: CalibrationView | None = Field(description="Calibration in use; null: none.")
    problem: PublicText | None = Field(description="Reason why none is in use.")
    own_id: str | None = Field(description="Id of the node's own calibration.")

    @classmethod
    def from_node(cls, node: ServerNode) -> NodeCalibrationView:
        """Return the present calibration of a node."""
        estimates, own_calibration = node.estimator, node.hello.calibration
        live, assigned = estimates.live, estimates.assignment.current
        return cls(
            node=node.name,
            source=estimates.calibration_source,
            assigned_t_ns=None if assigned is None else assigned.t_ns,
            calibration=make_calibration_view(live.calibration, live.calibration_id, live.ranges),
            problem=estimates.calibration_problem,
            own_id=None if own_calibration is None else own_calibration.id,
        )


InUse = Annotated[
    str | None,
    Header(
        description="Id of the calibration in use that you have seen, or `none`; else the change "
        "is refused."
    ),
]


@router.get("/calibrations", summary="Calibrations")
async def list_calibrations(server: ServerState) -> Page[CalibrationSummaryView]:
    """Return the calibrations on the server, the newest recordings first."""
    return Page(items=server.calibrations.list_all())


@router.post(
    "/calibrations",
    summary="Upload a calibration",
    status_code=HTTPStatus.CREATED,
    responses=problem_responses(
        FULL,
        _409="The limit of calibrations is reached.",
        _413="It is longer than 1 MiB.",
        _422="No calibration, an unknown field, or a wrong hash.",
    ),
    openapi_extra={
        "requestBody": {
            "required": True,
            "description": "The file as `foottile calibrate` writes it.",
            "content": {"application/json": {"schema": {"type": "object"}}},
        }
    },
)
async def upload_calibration(
    request: Request, server: ServerState, response: Response
) -> CalibrationSummaryView:
    """Store a calibration file, checked as on every read; the same file twice is one calibration.

    A file without `id` and `check` was written by hand, and is marked as unproven.
    """
    calibration = await run_in_threadpool(_parse_body, await request.body())
    summary = server.calibrations.save(calibration)
    response.headers["Location"] = f"/api/v1/calibrations/{summary.id}"
    return summary


@router.get("/calibrations/jobs", summary="Fits")
async def list_calibration_jobs(server: ServerState) -> Page[FitView]:
    """Return the last jobs since the server was started, newest first."""
    return Page(
        items=[
            FitView.model_validate(fit) for fit in server.calibration_jobs.list_jobs_newest_first()
        ]
    )


@router.post(
    "/calibrations/jobs",
    summary="Fit a calibration",
    status_code=HTTPStatus.ACCEPTED,
    responses=problem_responses(
        _404="No such session.",
        _409="Another job is running, or a session is not sealed.",
        _422="Invalid body, or the sessions are too long.",
    ),
)
async def start_calibration_job(body: StartFit, server: ServerState, response: Response) -> FitView:
    """Fit every tile in test-rig recordings, as `foottile calibrate` does.

    The job runs beside the server; poll it for its progress.
    """
    options = {"sensor": body.reference}
    if body.reference_delay_ms is not None:
        options["reference_delay_ms"] = repr(body.reference_delay_ms)
        options["reference_delay_sigma_ms"] = repr(body.reference_delay_sigma_ms)
    fit = server.calibration_jobs.start_job(body.name, body.sessions, options)
    response.headers["Location"] = f"/api/v1/calibrations/jobs/{fit.id}"
    return FitView.model_validate(fit)


@router.get(
    "/calibrations/jobs/{job_id}",
    summary="Fit progress",
    responses=problem_responses(_404="No such fit."),
)
async def get_calibration_job(job_id: str, server: ServerState) -> FitView:
    """Return a job's progress, and the id of the calibration once it is done."""
    return FitView.model_validate(server.calibration_jobs.get_job(job_id))


@router.delete(
    "/calibrations/jobs/{job_id}",
    summary="Cancel a fit",
    responses=problem_responses(_404="No such fit."),
)
async def cancel_calibration_job(job_id: str, server: ServerState) -> FitView:
    """Cancel a running job without a result; an ended one is unchanged."""
    return FitView.model_validate(await server.calibration_jobs.cancel_job(job_id))


@router.get(
    "/calibrations/{calibration_id}",
    summary="Download a calibration",
    response_class=Response,
    responses=problem_responses(
        {200: {"description": "The file.", "content": {"application/json": {}}}},
        UNCHANGED,
        _UNKNOWN,
    ),
)
async def get_calibration(calibration_id: str, request: Request, server: ServerState) -> Response:
    """Return the file as every command of `foottile` reads it; its id is its entity tag."""
    calibration = await run_in_threadpool(server.calibrations.load, calibration_id)
    return _file_response(calibration, request)


@router.delete(
    "/calibrations/{calibration_id}",
    summary="Delete a calibration",
    **NO_CONTENT,
    responses=problem_responses(FULL, _404="No such calibration."),
)
async def delete_calibration(calibration_id: str, server: ServerState) -> None:
    """Delete a calibration; sessions and nodes that use it have a copy."""
    server.calibrations.delete_leaving_copies_in_use(calibration_id)


@router.get("/nodes/{node}/calibration", summary="A node's calibration", responses=_NO_NODE)
async def get_node_calibration(node: str, server: ServerState) -> NodeCalibrationView:
    """Return the calibration in use, and its origin."""
    return NodeCalibrationView.from_node(server.nodes.get(node))


@router.put(
    "/nodes/{node}/calibration",
    summary="Assign a calibration",
    responses=problem_responses(
        FULL,
        _404="No such node or calibration.",
        _409="The calibration's file is damaged.",
        _412="Another calibration is in use than If-Match names.",
        _422="Invalid body, or it does not fit the node's tiles.",
    ),
)
async def assign_calibration(
    node: str, body: AssignCalibration, server: ServerState, if_match: InUse = None
) -> NodeCalibrationView:
    """Estimate a node's tiles with this calibration, until it is unassigned.

    From the next frame on, and for sessions that begin then; sessions that are being recorded keep
    theirs. The assignment outlives a restart of either side.
    """
    the_node = server.nodes.get(node)
    calibration = await run_in_threadpool(server.calibrations.load, body.id)
    _check_calibration_in_use(the_node, if_match)
    check_fits(the_node, calibration)
    the_node.estimator.store_and_apply_calibration(calibration, server_utc_ns())
    server.notify_node_changed(the_node)
    return NodeCalibrationView.from_node(the_node)


@router.delete(
    "/nodes/{node}/calibration",
    summary="Unassign a calibration",
    responses=problem_responses(
        _NO_NODE, FULL, _412="Another calibration is in use than If-Match names."
    ),
)
async def unassign_calibration(
    node: str, server: ServerState, if_match: InUse = None
) -> NodeCalibrationView:
    """Use the node's own calibration again, if it has one."""
    the_node = server.nodes.get(node)
    _check_calibration_in_use(the_node, if_match)
    if the_node.estimator.calibration_source == "server":
        the_node.estimator.store_and_apply_calibration(None, server_utc_ns())
        server.notify_node_changed(the_node)
    return NodeCalibrationView.from_node(the_node)


def _parse_body(content: bytes) -> Calibration:
    try:
        return parse_calibration(content, where="the body")
    except CalibrationError as error:
        raise UsageError(error.what, expected=error.expected, remedy=error.remedy) from error


def _file_response(calibration: Calibration, request: Request) -> Response:
    headers = {"ETag": f'"{calibration.id}"'}
    if has_matching_etag(request, calibration.id):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    return Response(encode_calibration(calibration), media_type="application/json", headers=headers)


def _check_calibration_in_use(node: ServerNode, if_match: str | None) -> None:
    present = node.estimator.live.calibration_id or _NO_CALIBRATION
    check_revision(parse_if_match(if_match), present, f"the calibration of {node.name!r}")


def check_fits(node: ServerNode, calibration: Calibration) -> None:
    """Refuse a calibration with which the present tiles cannot be estimated.

    Raises:
        UsageError: a tile is not in it, has another chip, or a model lacks parameters.
    """
    try:
        EstimateStream(
            node.last_info, EstimateOptions(calibration, node.last_info.models, LIVE_LAG_MS)
        )
    except FootTileError as error:
        raise UsageError(
            f"calibration {calibration.name} does not fit node {node.name!r}: {error}"
        ) from error
