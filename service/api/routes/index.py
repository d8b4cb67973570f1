"""Routes about the server: index of the API, health, export formats."""

from __future__ import annotations

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field

from service.api.routes.common import FULL, ServerState
from service.protocol.link import INGEST_PATH, SUBPROTOCOL
from service.protocol.live import LIVE_PATH, View
from service.user_folders import PublicText
from service.version import SOFTWARE_VERSION
from storage.formats.writers.registry import FORMATS

_METHODS = ("get", "post", "put", "patch", "delete")


class RouteView(View):
    """Route of the API."""

    method: str = Field(examples=["GET"])
    href: str = Field(
        description="Path; replace the names in braces.", examples=["/api/v1/sessions/{session_id}"]
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


async def list_routes(request: Request) -> IndexView:
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
                method=method.upper(),
                href=path,
                operation=methods[method]["operationId"],
                summary=methods[method]["summary"],
            )
            for path, methods in app.openapi()["paths"].items()
            for method in _METHODS
            if method in methods
        ],
    )


router = APIRouter(tags=["server"])


class Health(View):
    """State of the process."""

    status: str = Field(examples=["ok"])
    problems: list[PublicText] = Field(
        description="Damage found in the data folder, and the consequence, as text. "
        "Everything else is served."
    )


class Ready(View):
    """Readiness of the server."""

    ready: bool
    nodes_connected: int
    subscribers: int


class Version(View):
    """Versions of software and protocols."""

    software: str = Field(examples=["foottile 0.1.0"])
    api: str = "v1"
    protocol: str = SUBPROTOCOL


@router.get("/health", summary="Liveness")
async def get_health(server: ServerState) -> Health:
    """Return the state of the process, with the damage found at its start."""
    return Health(status="ok", problems=server.file_problems)


@router.get("/ready", summary="Readiness", responses=FULL)
def get_ready(server: ServerState) -> Ready:
    """Write a test file to the data folder, and count nodes and subscribers."""
    server.check_writable()
    return Ready(
        ready=True,
        nodes_connected=len(server.links),
        subscribers=server.broadcaster.subscriber_count,
    )


@router.get("/version", summary="Version")
async def get_version() -> Version:
    """Return the versions of software, API and link protocol."""
    return Version(software=SOFTWARE_VERSION)


formats_router = APIRouter(prefix="/formats", tags=["data"])


class FormatView(BaseModel):
    """Format, as in `GET .../data?format=`."""

    name: str
    title: str = Field(description="Title for people.")
    opened_by: str = Field(description="Programs that open it.")
    ending: str = Field(description="File extension, with the dot.")
    media_type: str
    options: list[str] = Field(description="Download parameters of this format.")
    takes_columns: bool = Field(description="True: columns can be selected.")
    needs_forces: bool = Field(description="True: the session needs estimates.")
    needs_sealed: bool = Field(description="True: the session has to be sealed.")
    can_hold_several_sessions: bool = Field(description="One file can have all sessions of a take.")
    frames_max: int | None = Field(description="Frame limit of a download; null: no limit.")
    missing: str | None = Field(description="Missing extra of this server; null: none.")


class FormatsView(BaseModel):
    """All formats."""

    items: list[FormatView]


@formats_router.get("", summary="Formats of downloads")
def list_formats() -> FormatsView:
    """Return the formats in the order of menus."""
    formats_ = FORMATS.values()
    return FormatsView(items=[FormatView.model_validate(f, from_attributes=True) for f in formats_])
