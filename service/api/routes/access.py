"""What routes share: the server they serve, and the problems they document."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Depends, Request

from service.api.problems import MEDIA_TYPE
from service.server.server import Server
from service.server.views import Problem

_SCHEMA = {"content": {MEDIA_TYPE: {"schema": Problem.model_json_schema()}}}


def problems(**meanings: str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries of the problems a route may answer with: `problems(_404="no such node")`."""
    return {
        int(status.removeprefix("_")): {"description": meaning, **_SCHEMA}
        for status, meaning in meanings.items()
    }


def _server(request: Request) -> Server:
    server: Server = request.app.state.server
    return server


ServerState = Annotated[Server, Depends(_server)]
