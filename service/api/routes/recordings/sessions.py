"""Routes of sessions and of the trash."""

from __future__ import annotations

import re
from http import HTTPStatus
from itertools import islice, takewhile
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response
from pydantic import AfterValidator, Field, StringConstraints

from devices.types import StrictModel, TNs, check_user_name, check_user_text
from service.api.routes.common import (
    CHANGED,
    FULL,
    NO_CONTENT,
    IdempotencyKey,
    IfMatch,
    Name,
    ServerState,
    make_idempotency_record,
    parse_if_match,
    problem_responses,
    stored_table_response,
)
from service.protocol.live import SessionDeleted, SessionView, View
from service.server.broadcast.views import MarkerView, Page, make_marker_view, make_session_view
from service.user_folders import PublicText
from storage.formats.writers.tables import PARQUET
from storage.sessions.folder import Ledger
from storage.sessions.metadata import (
    MARKERS_NAME,
    SessionFilter,
    parse_completeness,
    parse_iso_or_t_ns,
)

router = APIRouter(prefix="/sessions", tags=["sessions"])

SEAL_TIMEOUT_S = 5.0
"""Time that a stop waits for the sealed file before it answers."""

_UNKNOWN = problem_responses(_404="No such session.", _409="Its files are damaged.")
_NO_MARKER = problem_responses(_404="No such session or marker.", _409="Its files are damaged.")

Text = Annotated[str, StringConstraints(max_length=10_000), AfterValidator(check_user_text)]
Tag = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=100),
    AfterValidator(check_user_name),
]
Tags = Annotated[tuple[Tag, ...], Field(max_length=50)]


class SessionPage(Page[SessionView]):
    """Page of sessions."""

    unreadable: dict[str, PublicText] = Field(
        default={},
        description="Sessions with damaged files, and the errors, by id. No frames are dropped "
        "meanwhile; see `foottile verify`.",
    )


class RecordingDescription(StrictModel):
    """User-written description of a recording."""

    name: Name = Field(examples=["mud, third trial"])
    pre_roll_s: Annotated[float, Field(ge=0, le=600, strict=True)] = Field(
        default=0.0, description="Pre-roll, as long as the server still has the frames."
    )
    subject: Name | None = None
    notes: Text = ""
    tags: Tags = ()


class StartSession(RecordingDescription):
    """Request to record a node."""

    node: str = Field(examples=["demo"])


class ChangeSession(StrictModel):
    """Changes of a session's description; omitted fields are unchanged."""

    name: Name | None = None
    subject: Annotated[Text, AfterValidator(check_user_name)] | None = None
    notes: Text | None = None
    tags: Tags | None = None


class AddMarker(StrictModel):
    """New marker."""

    label: Name = Field(examples=["stepped on a stone"])
    t_ns: Annotated[TNs, Field(strict=True)] | None = Field(
        default=None, description="Server's UTC; default: now."
    )
    id: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{12}$")] | None = Field(
        default=None, description="Id of your choice, so that a repeated request adds one marker."
    )


class ChangeMarker(StrictModel):
    """Changes of a marker; omitted fields are unchanged."""

    label: Name | None = None
    t_ns: Annotated[TNs, Field(strict=True)] | None = Field(
        default=None, description="Server's UTC."
    )


