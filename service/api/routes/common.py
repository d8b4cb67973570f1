"""Shared parts of routes: server state, types, refusals, answers, documented problems."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from base64 import b64encode
from collections.abc import Callable, Mapping
from http import HTTPStatus
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, TypeVar

from anyio import CapacityLimiter, to_thread
from fastapi import Depends, Header, Request, Response
from fastapi.responses import FileResponse
from pydantic import AfterValidator, BaseModel, Field, StringConstraints
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import Message, Receive, Scope, Send

from devices.errors import FileFormatError, StateError, UnknownError, UsageError
from devices.types import StrictModel, check_user_name
from service.api.problems import MEDIA_TYPE, Problem, problem_response
from service.api.static_files import accepts_gzip, compress_gzip
from service.server.server import Server
from service.version import SOFTWARE_VERSION
from storage.formats.slice import SECONDS_MAX
from storage.formats.writers.tables import PARQUET
from storage.sessions.folder import IdempotencyRecord, Session

JSON = "application/json"
_SCHEMA = {"content": {MEDIA_TYPE: {"schema": Problem.model_json_schema()}}}
T = TypeVar("T")
Responses = dict[int | str, dict[str, Any]]


def problem_responses(*shared: Responses, **meanings: str) -> Responses:
    """Return OpenAPI entries of a route: `problem_responses(FULL, _404="No such node.")`.

    Args:
        shared: entries of several routes, or of answers without a problem.
        meanings: problems by status; each replaces a shared one.
    """
    own: Responses = {
        int(status.removeprefix("_")): {"description": meaning, **_SCHEMA}
        for status, meaning in meanings.items()
    }
    return {status: entry for each in (*shared, own) for status, entry in each.items()}


def require_file(path: Path) -> Path:
    """Return the path of a sealed session's file if the file exists.

    Raises:
        UnknownError: it does not exist.
    """
    if path.is_symlink() or not path.is_file():  # a link may name any file of the machine
        raise UnknownError(f"the file {path.name} is missing", where=str(path))
    return path


def require_sealed(session: Session, what: str, remedy: str = "Stop it") -> Session:
    """Return the session if it is sealed, with frames or without.

    Args:
        session: the session.
        what: subject and verb of the refusal: "its stances are".
        remedy: remedy of the refusal.

    Raises:
        StateError: it is not.
    """
    if session.state != "sealed":
        raise StateError(
            f"session {session.id} is {session.state}, and {what} available when it is sealed",
            remedy=remedy,
        )
    return session


def require_frames(session: Session) -> Session:
    """Return the session if its frames can be read.

    Raises:
        UnknownError: it was sealed without frames, or its file is damaged.
    """
    if session.state == "sealed" and session.sha256 is None:
        raise UnknownError(f"session {session.id}: {session.problem}")
    return session


_LAST_MODIFIED_RANGE_S = (-62_135_596_800, 253_402_300_799)
"""First second of the year 1 and last one of 9999: `Last-Modified` can state no others."""


def file_response(path: Path, **options: Any) -> FileResponse:
    """Answer with a file as it is, whatever its date; some file systems know years beyond 9999."""
    found = path.stat()
    fields = list(found)
    fields[stat.ST_MTIME] = min(
        max(fields[stat.ST_MTIME], _LAST_MODIFIED_RANGE_S[0]), _LAST_MODIFIED_RANGE_S[1]
    )
    return FileResponse(path, stat_result=os.stat_result(fields), **options)


_CHUNK = 256 << 10  # three times the default's throughput (performance.md)
_SINGLE_RANGE = re.compile(r"bytes=(?:(\d{1,18})-(\d{0,18})|-(\d{1,18}))")


def stored_file_response(
    request: Request,
    path: Path,
    sha256: str,
    *,
    media_type: str,
    filename: str,
    headers: Mapping[str, str] = MappingProxyType({}),
    patch: tuple[int, bytes] | None = None,
) -> Response:
    """Answer with a file that never changes, or with a byte range.

    Args:
        request: the request.
        path: the file.
        sha256: its SHA-256, which is its entity tag.
        media_type: media type of the content.
        filename: name for a client that stores it.
        headers: further headers.
        patch: bytes in place of the file's, which never change either, and where they begin.
    """
    tag = sha256 if patch is None else f"{sha256}-patched"
    sent = {
        **headers,
        "ETag": f'"{tag}"',
        "Cache-Control": "private, no-cache",  # after a logout nothing may come from a cache
    }
    if patch is None:
        sent["Repr-Digest"] = f"sha-256=:{b64encode(bytes.fromhex(sha256)).decode()}:"
    if has_matching_etag(request, tag):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=sent)
    size = path.stat().st_size
    wanted = request.headers.get("range")
    if wanted is not None:
        found = _SINGLE_RANGE.fullmatch(wanted.replace(" ", ""))
        if found is None or (found[2] and found[1] and int(found[2]) < int(found[1])):
            # RFC 9110 14.2: an invalid range, or several, are ignored.
            del MutableHeaders(scope=request.scope)["range"]
        elif (found[1] and int(found[1]) >= size) or found[3] == "0":
            return problem_response(
                request.url.path,
                HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
                f"the range {wanted[:80]!r} is outside the file's {size} bytes",
                {"Content-Range": f"bytes */{size}"},
            )
    answer = file_response(path, headers=sent, media_type=media_type, filename=filename)
    answer.chunk_size = _CHUNK
    return answer if patch is None else _PatchedResponse(answer, *patch)


class _PatchedResponse(Response):
    """Answer with a file, or with a range of it, of which some bytes are replaced as they pass."""

    def __init__(self, answer: FileResponse, at: int, content: bytes) -> None:
        self.answer, self.at, self.content = answer, at, content
        self.background = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the answer."""
        begin = 0  # of the next bytes in the file

        async def send_patched(message: Message) -> None:
            nonlocal begin
            if message["type"] == "http.response.start":
                part = Headers(raw=message["headers"]).get("content-range", "bytes 0-")
                begin = int(part.removeprefix("bytes ").partition("-")[0])
            elif message["type"] == "http.response.body":
                body = message["body"]
                low, high = max(self.at - begin, 0), self.at - begin + len(self.content)
                if low < len(body) and high > 0:
                    new = self.content[max(begin - self.at, 0) :][: len(body) - low]
                    message = {**message, "body": body[:low] + new + body[low + len(new) :]}
                begin += len(body)
            await send(message)

        await self.answer(scope, receive, send_patched)


