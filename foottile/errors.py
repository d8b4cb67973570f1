"""Errors of this package.

    FootTileError
     +-- UsageError              (ValueError)       invalid request: column, address, time, format
     +-- NotFoundError           (LookupError)      no such node, session or stream
     +-- AccessDeniedError       (PermissionError)  token missing or insufficient
     +-- ConflictError                              state forbids it: recording, node away, changed
     +-- ServerUnavailableError  (ConnectionError)  no server, connection lost, or timeout
     +-- DamagedError                               response differs from the server's data

A problem response of the server (RFC 9457) is in `problem`, with its HTTP status in `status`.
"""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any


class FootTileError(Exception):
    """Base of all errors.

    Attributes:
        problem: problem response of the server; empty without a response.
        status: HTTP status; None without a response.
    """

    def __init__(
        self, text: str, *, problem: Mapping[str, Any] | None = None, status: int | None = None
    ) -> None:
        super().__init__(text)
        self.problem: Mapping[str, Any] = dict(problem or {})
        self.status = status


class UsageError(FootTileError, ValueError):
    """Invalid request: address, column, format, time or range."""


class NotFoundError(FootTileError, LookupError):
    """Unknown node, session or stream."""


class AccessDeniedError(FootTileError, PermissionError):
    """Missing or insufficient token."""


class ConflictError(FootTileError):
    """Conflict with the present state: session recording, node away, or metadata changed."""


class ServerUnavailableError(FootTileError, ConnectionError):
    """No usable response: no server, connection lost, timeout, or another program."""


class DamagedError(FootTileError):
    """Received data that is damaged or incomplete."""


class FramesLostWarning(UserWarning):
    """Permanent loss of frames of a live stream; the text has their numbers and the reason."""


_BY_STATUS: dict[int, type[FootTileError]] = {
    HTTPStatus.BAD_REQUEST: UsageError,
    HTTPStatus.UNAUTHORIZED: AccessDeniedError,
    HTTPStatus.FORBIDDEN: AccessDeniedError,
    HTTPStatus.NOT_FOUND: NotFoundError,
    HTTPStatus.CONFLICT: ConflictError,
    HTTPStatus.PRECONDITION_FAILED: ConflictError,
    HTTPStatus.REQUEST_ENTITY_TOO_LARGE: UsageError,
    HTTPStatus.UNPROCESSABLE_ENTITY: UsageError,
    HTTPStatus.REQUEST_TIMEOUT: ServerUnavailableError,
    HTTPStatus.SERVICE_UNAVAILABLE: ServerUnavailableError,
}


def make_error(status: int, content: object, url: str, *, otherwise: str = "") -> FootTileError:
    """Return the error for an error response.

    Args:
        status: HTTP status.
        content: JSON content, if any.
        url: address of the server, for the text.
        otherwise: text for a response without detail.
    """
    problem = content if isinstance(content, dict) else {}
    detail = problem.get("detail") or otherwise or f"HTTP {status}"
    if not isinstance(detail, str):
        detail = otherwise or f"HTTP {status}"
    kind = _BY_STATUS.get(status, FootTileError)
    return kind(f"{url}: {detail}", problem=problem, status=status)