@router.post(
    "",
    summary="Start recording",
    status_code=HTTPStatus.CREATED,
    responses=problem_responses(
        FULL,
        _404="No such node.",
        _409="The node is not connected, or far behind; or the session of this key is in "
        "the trash.",
        _422="Invalid body, or the Idempotency-Key came with another request.",
    ),
)
async def start_session(
    body: StartSession,
    server: ServerState,
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> SessionView:
    """Record a node from its next frame on, or from `pre_roll_s` earlier.

    Several sessions may be recorded on one node at a time; each is stopped by its id.
    """
    record = make_idempotency_record(idempotency_key, "session", body)
    earlier = server.sessions.find_by_idempotency_key(record)
    if earlier:
        session = earlier[0]
    else:
        session = server.recorder.start_session(
            body.node,
            body.name,
            pre_roll_s=body.pre_roll_s,
            subject=body.subject or "",
            notes=body.notes,
            tags=body.tags,
            request=record,
        )
        server.notify_node_changed(server.nodes.get(body.node))
    response.headers["Location"] = f"/api/v1/sessions/{session.id}"
    return make_session_view(session, server.recorder)


@router.post(
    "/{session_id}/stop", summary="Stop recording", responses=problem_responses(_UNKNOWN, FULL)
)
async def stop_session(session_id: str, server: ServerState) -> SessionView:
    """Stop a session now and seal it; answers when it is sealed, or after five seconds.

    A stopped session is unchanged: stopping twice is the same. If the node is not connected the
    session is `pending`, and completes when the node is back.
    """
    session = server.recorder.stop_session(session_id)
    server.notify_nodes_changed([session])
    node = server.nodes.find(session.node)  # its folder may be gone
    if node is not None and node.is_connected:
        session = await server.recorder.wait_until_sealed_or_timeout(session_id, SEAL_TIMEOUT_S)
    return make_session_view(session, server.recorder)


@router.post(
    "/{session_id}/abandon-missing",
    summary="Seal without what is missing",
    responses=problem_responses(_UNKNOWN, FULL, _409="It is not pending."),
)
async def abandon_missing(session_id: str, server: ServerState) -> SessionView:
    """Seal a pending session without its missing frames, because its node never comes back.

    It is sealed as lossy: the missing frames are lost, reason `abandoned`.
    """
    server.recorder.abandon_missing(session_id)
    session = await server.recorder.wait_until_sealed_or_timeout(session_id, SEAL_TIMEOUT_S)
    return make_session_view(session, server.recorder)


@router.get("", summary="Sessions, newest first")
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
        Query(description="Filter by completeness: true, false, or lossy."),
    ] = None,
) -> SessionPage:
    """Return a page of the sessions that pass all filters."""
    choice = SessionFilter(
        nodes=node,
        tags=tag,
        take=take,
        q=q,
        from_t_ns=None if from_ is None else parse_iso_or_t_ns(from_, where="from"),
        to_t_ns=None if to is None else parse_iso_or_t_ns(to, where="to"),
        complete=None if complete is None else parse_completeness(complete, where="complete"),
    )
    ends = [] if cursor is None else [_parse_cursor(cursor)]
    if choice.to_t_ns is not None:
        ends.append((choice.to_t_ns, ""))
    since_t_ns = choice.from_t_ns or 0
    listed = server.sessions.iterate_newest_first(min(ends, default=None))
    recent = takewhile(lambda session: session.started_t_ns >= since_t_ns, listed)
    found = (
        session
        for session in recent
        if choice.accepts(session, lambda each: server.recorder.compute_ledger(each).completeness)
    )
    page = list(islice(found, limit))
    more = next(found, None) is not None
    return SessionPage(
        items=[make_session_view(session, server.recorder) for session in page],
        unreadable=server.sessions.unreadable,
        next_cursor=f"{page[-1].started_t_ns}.{page[-1].id}" if more else None,
    )


@router.get("/{session_id}", summary="One session", responses=_UNKNOWN)
async def get_session(session_id: str, server: ServerState) -> SessionView:
    """Return the present state of a session."""
    return make_session_view(server.sessions.get_session(session_id), server.recorder)


@router.patch(
    "/{session_id}",
    summary="Rename or annotate",
    responses=problem_responses(_UNKNOWN, CHANGED, FULL),
)
async def change_session(
    session_id: str, body: ChangeSession, server: ServerState, if_match: IfMatch = None
) -> SessionView:
    """Change name, subject, notes or tags; the sealed data does not change."""
    changes = {n: v for n, v in body.model_dump(exclude_unset=True).items() if v is not None}
    session = server.sessions.edit_user_fields(
        session_id, if_revision=parse_if_match(if_match), **changes
    )
    return make_session_view(session, server.recorder)


@router.delete(
    "/{session_id}",
    summary="Move to the trash",
    **NO_CONTENT,
    responses=problem_responses(_UNKNOWN, CHANGED, FULL, _409="It is being recorded, or sealed."),
)
async def delete_session(session_id: str, server: ServerState, if_match: IfMatch = None) -> None:
    """Move a session to the trash, where it can be restored.

    Only emptying the trash frees its space.
    """
    server.recorder.move_to_trash(session_id, if_revision=parse_if_match(if_match))
    server.broadcaster.queue_notice(SessionDeleted(session_id=session_id))


