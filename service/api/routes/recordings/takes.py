"""Takes: sessions of several nodes that were recorded together, and their data as one table."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from devices.errors import StateError
from service.api.routes.common import (
    UNCHANGED,
    IdempotencyKey,
    ServerState,
    make_idempotency_record,
    problem_responses,
    require_frames,
)
from service.api.routes.exports import Chunks, TakeDataQuery, make_file_stem, respond_with_export
from service.api.routes.recordings import sessions as one
from service.protocol.live import SessionView, View
from service.server.broadcast.views import make_session_view
from service.server.server import Server
from service.server.takes import Take
from service.user_folders import PublicText
from storage.formats.export import compute_take_offsets_s, make_sealed_export
from storage.formats.markers import PlacedMarkers
from storage.formats.writers.registry import FORMATS, MULTI_SESSION_FORMATS
from storage.sessions.folder import Session

router = APIRouter(prefix="/takes", tags=["takes"])

_UNKNOWN = problem_responses(_404="No such take.")
_FAILED = problem_responses(_409="It failed on every node.")
_OVER = problem_responses(_409="No session is being recorded, or it failed on every node.")


class StartTake(one.RecordingDescription):
    """Request to record several nodes."""

    nodes: Annotated[tuple[str, ...], Field(min_length=1, max_length=1000)] | None = Field(
        default=None, description="Default: all connected nodes.", examples=[["left", "right"]]
    )


class TakeView(View):
    """Take, or the result of a command on all of its sessions."""

    id: str = Field(examples=["1a2b3c4d5e6f"])
    sessions: list[SessionView] = Field(
        description="Sessions on which the command succeeded; for a take, all."
    )
    failed: dict[str, PublicText] = Field(
        description="Errors by node; the other nodes are not affected.",
        examples=[{"left": "node 'left' sends no frames. Connect it and retry"}],
    )

    @classmethod
    def from_take(cls, take: Take, server: Server) -> TakeView:
        """Return the present state of a take."""
        views = [make_session_view(session, server.recorder) for session in take.sessions]
        return cls(id=take.id, sessions=views, failed=take.errors_by_node)


@router.post(
    "",
    summary="Record several nodes together",
    status_code=HTTPStatus.CREATED,
    responses=problem_responses(
        _409="No node can be recorded; or a session of this key is in the trash.",
        _422="Invalid body, or the Idempotency-Key came with another request.",
    ),
)
async def start_take(
    body: StartTake, server: ServerState, response: Response, idempotency_key: IdempotencyKey = None
) -> TakeView:
    """Start one session per node, with one name and one `take`.

    A node that cannot be recorded is in `failed` with the reason; the others are recorded. A
    repeated request with the same key starts no session later.
    """
    take = server.takes.start_take_where_possible(
        body.name,
        body.nodes,
        pre_roll_s=body.pre_roll_s,
        subject=body.subject or "",
        notes=body.notes,
        tags=body.tags,
        request=make_idempotency_record(idempotency_key, "take", body),
    )
    server.notify_nodes_changed(take.sessions)
    response.headers["Location"] = f"/api/v1/takes/{take.id}"
    return TakeView.from_take(take, server)


@router.get("/{take_id}", summary="One take", responses=_UNKNOWN)
async def get_take(take_id: str, server: ServerState) -> TakeView:
    """Return the present sessions of a take, without those in the trash."""
    return TakeView.from_take(server.takes.get_take(take_id), server)


@router.post(
    "/{take_id}/stop", summary="Stop all of a take", responses=problem_responses(_UNKNOWN, _FAILED)
)
async def stop_take(take_id: str, server: ServerState) -> TakeView:
    """Stop all sessions of a take that are being recorded.

    Stopped ones are unchanged, and are in the answer, too.
    """
    take = server.takes.stop_take(take_id)
    server.notify_nodes_changed(take.sessions)
    connected = [node.name for node in server.nodes if node.is_connected]
    settled = [
        server.recorder.wait_until_sealed_or_timeout(session.id, one.SEAL_TIMEOUT_S)
        for session in take.sessions
        if session.node in connected
    ]
    await asyncio.gather(*settled)
    now = [server.sessions.get_session(session.id) for session in take.sessions]
    return TakeView.from_take(Take(take.id, now, take.errors_by_node), server)


@router.post(
    "/{take_id}/markers",
    summary="Add a marker to all of a take",
    status_code=HTTPStatus.CREATED,
    responses=problem_responses(_UNKNOWN, _OVER),
)
async def mark_take(take_id: str, body: one.AddMarker, server: ServerState) -> TakeView:
    """Add a marker at one time and with one id to all sessions that are being recorded."""
    return TakeView.from_take(
        server.takes.add_marker_to_recording_sessions(take_id, body.label, body.t_ns, body.id),
        server,
    )


data_router = APIRouter(prefix="/takes", tags=["data"])


@data_router.get(
    "/{take_id}/data",
    summary="Download all of a take as one file",
    response_class=Response,
    responses=problem_responses(
        {
            200: {
                "description": "The data.",
                "content": {FORMATS[name].media_type: {} for name in MULTI_SESSION_FORMATS},
            }
        },
        UNCHANGED,
        _404="No such take, or one of its sessions has no frames.",
        _409="One of its sessions is not sealed.",
        _422="A format for one session only, or a session that cannot be in it.",
    ),
)
async def get_take_data(
    take_id: str, query: Annotated[TakeDataQuery, Query()], request: Request, server: ServerState
) -> Response:
    """Return the sessions of a take on the server's time axis, each with its uncertainty.

    They are in the order of their nodes, without those in the trash. Seconds count from the first
    frame of all, by the server's clock. `Foottile-Complete` is `lossy` if one of the sessions is;
    `Foottile-Remarks` as for one session.
    """
    to = query.format_spec
    sessions = [require_frames(session) for session in server.takes.get_take(take_id).sessions]
    for session in sessions:
        if session.sha256 is None:
            raise StateError(
                f"session {session.id} of {session.node} is {session.state}, and {to.title} of a "
                "take is available when all of it is sealed",
                remedy="Stop it, or ask for each session by itself",
            )
    is_lossy = any(server.recorder.get_ledger(session.id).lossy for session in sessions)
    offsets_s = await run_in_threadpool(_compute_offsets_s, sessions, server)
    return await respond_with_export(
        sessions,
        offsets_s,
        partial(_write_exports, sessions, offsets_s, query, server),
        query,
        request,
        server,
        make_file_stem(sessions[0].name, f"take-{take_id}", query.slice),
        {"Foottile-Complete": "lossy" if is_lossy else "true"},
    )


def _compute_offsets_s(sessions: list[Session], server: Server) -> list[float]:
    with ExitStack() as opened:
        return compute_take_offsets_s(
            [
                opened.enter_context(server.sessions.open_frames(session.id, only_slices=True))
                for session in sessions
            ]
        )


def _write_exports(
    sessions: list[Session],
    offsets_s: list[float],
    query: TakeDataQuery,
    server: Server,
    markers: list[PlacedMarkers] | None,
    remarks: list[str],
) -> Chunks:
    part = query.slice
    with ExitStack() as opened:
        exports = [
            make_sealed_export(
                opened.enter_context(
                    server.sessions.open_frames(
                        session.id, only_slices=not part.has_all_rows_and_columns
                    )
                ),
                part,
                clock=query.clock_name,
                markers=None if markers is None else markers[number],
                options=query.options,
                take_offset_s=offset_s,
            )
            for number, (session, offset_s) in enumerate(zip(sessions, offsets_s, strict=True))
        ]
        yield from query.format_spec.encode_together_on_server_clock(
            [replace(export, remarks=remarks) for export in exports]
        )
