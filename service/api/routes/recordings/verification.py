"""Route that verifies the files of a sealed session."""

from __future__ import annotations

from functools import partial
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter
from pydantic import Field

from devices.errors import FileFormatError, StateError, UnknownError
from service.api.routes.common import ServerState, problem_responses
from service.private_paths import PublicText
from storage.sessions.folder import Ledger
from storage.verify.session import verify_session

router = APIRouter(prefix="/sessions", tags=["sessions"])

_ONE_AT_A_TIME = CapacityLimiter(1)
"""One thread: verification reads every frame."""


class VerificationView(Ledger):
    """Result of the verification: the ledger, and the problems found."""

    id: str | None
    problems: list[PublicText] = Field(description="Problems found; none: the files are intact.")
    sha256: str | None = Field(
        description="Present hash of the file of frames; null: there is none."
    )


@router.get(
    "/{session_id}/verification",
    operation_id="getVerification",
    summary="Verify files",
    response_model=VerificationView,
    responses=problem_responses(
        _404="No such session.",
        _409="The session is not sealed.",
    ),
)
async def verify_session_files(session_id: str, server: ServerState) -> dict[str, Any]:
    """Read all files of a sealed session, and compare them with one another and their hashes.

    Errors are in `problems`; no file is changed. A million frames take about a second; requests run
    one after the other. This proves nothing about the server itself: `foottile pull` and `foottile
    verify` do the same on another machine.
    """
    session = server.sessions.get_session(session_id)
    if session.state != "sealed":
        raise StateError(
            f"session {session_id} is {session.state}, and can be verified when it is sealed",
            remedy="Stop it",
        )
    read = partial(verify_session, server.sessions.folder.get_path(session_id))
    try:
        report = await to_thread.run_sync(read, limiter=_ONE_AT_A_TIME)
    except FileFormatError as error:  # it was deleted meanwhile
        raise UnknownError(f"session {session_id}: {error.what}", where=error.where) from error
    content = report.to_json_dict()
    del content["unproven"]  # a server has all of a session's files
    return content
