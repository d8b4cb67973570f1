"""What routes share: the server they serve, its files, and the problems they document."""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, Header, Request
from fastapi.responses import FileResponse
from pydantic import BaseModel, ConfigDict, Field

from devices.errors import StateError, UnknownError
from service.api.problems import MEDIA_TYPE, Problem
from service.server.server import Server
from storage.formats.slice import SECONDS_MAX
from storage.formats.written.parquet import PARQUET
from storage.sessions.folder import Asked, Session

_SCHEMA = {"content": {MEDIA_TYPE: {"schema": Problem.model_json_schema()}}}


def problems(**meanings: str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries of the problems a route may answer with: `problems(_404="no such node")`."""
    return {
        int(status.removeprefix("_")): {"description": meaning, **_SCHEMA}
        for status, meaning in meanings.items()
    }


def present(path: Path) -> Path:
    """A file of a sealed session, which may have been taken away.

    Raises:
        UnknownError: it is not there.
    """
    if not path.is_file():
        raise UnknownError(f"the file {path.name} has been taken away", where=str(path))
    return path


_DATED_S = (-62_135_596_800, 253_402_300_799)
"""The first second of the year 1 and the last one of 9999: `Last-Modified` can state no others."""


def file_answer(path: Path, **about: Any) -> FileResponse:
    """Answer with a file as it is, whatever its date; some file systems know years beyond 9999."""
    found = path.stat()
    fields = list(found)
    fields[stat.ST_MTIME] = min(max(fields[stat.ST_MTIME], _DATED_S[0]), _DATED_S[1])
    return FileResponse(path, stat_result=os.stat_result(fields), **about)


def stored_table(session: Session, path: Path) -> FileResponse:
    """A table that lies beside a session's frames, as it is.

    Raises:
        StateError: it is written when the session is sealed.
        UnknownError: it has been taken away.
    """
    if session.sha256 is None:
        raise StateError(
            f"session {session.id} is {session.state}, and {path.name} is not written yet",
            remedy="Stop it, or ask for format=json",
        )
    return file_answer(
        present(path), media_type=PARQUET.media_type, filename=f"{session.id}.{path.name}"
    )


def _server(request: Request) -> Server:
    server: Server = request.app.state.server
    return server


class SecondsQuery(BaseModel):
    """Which time of a session."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    start_s: Annotated[float, Field(ge=0, le=SECONDS_MAX, allow_inf_nan=False)] | None = Field(
        default=None, description="Seconds after the first frame."
    )
    end_s: Annotated[float, Field(gt=0, le=SECONDS_MAX, allow_inf_nan=False)] | None = Field(
        default=None, description="Up to, not including, so many seconds after the first frame."
    )


def has_it(request: Request, tag: str) -> bool:
    """Does If-None-Match name this entity tag, without its quotes?"""
    given = request.headers.get("if-none-match", "")
    return any(t.strip().removeprefix("W/") in (f'"{tag}"', "*") for t in given.split(","))


ServerState = Annotated[Server, Depends(_server)]

CHANGED = problems(_412="Somebody else has changed it: it is not what If-Match names.")
FULL = problems(_507="The data folder cannot be written.")

IfMatch = Annotated[
    str | None, Header(description="`said` of what is changed, as it was when you looked at it.")
]
IdempotencyKey = Annotated[
    str | None,
    Header(
        description="Yours, new for each recording: the same request with the same key, sent "
        "again, is answered with what the first one has begun, and begins nothing. It is kept with "
        "what it began, for as long as that is.",
        pattern=r"^[!-~]{1,200}$",
        examples=["8e03978e-40d5-43dd-bc93-6894a57f9324"],
    ),
]


def tag_of(if_match: str | None) -> str | None:
    """What is expected, of an `If-Match` with or without quotes; any is none."""
    said = (if_match or "").strip().removeprefix("W/").strip('"')
    return None if said in ("", "*") else said


def asked_with(key: str | None, what: str, body: BaseModel) -> Asked | None:
    """A request as it is told from others; None: it came without a key.

    Args:
        key: its `Idempotency-Key`, with or without quotes.
        what: it asks for.
        body: as it was understood, so that how it is written does not matter.
    """
    if key is None:
        return None
    return Asked(key=_digest(key.strip('"')), request=_digest(f"{what} {body.model_dump_json()}"))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]
