"""Nodes and their tares."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from service.api.routes.access import ServerState, problems
from service.server.screens.views import DriftView, NodeView, Page, TaresPage, TareView
from service.sessions.tares import REASON_LENGTH_MAX

router = APIRouter(prefix="/nodes", tags=["nodes"])


class TareRequest(BaseModel):
    """What may be said with a tare."""

    model_config = ConfigDict(extra="forbid")

    reason: str = Field(
        default="", max_length=REASON_LENGTH_MAX, description='For the history; else "by hand".'
    )


_UNKNOWN = problems(_404="No such node.")


@router.get("", operation_id="listNodes", summary="All nodes the server knows")
async def list_nodes(server: ServerState) -> Page[NodeView]:
    """Connected ones and those it remembers."""
    return Page(items=[NodeView.of(node, server.recorder) for node in server.nodes])


@router.get("/{node}", operation_id="getNode", summary="One node", responses=_UNKNOWN)
async def get_node(node: str, server: ServerState) -> NodeView:
    """Its array, calibration, tare, clock and counts."""
    return NodeView.of(server.nodes.get(node), server.recorder)


@router.get(
    "/{node}/scene", operation_id="getScene", summary="The node's scene", responses=_UNKNOWN
)
async def get_scene(node: str, server: ServerState) -> dict[str, Any]:
    """The content of its scene file, defaults filled in."""
    return server.nodes.get(node).hello.scene


@router.post(
    "/{node}/tare",
    operation_id="tareNode",
    summary="Tare",
    status_code=HTTPStatus.CREATED,
    responses={
        **_UNKNOWN,
        **problems(_409="The foot is loaded or moves, or the node is away.", _507="Disk full."),
    },
)
async def tare(node: str, server: ServerState, request: TareRequest | None = None) -> TareView:
    """Take the newest unloaded quarter of a second of the last ten seconds as the baseline.

    It may lie in a flight phase. The tare before is kept and comes back if this one is undone.
    """
    the_node = server.nodes.get(node)
    recorded = the_node.take_tare(request.reason.strip() if request is not None else "")
    server.tell_node(the_node)
    return TareView.of(recorded)


@router.get(
    "/{node}/tares", operation_id="listTares", summary="History of tares", responses=_UNKNOWN
)
async def list_tares(node: str, server: ServerState) -> TaresPage:
    """Newest first; the first one of the present tiles that is not undone is in force."""
    the_node = server.nodes.get(node)
    items = [TareView.of(t) for t in reversed(the_node.tares.all)]
    return TaresPage(items=items, drift=DriftView.of(the_node))


@router.delete(
    "/{node}/tares/{tare_id}",
    operation_id="undoTare",
    summary="Undo a tare",
    status_code=HTTPStatus.NO_CONTENT,
    responses=problems(_404="No such node, or no such tare that is not undone.", _507="Disk full."),
)
async def undo_tare(node: str, tare_id: str, server: ServerState) -> None:
    """The tare before it is in force again; it stays in the history, marked.

    If it was an automatic one, no other is taken until one is taken by hand.
    """
    the_node = server.nodes.get(node)
    the_node.tare_keeper.undo(tare_id)
    server.tell_node(the_node)
