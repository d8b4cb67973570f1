"""What a sealed session's files prove of themselves, read again on the server."""

from __future__ import annotations

from functools import partial
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter
from pydantic import Field

from devices.errors import FileFormatError, StateError, UnknownError
from service.api.routes.access import ServerState, problems
from service.private_paths import ShownText
from storage.sessions.folder import Ledger
from storage.verify.session import verify_session

router = APIRouter(prefix="/sessions", tags=["sessions"])

_ONE_AT_A_TIME = CapacityLimiter(1)
"""It reads every frame: of several that are asked for one after the other is."""


class VerificationView(Ledger):
    """What `foottile verify --json` says: the ledger, and what was found."""

    id: str | None
    problems: list[ShownText] = Field(description="What is wrong; none: it is whole.")
    sha256: str | None = Field(
        description="Of the file of frames as it is now; null: there is none."
    )
    unproven: list[str] = Field(description="What these files cannot show.")


@router.get(
    "/{session_id}/verification",
    operation_id="getVerification",
    summary="Is it what was sealed?",
    response_model=VerificationView,
    responses=problems(
        _404="No such session.",
        _409="It is not sealed yet: nothing of it is final.",
    ),
)
async def verification(session_id: str, server: ServerState) -> dict[str, Any]:
    """Read all files of a sealed session, and hold them against one another and their hashes.

    What is found wrong is in `problems`, and changes nothing. It takes about a second for a
    million frames, and one is read at a time. Whether the server itself is to be trusted it
    cannot show: `foottile pull` and `foottile verify` do the same on another machine.
    """
    session = server.sessions.get(session_id)
    if session.state != "sealed":
        raise StateError(
            f"session {session_id} is {session.state}, and can be verified when it is sealed",
            remedy="Stop it",
        )
    read = partial(verify_session, server.sessions.folder.path(session_id))
    try:
        report = await to_thread.run_sync(read, limiter=_ONE_AT_A_TIME)
    except FileFormatError as error:  # it was deleted meanwhile
        raise UnknownError(f"session {session_id}: {error.what}", where=error.where) from error
    return report.as_dict()