@router.post(
    "/{session_id}/markers",
    summary="Add a marker",
    status_code=HTTPStatus.CREATED,
    responses=problem_responses(_UNKNOWN, FULL),
)
async def add_marker(session_id: str, body: AddMarker, server: ServerState) -> MarkerView:
    """Add a marker, now or at a given time."""
    event = server.sessions.add_marker(session_id, body.label, body.t_ns, body.id)
    return make_marker_view(event)


@router.patch(
    "/{session_id}/markers/{marker_id}",
    summary="Rename or move a marker",
    responses=problem_responses(_NO_MARKER, CHANGED, FULL),
)
async def change_marker(
    session_id: str,
    marker_id: str,
    body: ChangeMarker,
    server: ServerState,
    if_match: IfMatch = None,
) -> MarkerView:
    """Change a marker's label or time."""
    changes = {n: v for n, v in body.model_dump(exclude_unset=True).items() if v is not None}
    only_if = parse_if_match(if_match)
    return make_marker_view(
        server.sessions.edit_marker(session_id, marker_id, if_revision=only_if, **changes)
    )


@router.delete(
    "/{session_id}/markers/{marker_id}",
    summary="Delete a marker",
    **NO_CONTENT,
    responses=problem_responses(_NO_MARKER, CHANGED, FULL),
)
async def delete_marker(
    session_id: str, marker_id: str, server: ServerState, if_match: IfMatch = None
) -> None:
    """Delete a marker for good; its `id` can be used again."""
    server.sessions.remove_marker(session_id, marker_id, if_revision=parse_if_match(if_match))


@router.get(
    "/{session_id}/markers",
    summary="Markers",
    response_model=Page[MarkerView],
    responses=problem_responses(
        {200: {"description": "List, or the stored table.", "content": {PARQUET.media_type: {}}}},
        _404="No such session, or its table is missing.",
        _409="The table is written when the session is sealed.",
    ),
)
async def list_markers(
    session_id: str,
    server: ServerState,
    format: Literal["json", "parquet"] = "json",  # noqa: A002  # the query's name
) -> Page[MarkerView] | Response:
    """Return markers in order of time; `format=parquet` is the stored `markers.parquet`."""
    session = server.sessions.get_session(session_id)
    if format == "parquet":
        return stored_table_response(
            session, server.sessions.folder.get_path(session_id) / MARKERS_NAME
        )
    marked = sorted(session.markers, key=lambda event: event.t_ns)
    return Page(items=[make_marker_view(event) for event in marked])


@router.get("/{session_id}/ledger", summary="Ledger", responses=_UNKNOWN)
async def get_ledger(session_id: str, server: ServerState) -> Ledger:
    """Return the fate of every frame: recorded, lost for a reason, or still with the node."""
    return server.recorder.get_ledger(session_id)


def _parse_cursor(cursor: str) -> tuple[int, str]:
    t_ns, _, session_id = cursor.partition(".")
    number = re.fullmatch(r"[0-9]{1,19}", t_ns)
    return (int(t_ns), session_id) if number else (0, "")


trash_router = APIRouter(prefix="/trash", tags=["trash"])


class Emptied(View):
    """Result of emptying the trash."""

    sessions: int
    bytes: int = Field(description="Size of all their files.")


@trash_router.get("", summary="Deleted sessions, newest first")
async def list_trash(server: ServerState) -> Page[SessionView]:
    """Return deleted sessions, newest first; each can be restored."""
    deleted = server.sessions.trash.list_sessions()
    return Page(items=[make_session_view(session, server.recorder) for session in deleted])


@trash_router.post(
    "/{session_id}/restore",
    summary="Restore a session",
    responses=problem_responses(_404="No such session in the trash.", _507="The disk is full."),
)
async def restore_session(session_id: str, server: ServerState) -> SessionView:
    """Restore a session; a pending one completes when its node is back."""
    return make_session_view(server.recorder.restore_session(session_id), server.recorder)


@trash_router.delete("", summary="Empty the trash", responses=FULL)
async def empty_trash(server: ServerState) -> Emptied:
    """Delete all sessions in the trash for good."""
    deleted = await server.empty_trash()
    return Emptied(sessions=deleted.session_count, bytes=deleted.size_bytes)
