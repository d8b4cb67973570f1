"""Routes of sessions: start, stop, list, describe, mark."""

from __future__ import annotations

import re
from http import HTTPStatus
from itertools import islice, takewhile
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints

from devices.facts import check_new_name, check_new_text
from service.api.routes.access import (
    CHANGED,
    FULL,
    IdempotencyKey,
    IfMatch,
    ServerState,
    asked_with,
    problems,
    stored_table,
    tag_of,
)
from service.private_paths import ShownText
from service.server.screens.views import EventView, Page, SessionView
from storage.formats.written.parquet import PARQUET
from storage.sessions.beside import EVENTS_NAME
from storage.sessions.choice import Choice, completeness_of, instant_ns
from storage.sessions.folder import Ledger

router = APIRouter(prefix="/sessions", tags=["sessions"])

SETTLE_S = 5.0
"""Time that a stop waits for the sealed file before it answers."""

_UNKNOWN = problems(_404="No such session.", _409="Its files are damaged.")
_NO_EVENT = problems(_404="No such session or event.", _409="Its files are damaged.")

Name = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=200),
    AfterValidator(check_new_name),
]
Text = Annotated[str, StringConstraints(max_length=10_000), AfterValidator(check_new_text)]
Tag = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=100),
    AfterValidator(check_new_name),
]
Tags = Annotated[tuple[Tag, ...], Field(max_length=50)]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class SessionPage(Page[SessionView]):
    """Page of sessions."""

    unreadable: dict[str, ShownText] = Field(
        default={},
        description="Sessions with damaged files, and the errors, by id. No frames are dropped "
        "meanwhile; see `foottile verify`.",
    )


class Describe(_Body):
    """User-written description of a recording."""

    name: Name = Field(examples=["mud, third trial"])
    pre_roll_s: Annotated[float, Field(ge=0, le=600, allow_inf_nan=False, strict=True)] = Field(
        default=0.0, description="Pre-roll, as long as the server still has the frames."
    )
    subject: Name | None = None
    notes: Text = ""
    tags: Tags = ()


class StartSession(Describe):
    """Request to record a node."""

    node: str = Field(examples=["demo"])


class ChangeSession(_Body):
    """Changes of a session's description; omitted fields are unchanged."""

    name: Name | None = None
    subject: Annotated[Text, AfterValidator(check_new_name)] | None = None
    notes: Text | None = None
    tags: Tags | None = None


class MarkEvent(_Body):
    """New marker."""

    label: Name = Field(examples=["stepped on a stone"])
    t_ns: Annotated[int, Field(ge=0, lt=2**63, strict=True)] | None = Field(
        default=None, description="Server's UTC; default: now."
    )
    id: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{12}$")] | None = Field(
        default=None, description="Id of your choice, so that a repeated request adds one marker."
    )


class ChangeEvent(_Body):
    """Changes of a marker; omitted fields are unchanged."""

    label: Name | None = None
    t_ns: Annotated[int, Field(ge=0, lt=2**63, strict=True)] | None = Field(
        default=None, description="Server's UTC."
    )


