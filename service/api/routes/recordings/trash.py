"""Sessions that were deleted."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import Field

from service.api.routes.access import ServerState, problems
from service.server.screens.views import Page, SessionView, View

router = APIRouter(prefix="/trash", tags=["trash"])


class Emptied(View):
    """What was deleted for good."""

    sessions: int
    bytes: int = Field(description="Of all their files.")


@router.get("", operation_id="listTrash", summary="Deleted sessions, newest first")
async def list_trash(server: ServerState) -> Page[SessionView]:
    """Each can be had back."""
    deleted = server.sessions.trash.all()
    return Page(items=[SessionView.of(session, server.recorder) for session in deleted])


@router.post(
    "/{session_id}/restore",
    operation_id="restoreSession",
    summary="Have a session back",
    responses=problems(_404="No such session in the trash.", _507="The disk is full."),
)
async def restore(session_id: str, server: ServerState) -> SessionView:
    """It is as it was; if it was pending, it completes when its node has returned."""
    return SessionView.of(server.recorder.restore(session_id), server.recorder)


@router.delete(
    "",
    operation_id="emptyTrash",
    summary="Delete them for good",
    responses=problems(_507="The data folder cannot be written."),
)
async def empty(server: ServerState) -> Emptied:
    """Nothing brings them back."""
    sessions, size_bytes = await server.empty_trash()
    return Emptied(sessions=sessions, bytes=size_bytes)
