"""Index of the API: every route with its address."""

from __future__ import annotations

from fastapi import Request
from pydantic import Field

from service.api.openapi import list_operations
from service.protocol import INGEST_PATH, LIVE_PATH
from service.server.broadcast.views import View
from service.version import SOFTWARE_VERSION


class RouteView(View):
    """Route of the API."""

    method: str = Field(examples=["GET"])
    href: str = Field(
        description="Path; replace the names in braces.",
        examples=["/api/v1/sessions/{session_id}"],
    )
    operation: str = Field(
        description="Its `operationId` in the OpenAPI document.", examples=["getSession"]
    )
    summary: str


class IndexView(View):
    """Index of the API."""

    software: str = Field(examples=["foottile 0.1.0"])
    docs: str = Field(description="Description for people.", examples=["/docs"])
    openapi: str = Field(description="Description for programs, OpenAPI 3.1.")
    live: str = Field(description="Websocket of live data.")
    ingest: str = Field(description="Websocket of nodes.")
    routes: list[RouteView]


async def get_index(request: Request) -> IndexView:
    """Return every route with its address and summary."""
    app = request.app
    return IndexView(
        software=SOFTWARE_VERSION,
        docs="/docs",
        openapi=str(app.openapi_url),
        live=LIVE_PATH,
        ingest=INGEST_PATH,
        routes=[
            RouteView(
                method=method,
                href=path,
                operation=operation["operationId"],
                summary=operation["summary"],
            )
            for path, method, operation in list_operations(app.openapi())
        ],
    )
