"""Routes of nodes and their tares."""

from __future__ import annotations

from http import HTTPStatus
from math import isfinite
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query
from pydantic import AfterValidator, Field

from devices.types import StrictModel, check_user_name
from service.api.routes.common import NO_CONTENT, ServerState, parse_if_match, problem_responses
from service.protocol.live import NodeView, TareView, View
from service.server.broadcast.summary import SECONDS_MAX, TILE_QUANTITIES, ForceSpan, round_values
from service.server.broadcast.views import Page, TaresPage, make_drift_view, make_tare_view
from service.server.node import ServerNode
from service.server.server import Server
from service.server.session_store import check_revision
from service.sessions.tares import REASON_LENGTH_MAX

router = APIRouter(prefix="/nodes", tags=["nodes"])


class TareRequest(StrictModel):
    """Options of a tare."""

    reason: Annotated[str, AfterValidator(check_user_name)] = Field(
        default="",
        max_length=REASON_LENGTH_MAX,
        description='Reason for the history; default "by hand".',
    )


class AcceptReplacementRequest(StrictModel):
    """Fingerprint of the accepted machine."""

    fingerprint: str = Field(
        pattern=r"^[0-9a-f]{4}(-[0-9a-f]{4}){3}$",
        description="Fingerprint of `replacement`, as the machine itself prints it.",
    )


class RecentQuery(StrictModel):
    """Time interval of the history."""

    seconds: Annotated[float, Field(gt=0, le=SECONDS_MAX)] = Field(
        default=10.0, description="Length of the interval, back from the newest frame."
    )
    before_seq: Annotated[int, Field(ge=0, lt=2**53)] | None = Field(
        default=None,
        description="Only spans that begin before this number; the last one may reach beyond it."
        " `seq_first` of a live message of the last second continues those of the GRF without a"
        " seam.",
    )
    tiles: Literal["force_n", "gauge_kpa"] | None = Field(
        default=None, description="Adds `tiles`: this quantity of each tile."
    )


class RecentTilesView(View):
    """Spans of a tenth of a second, oldest first; the values of each span are over tiles."""

    seq_first: list[int]
    seq: list[int]
    n: list[int]
    t_ns: list[int]
    min: list[list[float | None]]
    max: list[list[float | None]]


class RecentView(View):
    """Spans of consecutive frames, oldest first; one value per span in each list."""

    node: str
    stream_id: str = Field(description="Id of the present stream, of which all spans are.")
    age_ms: float | None = Field(description="Age of the newest published frame; null if unknown.")
    seq_first: list[int]
    seq: list[int]
    n: list[int] = Field(
        description="Number of frames; fewer than the range of numbers if some are missing."
    )
    t_ns: list[int] = Field(description="Time of its newest frame, node's UTC.")
    grf_n: list[float | None] = Field(description="GRF of its newest frame.")
    grf_min_n: list[float | None] = Field(description="Minimum over its frames.")
    grf_max_n: list[float | None] = Field(description="Maximum over its frames.")
    grf_lower_bound_max_n: list[float | None] = Field(
        description="Greatest lower bound among its frames without a GRF."
    )
    tiles: RecentTilesView | None = Field(description="Null unless requested.")


_UNKNOWN = problem_responses(_404="No such node.")

InForce = Annotated[
    str | None,
    Header(
        description="Id of the tare in force that you have seen, or `none`; else the change is "
        "refused."
    ),
]


def _check_tare_in_force(node: ServerNode, if_match: str | None) -> None:
    recorded = node.estimator.tare_history.tare_in_force_unless_lost(node.last_info)
    in_force = "none" if recorded is None else recorded.id
    check_revision(parse_if_match(if_match), in_force, f"the tare of {node.name!r}")


@router.get("", summary="All nodes")
async def list_nodes(server: ServerState) -> Page[NodeView]:
    """Return connected and remembered nodes."""
    return Page(items=[server.make_node_view(node) for node in server.nodes])


@router.get("/{node}", summary="One node", responses=_UNKNOWN)
async def get_node(node: str, server: ServerState) -> NodeView:
    """Return array, calibration, tare, clock and counts of a node."""
    return server.make_node_view(server.nodes.get(node))


@router.get("/{node}/scene", summary="The node's scene", responses=_UNKNOWN)
async def get_scene(node: str, server: ServerState) -> dict[str, Any]:
    """Return the content of the node's scene file, with defaults."""
    return server.nodes.get(node).hello.scene


