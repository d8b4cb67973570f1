"""The API as it describes itself: for people at `/docs`, for programs as OpenAPI and as links.

What draws it is Swagger UI, of a package that brings it: nothing is asked of another host.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fastapi import FastAPI

from devices.errors import FootTileError

DOCS_FILES = ("swagger-ui-bundle.js", "swagger-ui.css")
_METHODS = ("get", "post", "put", "patch", "delete")
_TOKEN = {
    "type": "http",
    "scheme": "bearer",
    "description": "The server's token. To read from a server that is not private none is needed; "
    "a browser that has logged in needs none either.",
}


def swagger_folder() -> Path:
    """Folder with `DOCS_FILES`.

    Raises:
        FootTileError: the installation lacks it.
    """
    found = find_spec("fastapi_offline")
    for place in (found.submodule_search_locations or ()) if found is not None else ():
        folder = Path(place) / "static"
        if all((folder / name).is_file() for name in DOCS_FILES):
            return folder
    raise FootTileError(
        "Swagger UI is not installed",
        expected="the package fastapi-offline",
        remedy="Install foottile again with its extra `server`",
    )


def say_who_may(app: FastAPI) -> None:
    """Have the description say how a token is shown; nothing needs one everywhere."""
    made = app.openapi

    def described() -> dict[str, Any]:
        schema = made()
        schema["components"]["securitySchemes"] = {"token": _TOKEN}
        schema["security"] = [{}, {"token": []}]
        return schema

    app.openapi = described  # type: ignore[method-assign]  # as FastAPI has it done


def operations(schema: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    """Path, method and operation of everything that a description has."""
    return [
        (path, method.upper(), methods[method])
        for path, methods in schema["paths"].items()
        for method in _METHODS
        if method in methods
    ]