def run_with_usage_errors(make: Callable[[], T]) -> T:
    """Run a function on a user's files; a damaged file is a usage error."""
    try:
        return make()
    except FileFormatError as error:
        raise UsageError(str(error)) from error


def stored_table_response(session: Session, path: Path) -> FileResponse:
    """Answer with a session's stored table as it is.

    Raises:
        StateError: it is written when the session is sealed.
        UnknownError: the file does not exist.
    """
    if session.sha256 is None:
        raise StateError(
            f"session {session.id} is {session.state}, and {path.name} is not written yet",
            remedy="Stop it, or ask for format=json",
        )
    return file_response(
        require_file(path), media_type=PARQUET.media_type, filename=f"{session.id}.{path.name}"
    )


def _server(request: Request) -> Server:
    server: Server = request.app.state.server
    return server


class SecondsQuery(StrictModel):
    """Time interval of a session."""

    start_s: Annotated[float, Field(ge=0, le=SECONDS_MAX)] | None = Field(
        default=None, description="Seconds after the first frame."
    )
    end_s: Annotated[float, Field(gt=0, le=SECONDS_MAX)] | None = Field(
        default=None, description="End, not included, in seconds after the first frame."
    )


def has_matching_etag(request: Request, tag: str) -> bool:
    """Return whether If-None-Match names this entity tag, given without quotes."""
    header = request.headers.get("if-none-match", "")
    return any(t.strip().removeprefix("W/") in (f'"{tag}"', "*") for t in header.split(","))


ServerState = Annotated[Server, Depends(_server)]
Name = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=200),
    AfterValidator(check_user_name),
]
"""Name in one line."""

CHANGED = problem_responses(_412="It was changed meanwhile: its revision is not that in If-Match.")
UNCHANGED: Responses = {304: {"description": "Unchanged."}}
NO_CONTENT: dict[str, Any] = {"status_code": 204, "response_model": None}
"""Options of a route that answers with a status only."""
FULL = problem_responses(_507="The data folder cannot be written.")

IfMatch = Annotated[
    str | None,
    Header(description="Revision that you have seen (`revision`); else the change is refused."),
]
IdempotencyKey = Annotated[
    str | None,
    Header(
        description="Key of your choice, new for each recording: a repeated request with the same"
        " key is answered with the result of the first one, and creates nothing. The "
        "key is stored with its session.",
        pattern=r"^[!-~]{1,200}$",
        examples=["8e03978e-40d5-43dd-bc93-6894a57f9324"],
    ),
]


def parse_if_match(if_match: str | None) -> str | None:
    """Return the revision in an `If-Match`, with or without quotes; None for `*` or no header."""
    revision = (if_match or "").strip().removeprefix("W/").strip('"')
    return None if revision in ("", "*") else revision


def make_idempotency_record(
    key: str | None, kind: str, body: BaseModel
) -> IdempotencyRecord | None:
    """Return the record of a request with its key; None without a key.

    Args:
        key: its `Idempotency-Key`, with or without quotes.
        kind: kind of the request.
        body: parsed body, so that its spelling does not matter.
    """
    if key is None:
        return None
    return IdempotencyRecord(
        key=_digest(key.strip('"')), request=_digest(f"{kind} {body.model_dump_json()}")
    )


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]


async def numbers_response(
    request: Request,
    make: Callable[[], bytes],
    limiter: CapacityLimiter,
    *,
    sealed_key: str | None,
    media_type: str = JSON,
    accept_encoding: str,
) -> Response:
    """Answer with numbers, made in a thread; JSON is compressed if the client accepts it.

    Args:
        request: the request.
        make: makes the content.
        limiter: limit of such threads.
        sealed_key: text that determines the content; None: it is of frames that still come.
        media_type: media type of the content.
        accept_encoding: header of the request.
    """
    as_gzip = media_type == JSON and accepts_gzip(accept_encoding)
    headers = {"Cache-Control": "no-store"}
    if sealed_key is not None:
        tag = _digest(f"{sealed_key}|{media_type}|{as_gzip}|{SOFTWARE_VERSION}")
        headers = {"ETag": f'"{tag}"', "Cache-Control": "private, no-cache"}
        headers |= {"Vary": "Accept, Accept-Encoding"}
        if has_matching_etag(request, tag):
            return Response(status_code=304, headers=headers)
    content = await to_thread.run_sync(make, limiter=limiter)
    if as_gzip:
        headers["Content-Encoding"] = "gzip"
        content = await to_thread.run_sync(compress_gzip, content, limiter=limiter)
    return Response(content, headers=headers, media_type=media_type)
