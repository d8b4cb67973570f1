"""What there is: every route of the API with its address."""

from __future__ import annotations

from fastapi import Request
from pydantic import Field

from service.api.described import operations
from service.link import INGEST_PATH, LIVE_PATH
from service.server.screens.views import View
from service.version import SOFTWARE


class RouteView(View):
    """One thing that can be asked."""

    method: str = Field(examples=["GET"])
    href: str = Field(
        description="Its path; names in braces are to be filled in.",
        examples=["/api/v1/sessions/{session_id}"],
    )
    operation: str = Field(
        description="Its `operationId` in the description.", examples=["getSession"]
    )
    summary: str


class IndexView(View):
    """Where to begin."""

    software: str = Field(examples=["foottile 0.1.0"])
    docs: str = Field(description="The description for people.", examples=["/docs"])
    openapi: str = Field(description="The same for machines, OpenAPI 3.1.")
    live: str = Field(description="The websocket of screens.")
    ingest: str = Field(description="The websocket of nodes.")
    routes: list[RouteView]


async def index(request: Request) -> IndexView:
    """Every route with its address, and where it is described."""
    app = request.app
    return IndexView(
        software=SOFTWARE,
        docs="/docs",
        openapi=str(app.openapi_url),
        live=LIVE_PATH,
        ingest=INGEST_PATH,
        routes=[
            RouteView(
                method=method,
                href=path,
                operation=said["operationId"],
                summary=said["summary"],
            )
            for path, method, said in operations(app.openapi())
        ],
    )
