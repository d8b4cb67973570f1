"""Errors of this package.

    ClientError
     +-- InvalidRequestError     (ValueError)       column, address, time or format
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


class ClientError(Exception):
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


class InvalidRequestError(ClientError, ValueError):
    """Invalid request: address, column, format, time or range."""


class NotFoundError(ClientError, LookupError):
    """Unknown node, session or stream."""


class AccessDeniedError(ClientError, PermissionError):
    """Missing or insufficient token."""


class ConflictError(ClientError):
    """Conflict with the present state: session recording, node away, or metadata changed."""


class ServerUnavailableError(ClientError, ConnectionError):
    """No usable response: no server, connection lost, timeout, or another program."""


class DamagedError(ClientError):
    """Received data that is damaged or incomplete."""


class FramesLostWarning(UserWarning):
    """Permanent loss of frames of a live stream; the text has their numbers and the reason."""


_BY_STATUS: dict[int, type[ClientError]] = {
    HTTPStatus.BAD_REQUEST: InvalidRequestError,
    HTTPStatus.UNAUTHORIZED: AccessDeniedError,
    HTTPStatus.FORBIDDEN: AccessDeniedError,
    HTTPStatus.NOT_FOUND: NotFoundError,
    HTTPStatus.CONFLICT: ConflictError,
    HTTPStatus.PRECONDITION_FAILED: ConflictError,
    HTTPStatus.REQUEST_ENTITY_TOO_LARGE: InvalidRequestError,
    HTTPStatus.UNPROCESSABLE_ENTITY: InvalidRequestError,
    HTTPStatus.REQUEST_TIMEOUT: ServerUnavailableError,
    HTTPStatus.SERVICE_UNAVAILABLE: ServerUnavailableError,
}


def make_error(status: int, content: object, url: str, *, otherwise: str = "") -> ClientError:
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
    kind = _BY_STATUS.get(status, ClientError)
    return kind(f"{url}: {detail}", problem=problem, status=status)