@router.post(
    "",
    operation_id="startSession",
    summary="Start recording",
    status_code=HTTPStatus.CREATED,
    responses={
        **problems(
            _404="No such node.",
            _409="The node is not connected, or far behind; or the session of this key is in "
            "the trash.",
            _422="Invalid body, or the Idempotency-Key came with another request.",
        ),
        **FULL,
    },
)
async def start(
    body: StartSession,
    server: ServerState,
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> SessionView:
    """Record a node from its next frame on, or from `pre_roll_s` earlier.

    Several sessions may be recorded on one node at a time; each is stopped by its id.
    """
    record = asked_with(idempotency_key, "session", body)
    earlier = server.sessions.begun_by(record)
    if earlier:
        session = earlier[0]
    else:
        session = server.recorder.start(
            body.node,
            body.name,
            pre_roll_s=body.pre_roll_s,
            subject=body.subject or "",
            notes=body.notes,
            tags=body.tags,
            asked=record,
        )
        server.tell_node(server.nodes.get(body.node))
    response.headers["Location"] = f"/api/v1/sessions/{session.id}"
    return SessionView.of(session, server.recorder)


@router.post(
    "/{session_id}/stop",
    operation_id="stopSession",
    summary="Stop recording",
    responses={**_UNKNOWN, **FULL},
)
async def stop(session_id: str, server: ServerState) -> SessionView:
    """Stop a session now and seal it; answers when it is sealed, or after five seconds.

    A stopped session is unchanged: stopping twice is the same. If the node is not connected the
    session is `pending`, and completes when the node is back.
    """
    session = server.recorder.stop(session_id)
    node = server.nodes.find(session.node)  # its folder may be gone
    if node is not None:
        server.tell_node(node)
    if node is not None and node.connected:
        session = await server.settling.settled(session_id, SETTLE_S)
    return SessionView.of(session, server.recorder)


@router.post(
    "/{session_id}/seal",
    operation_id="sealSession",
    summary="Seal without what is missing",
    responses={**_UNKNOWN, **problems(_409="It is not pending."), **FULL},
)
async def seal(session_id: str, server: ServerState) -> SessionView:
    """Seal a pending session without its missing frames, because its node never comes back.

    It is sealed as lossy: the missing frames are lost, reason `given_up`.
    """
    server.recorder.give_up(session_id)
    session = await server.settling.settled(session_id, SETTLE_S)
    return SessionView.of(session, server.recorder)


@router.get("", operation_id="listSessions", summary="Sessions, newest first")
async def list_sessions(
    server: ServerState,
    cursor: Annotated[str | None, Query(description="Cursor of the previous page.")] = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    q: Annotated[
        str | None,
        Query(max_length=200, description="Search text in name, subject, notes, tags and node."),
    ] = None,
    take: Annotated[str | None, Query(max_length=100, description="Filter by take.")] = None,
    node: Annotated[
        tuple[str, ...],
        Query(max_length=100, description="Filter by node (repeat to allow several)."),
    ] = (),
    tag: Annotated[
        tuple[str, ...],
        Query(max_length=50, description="Filter by tag (repeat to require several)."),
    ] = (),
    from_: Annotated[
        str | None,
        Query(
            alias="from",
            max_length=40,
            description="Started at this time or later: ISO 8601, UTC if without an offset, or "
            "nanoseconds since 1970.",
            examples=["2026-11-24T08:00:00Z"],
        ),
    ] = None,
    to: Annotated[str | None, Query(max_length=40, description="Started before this time.")] = None,
    complete: Annotated[
        Literal["true", "false", "lossy"] | None,
        Query(description="Filter by completeness: complete, pending, or lossy."),
    ] = None,
) -> SessionPage:
    """Return a page of the sessions that pass all filters."""
    choice = Choice(
        nodes=node,
        tags=tag,
        take=take,
        q=q,
        from_t_ns=None if from_ is None else instant_ns(from_, where="from"),
        to_t_ns=None if to is None else instant_ns(to, where="to"),
        complete=None if complete is None else completeness_of(complete, where="complete"),
    )
    ends = [] if cursor is None else [_key_of(cursor)]
    if choice.to_t_ns is not None:
        ends.append((choice.to_t_ns, ""))
    since_t_ns = choice.from_t_ns or 0
    listed = server.sessions.newest_first(min(ends, default=None))
    recent = takewhile(lambda session: session.started_t_ns >= since_t_ns, listed)
    get_completeness = server.recorder.completeness_of
    found = (session for session in recent if choice.takes(session, get_completeness))
    page = list(islice(found, limit))
    more = next(found, None) is not None
    return SessionPage(
        items=[SessionView.of(session, server.recorder) for session in page],
        unreadable=server.sessions.unreadable,
        next_cursor=f"{page[-1].started_t_ns}.{page[-1].id}" if more else None,
    )


@router.get(
    "/{session_id}",
    operation_id="getSession",
    summary="One session",
    responses=_UNKNOWN,
)
async def get_session(session_id: str, server: ServerState) -> SessionView:
    """Return the present state of a session."""
    return SessionView.of(server.sessions.get(session_id), server.recorder)


@router.patch(
    "/{session_id}",
    operation_id="changeSession",
    summary="Rename or annotate",
    responses={**_UNKNOWN, **CHANGED, **FULL},
)
async def change(
    session_id: str, body: ChangeSession, server: ServerState, if_match: IfMatch = None
) -> SessionView:
    """Change name, subject, notes or tags; the sealed data does not change."""
    changes = {n: v for n, v in body.model_dump(exclude_unset=True).items() if v is not None}
    session = server.sessions.change(session_id, only_if=tag_of(if_match), **changes)
    return SessionView.of(session, server.recorder)


@router.delete(
    "/{session_id}",
    operation_id="deleteSession",
    summary="Move to the trash",
    status_code=HTTPStatus.NO_CONTENT,
    response_model=None,
    responses={
        **_UNKNOWN,
        **problems(_409="It is being recorded, or sealed."),
        **CHANGED,
        **FULL,
    },
)
async def delete(session_id: str, server: ServerState, if_match: IfMatch = None) -> None:
    """Move a session to the trash, where it can be restored.

    Only emptying the trash frees its space.
    """
    server.recorder.discard(session_id, only_if=tag_of(if_match))
    server.hub.notice({"type": "deleted", "session_id": session_id})


@router.post(
    "/{session_id}/events",
    operation_id="markEvent",
    summary="Add a marker",
    status_code=HTTPStatus.CREATED,
    responses={**_UNKNOWN, **FULL},
)
async def mark(session_id: str, body: MarkEvent, server: ServerState) -> EventView:
    """Add a marker, now or at a given time."""
    event = server.sessions.mark(session_id, body.label, body.t_ns, body.id)
    return EventView.of(event)


@router.patch(
    "/{session_id}/events/{event_id}",
    operation_id="changeEvent",
    summary="Rename or move a marker",
    responses={**_NO_EVENT, **CHANGED, **FULL},
)
async def change_mark(
    session_id: str,
    event_id: str,
    body: ChangeEvent,
    server: ServerState,
    if_match: IfMatch = None,
) -> EventView:
    """Change a marker's label or time."""
    changes = {n: v for n, v in body.model_dump(exclude_unset=True).items() if v is not None}
    only_if = tag_of(if_match)
    return EventView.of(
        server.sessions.change_mark(session_id, event_id, only_if=only_if, **changes)
    )


@router.delete(
    "/{session_id}/events/{event_id}",
    operation_id="deleteEvent",
    summary="Delete a marker",
    status_code=HTTPStatus.NO_CONTENT,
    response_model=None,
    responses={**_NO_EVENT, **CHANGED, **FULL},
)
async def remove_mark(
    session_id: str, event_id: str, server: ServerState, if_match: IfMatch = None
) -> None:
    """Delete a marker for good; its `id` can be used again."""
    server.sessions.remove_mark(session_id, event_id, only_if=tag_of(if_match))


@router.get(
    "/{session_id}/events",
    operation_id="listEvents",
    summary="Markers",
    response_model=Page[EventView],
    responses={
        200: {
            "description": "List, or the stored table.",
            "content": {PARQUET.media_type: {}},
        },
        **problems(
            _404="No such session, or its table is missing.",
            _409="The table is written when the session is sealed.",
        ),
    },
)
async def events(
    session_id: str,
    server: ServerState,
    format: Literal["json", "parquet"] = "json",  # noqa: A002  # the query's name
) -> Page[EventView] | Response:
    """Return markers in order of time; `format=parquet` is the stored `events.parquet`."""
    session = server.sessions.get(session_id)
    if format == "parquet":
        return stored_table(session, server.sessions.folder.path(session_id) / EVENTS_NAME)
    marked = sorted(session.events, key=lambda event: event.t_ns)
    return Page(items=[EventView.of(event) for event in marked])


@router.get("/{session_id}/ledger", operation_id="getLedger", summary="Ledger", responses=_UNKNOWN)
async def ledger(session_id: str, server: ServerState) -> Ledger:
    """Return the fate of every frame: recorded, lost for a reason, or still with the node."""
    return server.recorder.ledger(session_id)


def _key_of(cursor: str) -> tuple[int, str]:
    t_ns, _, session_id = cursor.partition(".")
    number = re.fullmatch(r"[0-9]{1,19}", t_ns)
    return (int(t_ns), session_id) if number else (0, "")
