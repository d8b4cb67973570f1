"""Routes of the trash."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import Field

from service.api.routes.common import ServerState, problem_responses
from service.server.broadcast.views import Page, SessionView, View

router = APIRouter(prefix="/trash", tags=["trash"])


class Emptied(View):
    """Result of emptying the trash."""

    sessions: int
    bytes: int = Field(description="Size of all their files.")


@router.get("", operation_id="listTrash", summary="Deleted sessions, newest first")
async def list_trash(server: ServerState) -> Page[SessionView]:
    """Return deleted sessions, newest first; each can be restored."""
    deleted = server.sessions.trash.list_sessions()
    return Page(items=[SessionView.from_session(session, server.recorder) for session in deleted])


@router.post(
    "/{session_id}/restore",
    operation_id="restoreSession",
    summary="Restore a session",
    responses=problem_responses(_404="No such session in the trash.", _507="The disk is full."),
)
async def restore_session(session_id: str, server: ServerState) -> SessionView:
    """Restore a session; a pending one completes when its node is back."""
    return SessionView.from_session(server.recorder.restore_session(session_id), server.recorder)


@router.delete(
    "",
    operation_id="emptyTrash",
    summary="Empty the trash",
    responses=problem_responses(_507="The data folder cannot be written."),
)
async def empty_trash(server: ServerState) -> Emptied:
    """Delete all sessions in the trash for good."""
    deleted = await server.empty_trash()
    return Emptied(sessions=deleted.session_count, bytes=deleted.size_bytes)
