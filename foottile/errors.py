"""Every error that this package raises on purpose.

    FootTileError
     +-- UsageError     (ValueError)       what was asked for cannot be: no such column, no address
     +-- UnknownError   (LookupError)      no such node, session, stream
     +-- RefusedError   (PermissionError)  a token is needed, or this one is not enough
     +-- ConflictError                     not now: recording already, node away, changed by others
     +-- NoAnswerError  (ConnectionError)  no server there, or it has gone, or is too slow
     +-- DamagedError                      what came is not what the server has

What a server answered as a problem (RFC 9457) is in `problem`, with its HTTP status in `status`.
"""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any


class FootTileError(Exception):
    """Base of all errors.

    Attributes:
        problem: what the server answered, as it is; empty if it did not.
        status: its HTTP status; None if there was no answer.
    """

    def __init__(
        self, text: str, *, problem: Mapping[str, Any] | None = None, status: int | None = None
    ) -> None:
        super().__init__(text)
        self.problem: Mapping[str, Any] = dict(problem or {})
        self.status = status


class UsageError(FootTileError, ValueError):
    """What was asked for cannot be."""


class UnknownError(FootTileError, LookupError):
    """There is no such node, session or stream."""


class RefusedError(FootTileError, PermissionError):
    """A token is needed, or this one is not enough."""


class ConflictError(FootTileError):
    """Not now: it is being recorded, its node is away, somebody else has changed it."""


class NoAnswerError(FootTileError, ConnectionError):
    """There is no server, it has gone, or it is too slow."""


class DamagedError(FootTileError):
    """What came is not what the server has."""


class FramesLostWarning(UserWarning):
    """Frames of a live stream are missing for good; the text says which, and why."""


_BY_STATUS: dict[int, type[FootTileError]] = {
    HTTPStatus.BAD_REQUEST: UsageError,
    HTTPStatus.UNAUTHORIZED: RefusedError,
    HTTPStatus.FORBIDDEN: RefusedError,
    HTTPStatus.NOT_FOUND: UnknownError,
    HTTPStatus.CONFLICT: ConflictError,
    HTTPStatus.PRECONDITION_FAILED: ConflictError,
    HTTPStatus.REQUEST_ENTITY_TOO_LARGE: UsageError,
    HTTPStatus.UNPROCESSABLE_ENTITY: UsageError,
    HTTPStatus.REQUEST_TIMEOUT: NoAnswerError,
    HTTPStatus.SERVICE_UNAVAILABLE: NoAnswerError,
}


def refused(status: int, content: object, url: str, *, otherwise: str = "") -> FootTileError:
    """The error for a server's answer that is one.

    Args:
        status: of the answer.
        content: its JSON, if it is some.
        url: the server's address, for the text.
        otherwise: said if the answer has no detail.
    """
    problem = content if isinstance(content, dict) else {}
    detail = problem.get("detail") or otherwise or f"HTTP {status}"
    if not isinstance(detail, str):
        detail = otherwise or f"HTTP {status}"
    kind = _BY_STATUS.get(status, FootTileError)
    return kind(f"{url}: {detail}", problem=problem, status=status)