@router.get("/{node}/history", summary="History of the last minute", responses=_UNKNOWN)
async def get_history(
    node: str, query: Annotated[RecentQuery, Query()], server: ServerState
) -> RecentView:
    """Return the GRF of the last seconds, up to a minute, from the server's memory.

    Each span has minimum and maximum, so that no peak hides. Only frames of the present stream that
    came since the server was started; where frames are missing, numbers are missing.
    """
    the_node = server.nodes.get(node)
    rows = server.broadcaster.get_present_stream_history(the_node).get_force_spans(
        query.seconds, query.before_seq
    )
    age_ms = server.broadcaster.newest_frame_age_ms(the_node)
    numbers = {name: rows[name].tolist() for name in ("seq_first", "seq", "n", "t_ns")}
    forces = {
        name: round_values(rows[name], "n") for name in ForceSpan._fields if name.startswith("grf_")
    }
    return RecentView(
        node=the_node.name,
        stream_id=the_node.stream_id,
        age_ms=None if age_ms is None else round(age_ms, 1),
        tiles=None
        if query.tiles is None
        else _make_tiles_view(the_node, query, query.tiles, server),
        **(numbers | forces),
    )


def _make_tiles_view(
    node: ServerNode, query: RecentQuery, unit: str, server: Server
) -> RecentTilesView:
    history = server.broadcaster.get_present_stream_history(node)
    spans = history.get_tile_spans(query.seconds, query.before_seq)
    extremes = spans["extremes"][:, :, TILE_QUANTITIES.index(unit)].swapaxes(0, 1)
    least, greatest = ([_round_four_digits(row) for row in rows] for rows in extremes.tolist())
    numbers = {name: spans[name].tolist() for name in ("seq_first", "seq", "n", "t_ns")}
    return RecentTilesView(min=least, max=greatest, **numbers)


def _round_four_digits(values: list[float]) -> list[float | None]:
    return [float(f"{value:.4g}") if isfinite(value) else None for value in values]


@router.post(
    "/{node}/tare",
    summary="Tare",
    status_code=HTTPStatus.CREATED,
    responses=problem_responses(
        _UNKNOWN,
        _409="The foot is loaded or moves, or the node is not connected.",
        _412="Another tare is in force than If-Match names.",
        _507="Disk full.",
    ),
)
async def tare_node(
    node: str, server: ServerState, request: TareRequest | None = None, if_match: InForce = None
) -> TareView:
    """Use the newest unloaded quarter of a second of the last ten seconds as the baseline.

    It may lie in a flight phase. The former tare stays in the history and is in force again if this
    one is undone.
    """
    the_node = server.nodes.get(node)
    _check_tare_in_force(the_node, if_match)
    recorded = the_node.tare_now(request.reason.strip() if request is not None else "")
    server.notify_node_changed(the_node)
    return make_tare_view(recorded)


@router.get("/{node}/tares", summary="History of tares", responses=_UNKNOWN)
async def list_tares(node: str, server: ServerState) -> TaresPage:
    """Return the tares, newest first; the first valid one of the present tiles is in force."""
    the_node = server.nodes.get(node)
    items = [
        make_tare_view(t) for t in reversed(the_node.estimator.tare_history.all_tares_with_undone)
    ]
    return TaresPage(items=items, drift=make_drift_view(the_node))


@router.delete(
    "/{node}/tares/{tare_id}",
    summary="Undo a tare",
    **NO_CONTENT,
    responses=problem_responses(
        _404="No such node, or no such tare that is not undone.",
        _412="Another tare is in force than If-Match names.",
        _507="Disk full.",
    ),
)
async def undo_tare(node: str, tare_id: str, server: ServerState, if_match: InForce = None) -> None:
    """Put the tare before it in force again; this one stays in the history, marked as undone.

    After undoing an automatic tare, no other automatic one follows until a tare by hand.
    """
    the_node = server.nodes.get(node)
    _check_tare_in_force(the_node, if_match)
    the_node.estimator.tare_controller.undo_tare(tare_id)
    server.notify_node_changed(the_node)


@router.post(
    "/{node}/accept-replacement",
    summary="Accept another machine under the name of a node",
    **NO_CONTENT,
    responses=problem_responses(
        _UNKNOWN,
        _409="No machine was refused under this name.",
        _412="Another machine was refused last.",
        _507="Disk full.",
    ),
)
async def accept_replacement(
    node: str, request: AcceptReplacementRequest, server: ServerState
) -> None:
    """Accept the machine in `replacement` as the node from now on.

    Accept it if the node's storage was replaced or its folder deleted, and the machine itself
    prints this fingerprint. The former machine is disconnected, and refused from then on.
    """
    server.accept_replacement(node, request.fingerprint)
