"""What routes share: the server they serve, its files, and the problems they document."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, Request

from devices.errors import UnknownError
from service.api.problems import MEDIA_TYPE, Problem
from service.server.server import Server

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


def _server(request: Request) -> Server:
    server: Server = request.app.state.server
    return server


ServerState = Annotated[Server, Depends(_server)]
