"""Is it alive, is it able, and what is it?"""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import Field

from service.api.routes.access import ServerState, problems
from service.link import SUBPROTOCOL
from service.private_paths import ShownText
from service.server.screens.views import View
from service.version import SOFTWARE

router = APIRouter(tags=["server"])


class Health(View):
    """The process answers."""

    status: str = Field(examples=["ok"])
    problems: list[ShownText] = Field(
        description="What was found damaged in the data folder when the server was started, and "
        "what became of it, in words. The rest is served."
    )


class Ready(View):
    """It can do its work."""

    ready: bool
    nodes_connected: int
    subscribers: int


class Version(View):
    """Which software and protocols."""

    software: str = Field(examples=["foottile 0.1.0"])
    api: str = "v1"
    protocol: str = SUBPROTOCOL


@router.get("/health", operation_id="getHealth", summary="Is the process alive?")
async def health(server: ServerState) -> Health:
    """Answers while the process runs; says what it found damaged."""
    return Health(status="ok", problems=server.problems)


@router.get(
    "/ready",
    operation_id="getReady",
    summary="Can it record?",
    responses=problems(_507="The data folder cannot be written."),
)
def ready(server: ServerState) -> Ready:
    """Writes some bytes to the data folder and counts who is there."""
    server.check_storage()
    return Ready(
        ready=True,
        nodes_connected=len(server.links),
        subscribers=server.hub.subscribers,
    )


@router.get("/version", operation_id="getVersion", summary="Which version is it?")
async def version() -> Version:
    """Software, API and link protocol."""
    return Version(software=SOFTWARE)
