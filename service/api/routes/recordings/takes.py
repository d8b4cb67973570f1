"""Several nodes at once: recorded, marked and stopped together, one session each."""

from __future__ import annotations

import asyncio
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Response
from pydantic import Field

from service.api.routes.access import IdempotencyKey, ServerState, asked_with, problems
from service.api.routes.recordings import sessions as one
from service.private_paths import ShownText
from service.server.screens.views import SessionView, View
from service.server.server import Server
from service.server.takes import Take

router = APIRouter(prefix="/takes", tags=["takes"])

_UNKNOWN = problems(_404="There is no session of this take.")
_FAILED = problems(_409="It failed on every node.")
_OVER = problems(_409="None of its sessions is being recorded, or it failed on every node.")


class StartTake(one.Describe):
    """What to record."""

    nodes: Annotated[tuple[str, ...], Field(min_length=1, max_length=1000)] | None = Field(
        default=None, description="Left out: all that are connected.", examples=[["left", "right"]]
    )


class TakeView(View):
    """A take, or what came of what was asked of all of it."""

    id: str = Field(examples=["1a2b3c4d5e6f"])
    sessions: list[SessionView] = Field(description="Where it was done; of a take, all it has.")
    failed: dict[str, ShownText] = Field(
        description="By node, why it was not done there. The others do not wait for that.",
        examples=[{"left": "node 'left' is not sending. Record when it is connected"}],
    )

    @classmethod
    def of(cls, take: Take, server: Server) -> TakeView:
        """As it is now."""
        views = [SessionView.of(session, server.recorder) for session in take.sessions]
        return cls(id=take.id, sessions=views, failed=take.failed)


@router.post(
    "",
    operation_id="startTake",
    summary="Record several nodes together",
    status_code=HTTPStatus.CREATED,
    responses=problems(
        _409="It can be recorded on no node; or what this request began is in the trash.",
        _422="Not as described, or the Idempotency-Key came with another request.",
    ),
)
async def start(
    body: StartTake, server: ServerState, response: Response, idempotency_key: IdempotencyKey = None
) -> TakeView:
    """One session a node, with one name and one `take`.

    A node that cannot be recorded is in `failed` with the reason, and the others are recorded. The
    same request with the same key begins none of them later.
    """
    take = server.takes.start(
        body.name,
        body.nodes,
        pre_roll_s=body.pre_roll_s,
        subject=body.subject or "",
        notes=body.notes,
        tags=body.tags,
        asked=asked_with(idempotency_key, "take", body),
    )
    _tell_nodes(server, take)
    response.headers["Location"] = f"/api/v1/takes/{take.id}"
    return TakeView.of(take, server)


@router.get("/{take_id}", operation_id="getTake", summary="A take", responses=_UNKNOWN)
async def get_take(take_id: str, server: ServerState) -> TakeView:
    """Its sessions as they are now, but for those in the trash."""
    return TakeView.of(server.takes.get(take_id), server)


@router.post(
    "/{take_id}/stop",
    operation_id="stopTake",
    summary="Stop all of a take",
    responses={**_UNKNOWN, **_FAILED},
)
async def stop(take_id: str, server: ServerState) -> TakeView:
    """End those of its sessions that are being recorded, as each is stopped by itself.

    Those that were stopped before stay as they are, and are in the answer, too.
    """
    take = server.takes.stop(take_id)
    _tell_nodes(server, take)
    there = [node.name for node in server.nodes if node.connected]
    settled = [
        server.settling.settled(session.id, one.SETTLE_S)
        for session in take.sessions
        if session.node in there
    ]
    await asyncio.gather(*settled)
    now = [server.sessions.get(session.id) for session in take.sessions]
    return TakeView.of(Take(take.id, now, take.failed), server)


@router.post(
    "/{take_id}/events",
    operation_id="markTake",
    summary="Mark an event in all of a take",
    status_code=HTTPStatus.CREATED,
    responses={**_UNKNOWN, **_OVER},
)
async def mark(take_id: str, body: one.MarkEvent, server: ServerState) -> TakeView:
    """In all of its sessions that are being recorded, at one instant and with one id."""
    return TakeView.of(server.takes.mark(take_id, body.label, body.t_ns, body.id), server)


def _tell_nodes(server: Server, take: Take) -> None:
    for session in take.sessions:
        node = server.nodes.find(session.node)  # its folder may be gone
        if node is not None:
            server.tell_node(node)
