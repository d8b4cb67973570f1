"""Health, readiness and version of the server."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import Field

from service.api.routes.common import ServerState, problem_responses
from service.protocol import SUBPROTOCOL
from service.server.broadcast.views import View
from service.user_folders import PublicText
from service.version import SOFTWARE_VERSION

router = APIRouter(tags=["server"])


class Health(View):
    """State of the process."""

    status: str = Field(examples=["ok"])
    problems: list[PublicText] = Field(
        description="Damage found in the data folder at the start, and the consequence, as text. "
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


@router.get("/health", operation_id="getHealth", summary="Liveness")
async def get_health(server: ServerState) -> Health:
    """Return the state of the process, with the damage found at its start."""
    return Health(status="ok", problems=server.problems)


@router.get(
    "/ready",
    operation_id="getReady",
    summary="Readiness",
    responses=problem_responses(_507="The data folder cannot be written."),
)
def get_ready(server: ServerState) -> Ready:
    """Write a test file to the data folder, and count nodes and subscribers."""
    server.check_writable()
    return Ready(
        ready=True,
        nodes_connected=len(server.links),
        subscribers=server.broadcaster.subscriber_count,
    )


@router.get("/version", operation_id="getVersion", summary="Version")
async def get_version() -> Version:
    """Return the versions of software, API and link protocol."""
    return Version(software=SOFTWARE_VERSION)
