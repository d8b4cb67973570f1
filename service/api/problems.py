"""Errors of the API as RFC 9457 problem+json."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import Match, Mount

from devices.errors import (
    ChangedError,
    FolderGoneError,
    FootTileError,
    StateError,
    StorageError,
    TareError,
    UnknownError,
    UsageError,
)
from service.user_folders import strip_private_folders

log = logging.getLogger("foottile.api")

MEDIA_TYPE = "application/problem+json"
_METHODS = ("DELETE", "GET", "HEAD", "PATCH", "POST", "PUT")

_STATUS: tuple[tuple[type[FootTileError], HTTPStatus], ...] = (
    (UnknownError, HTTPStatus.NOT_FOUND),
    (ChangedError, HTTPStatus.PRECONDITION_FAILED),
    (StateError, HTTPStatus.CONFLICT),
    (TareError, HTTPStatus.CONFLICT),
    (FolderGoneError, HTTPStatus.SERVICE_UNAVAILABLE),
    (StorageError, HTTPStatus.INSUFFICIENT_STORAGE),
    (UsageError, HTTPStatus.UNPROCESSABLE_ENTITY),
)


class Problem(BaseModel):
    """Problem as of RFC 9457: what happened, where, and what to do."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    instance: str


def problem_response(
    path: str, status: int, detail: str, headers: Mapping[str, str] | None = None
) -> JSONResponse:
    """Return a problem as a response.

    Args:
        path: path of the request.
        status: HTTP status.
        detail: error and remedy, for a person.
        headers: further headers.
    """
    content = {
        "type": "about:blank",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": strip_private_folders(detail),
        "instance": path[:200],
    }
    return JSONResponse(content, status, dict(headers or {}), MEDIA_TYPE)


def install_handlers(app: FastAPI) -> None:
    """Answer every error of the app with a problem."""
    app.add_exception_handler(FootTileError, _on_foottile_error)
    app.add_exception_handler(RequestValidationError, _on_invalid)
    app.add_exception_handler(HTTPException, _on_http)
    app.add_exception_handler(Exception, _on_bug)


def http_status(error: FootTileError) -> HTTPStatus:
    """Return the HTTP status of an error."""
    found = (status for kind, status in _STATUS if isinstance(error, kind))
    return next(found, HTTPStatus.INTERNAL_SERVER_ERROR)


async def _on_foottile_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, FootTileError)  # noqa: S101  # by registration
    return problem_response(request.url.path, http_status(error), str(error))


async def _on_invalid(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)  # noqa: S101  # by registration
    complaints = "; ".join(
        f"{'.'.join(str(part) for part in complaint['loc'])}: {complaint['msg']}"
        for complaint in error.errors()[:5]
    )
    return problem_response(request.url.path, HTTPStatus.UNPROCESSABLE_ENTITY, complaints)


async def _on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)  # noqa: S101  # by registration
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        allow = {"Allow": ", ".join(_allowed_methods(request))}
        if request.method == "OPTIONS":
            return Response(status_code=HTTPStatus.NO_CONTENT, headers=allow)
        what = f"{request.method} is not allowed here; {allow['Allow']} are"
        return problem_response(request.url.path, error.status_code, what, allow)
    return problem_response(request.url.path, error.status_code, str(error.detail), error.headers)


def _allowed_methods(request: Request) -> list[str]:
    """Return the methods of a path: the framework names those of its first route only."""
    routes = [route for route in request.app.routes if not isinstance(route, Mount)]
    found = {
        method
        for method in _METHODS
        for route in routes
        if route.matches({**request.scope, "method": method})[0] is Match.FULL
    }
    found = found or {"GET"}  # a mount has files only
    if "GET" in found:
        found.add("HEAD")  # see service.api.static_files
    return sorted(found | {"OPTIONS"})


async def _on_bug(request: Request, error: Exception) -> JSONResponse:
    log.error("%s %s: this is a bug", request.method, request.url.path, exc_info=error)
    detail = f"Internal error ({type(error).__name__}); see the server's log"
    return problem_response(request.url.path, HTTPStatus.INTERNAL_SERVER_ERROR, detail)
