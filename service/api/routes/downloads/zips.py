"""Several sealed sessions as one zip file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from devices.errors import StateError, UnknownError, UsageError
from service.api.routes.common import ServerState, problem_responses, require_file
from service.api.routes.downloads.exports import iterate_chunks
from storage.formats.zip_stream import ZippedSession, stream_zip
from storage.sessions.folder import FRAMES_NAME, Session

router = APIRouter(prefix="/sessions", tags=["data"])

IDS_MAX = 1000
"""Limit of ids: the size of a request's headers."""


@router.get(
    "/zip",
    operation_id="zipSessions",
    summary="Download several as one zip file",
    response_class=Response,
    responses={
        200: {"description": "The files of each, in a folder.", "content": {"application/zip": {}}},
        **problem_responses(
            _404="No such session.",
            _409="One is not sealed yet, or its files are damaged.",
            _422="No ids, or too many.",
        ),
    },
)
async def get_zip(
    ids: Annotated[
        str,
        Query(max_length=24 * IDS_MAX, description=f"With commas between; {IDS_MAX} at most."),
    ],
    server: ServerState,
) -> StreamingResponse:
    """Stream the files of sessions as they are: a folder each, as for `foottile verify`.

    A session that is damaged or deleted meanwhile aborts the download; the partial file opens as no
    zip file.
    """
    names = list(dict.fromkeys(name.strip() for name in ids.split(",") if name.strip()))
    if not 1 <= len(names) <= IDS_MAX:
        raise UsageError(f"{len(names)} sessions", expected=f"ids of 1 to {IDS_MAX}")
    chosen = [
        _require_sealed(server.sessions.get_session(name), server.sessions.folder.get_path(name))
        for name in names
    ]
    name = names[0] if len(names) == 1 else f"foottile-{len(names)}-sessions"
    headers = {
        "Content-Disposition": f'attachment; filename="{name}.zip"',
        "Cache-Control": "private, no-store",
    }
    pieces = stream_zip(chosen)
    # The first chunk now: a damaged file is then an answer, not a broken download.
    first = await run_in_threadpool(next, pieces)
    return StreamingResponse(
        iterate_chunks(pieces, first), headers=headers, media_type="application/zip"
    )


def _require_sealed(session: Session, folder: Path) -> ZippedSession:
    if session.state != "sealed":
        raise StateError(
            f"session {session.id} is {session.state}, and a zip file has sealed ones only",
            remedy="Stop it, or leave it out",
        )
    if session.sha256 is None:
        raise UnknownError(f"session {session.id}: {session.problem}")
    require_file(folder / FRAMES_NAME)
    return ZippedSession(folder, session.sha256)
