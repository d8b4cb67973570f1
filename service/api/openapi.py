"""Self-description of the API: Swagger UI at `/docs`, OpenAPI, list of routes.

Swagger UI is served from an installed package: no other host is needed.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fastapi import FastAPI

from devices.errors import FootTileError

SWAGGER_FILES = ("swagger-ui-bundle.js", "swagger-ui.css")
_METHODS = ("get", "post", "put", "patch", "delete")
_TOKEN = {
    "type": "http",
    "scheme": "bearer",
    "description": "The server's token. Reading from a server that is not private needs none; "
    "a browser that has logged in needs none either.",
}


def find_swagger_folder() -> Path:
    """Return the folder with `SWAGGER_FILES`.

    Raises:
        FootTileError: the installation lacks it.
    """
    found = find_spec("fastapi_offline")
    for place in (found.submodule_search_locations or ()) if found is not None else ():
        folder = Path(place) / "static"
        if all((folder / name).is_file() for name in SWAGGER_FILES):
            return folder
    raise FootTileError(
        "Swagger UI is not installed",
        expected="the package fastapi-offline",
        remedy="Install foottile again with its extra `server`",
    )


def add_security_scheme(app: FastAPI) -> None:
    """Add the token to the app's OpenAPI document as an optional security scheme."""
    made = app.openapi

    def make_schema() -> dict[str, Any]:
        schema = made()
        schema["components"]["securitySchemes"] = {"token": _TOKEN}
        schema["security"] = [{}, {"token": []}]
        return schema

    app.openapi = make_schema  # type: ignore[method-assign]  # as FastAPI documents


def list_operations(schema: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    """Return path, method and operation of every operation in an OpenAPI document."""
    return [
        (path, method.upper(), methods[method])
        for path, methods in schema["paths"].items()
        for method in _METHODS
        if method in methods
    ]
