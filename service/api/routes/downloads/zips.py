"""Several sealed sessions as one zip file.

Files are stored, not deflated: Parquet is compressed already. The directory of a zip file is its
end. If a session is damaged or removed meanwhile, the directory is never sent, so that no program
opens the incomplete archive.
"""

from __future__ import annotations

import hashlib
import time
import zipfile
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from devices.errors import DamagedFileError, StateError, StorageError, UnknownError, UsageError
from service.api.routes.common import ServerState, problem_responses, require_file
from service.api.routes.downloads.exports import iterate_chunks
from storage.clock.table import CLOCK_NAME
from storage.formats.writers.format import DrainedBuffer
from storage.sessions.folder import FRAMES_NAME, Session
from storage.sessions.metadata import MARKERS_NAME, SESSION_NAME, SUMS_NAME
from storage.sessions.stances import STANCES_NAME

_CHUNK_BYTES = 1 << 20
_ZIP_DATES_S = (315_619_200, 4_354_732_800)
"""Range of dates of a zip file: 2 January 1980 to 30 December 2107, in any time zone.

Files of 1970, from a machine without a clock, get the nearest date.
"""
_SIDECARS = (MARKERS_NAME, CLOCK_NAME, STANCES_NAME, SUMS_NAME)
"""Files beside the frames. Each can be verified; without estimates there are no stances."""


@dataclass(frozen=True)
class ZippedSession:
    """Sealed session to put into a zip file."""

    folder: Path
    frames_sha256: str
    """SHA-256 of its frames' file."""


def stream_zip(sessions: Iterable[ZippedSession]) -> Generator[bytes, None, None]:
    """Yield a zip file in chunks: a folder for each session, which `foottile verify` accepts.

    Raises:
        DamagedFileError: a session's frames differ from the sealed ones.
        StorageError: a file cannot be read, or was removed.
    """
    sink = DrainedBuffer()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED, allowZip64=True) as file:
        for session in sessions:
            yield from _put(file, sink, session.folder / FRAMES_NAME, session.frames_sha256)
            for name in _SIDECARS:
                if (session.folder / name).is_file():
                    yield from _put(file, sink, session.folder / name)
            # Last: if the session is removed meanwhile, this file fails, whatever was sent before.
            yield from _put(file, sink, session.folder / SESSION_NAME)
    yield sink.drain()


def _put(
    file: zipfile.ZipFile, sink: DrainedBuffer, path: Path, sha256: str | None = None
) -> Generator[bytes, None, None]:
    found = hashlib.sha256()
    try:
        dated_s = min(max(int(path.stat().st_mtime), _ZIP_DATES_S[0]), _ZIP_DATES_S[1])
        about = zipfile.ZipInfo(f"{path.parent.name}/{path.name}", time.localtime(dated_s)[:6])
        about.external_attr = 0o644 << 16
        with path.open("rb") as source, file.open(about, "w", force_zip64=True) as entry:
            while piece := source.read(_CHUNK_BYTES):
                found.update(piece)
                entry.write(piece)
                yield sink.drain()
    except OSError as error:
        raise StorageError(
            f"cannot be read: {error}", where=str(path), remedy="Leave this session out"
        ) from error
    if sha256 is not None and found.hexdigest() != sha256:
        raise DamagedFileError("its bytes are not those that were sealed", where=str(path))
    yield sink.drain()


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
