"""Application of the server: REST API, websockets and pages over one `Server`, run by uvicorn."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import ssl
import sys
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from functools import cache
from http import HTTPStatus
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from starlette.routing import BaseRoute
from starlette.types import ASGIApp
from starlette.websockets import WebSocket
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from devices.errors import FootTileError
from service.api import problems
from service.api.access import AccessGuard, Logins
from service.api.connection_limits import ConnectionLimiter, open_files_max
from service.api.message_limits import MessageLimiter
from service.api.protocols import LimitedConfig, LimitedHttp, LimitedWebSocket, accept_connections
from service.api.routes import (
    calibrations,
    common,
    downloads,
    index,
    login,
    metrics,
    nodes,
    trials,
    weighings,
)
from service.api.routes.recordings import (
    comparisons,
    integrity,
    overview,
    sessions,
    stances,
    takes,
    videos,
)
from service.api.routes.sockets.ingest import serve_node
from service.api.routes.sockets.live import serve_live
from service.api.settings import LimitSettings
from service.api.static_files import HeadFromGet, PageFiles
from service.estimation.compilation import compile_models, load_cached_code, mark_compiling
from service.protocol.link import INGEST_PATH, MESSAGE_BYTES_MAX
from service.protocol.live import LIVE_PATH
from service.server.server import Server
from service.version import SOFTWARE_VERSION

API = "/api/v1"
_PAGES = {
    "/": "index.html",
    "/nodes": "nodes.html",
    "/calibrate": "calibrate.html",
    "/clock": "clock.html",
    "/sessions": "sessions.html",
    "/sessions/{session_id}": "session.html",
    "/docs": "docs.html",
    "/worker.js": "worker.js",  # its folder is the scope of a service worker
}
_SWAGGER_FILES = ("swagger-ui-bundle.js", "swagger-ui.css")

_DESCRIPTION = """
Live data and recorded sessions of FootTile sensors on robot feet.

Every error is `application/problem+json` (RFC 9457) whose `detail` says what to do. Quantities
carry their unit in their name; `_t_ns` are nanoseconds since 1970 in UTC. Frames come live over the
websocket `/api/v1/live`; nodes connect to `/api/v1/ingest` with the subprotocol `foottile.v1`.
"""
_TOKEN = {
    "type": "http",
    "scheme": "bearer",
    "description": "The server's token. Reading from a server that is not private needs none; "
    "a browser that has logged in needs none either.",
}


def make_app(
    server: Server,
    *,
    logins: Logins,
    hosts: Collection[str] = (),
    find_urls: Callable[[], Sequence[str]] = tuple,
) -> FastAPI:
    """Build the application.

    Args:
        server: state to serve.
        logins: token, tickets and cookies, required for every change of state and for ingest.
        hosts: names of the server, in addition to addresses and localhost.
        find_urls: returns the server's URLs, which change with the machine's networks; the first
            one is for phones.
    """

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        steps = server.run_ticks(), server.recorder.restore_live_edges()
        running = [asyncio.create_task(step) for step in steps]
        try:
            yield
        finally:
            for task in running:
                task.cancel()
            await asyncio.gather(*running, return_exceptions=True)
            await server.close()

    app = FastAPI(
        title="FootTile",
        version=SOFTWARE_VERSION.rsplit(" ", 1)[1],
        description=_DESCRIPTION,
        openapi_url=f"{API}/openapi.json",
        docs_url=None,  # FastAPI's page needs another host: no network in the field
        redoc_url=None,
        lifespan=lifespan,
    )
    app.state.server = server
    app.state.logins = logins
    app.state.find_urls = find_urls
    problems.install_handlers(app)
    app.router.routes.extend(_make_api_routes())
    app.include_router(metrics.router, include_in_schema=False)
    _add_security_scheme(app)

    @app.websocket(LIVE_PATH)
    async def live_socket(socket: WebSocket) -> None:
        await serve_live(socket, server)

    @app.websocket(INGEST_PATH)
    async def ingest_socket(socket: WebSocket) -> None:
        await serve_node(socket, server)

    page = PageFiles(find_page_folder())

    def add_page(path: str, name: str) -> None:
        @app.get(path, include_in_schema=False)
        async def get_page(request: Request) -> Response:
            return await page.get_response(name, request.scope)

    for path, name in _PAGES.items():
        add_page(path, name)

    swagger = PageFiles(_find_swagger_folder())

    @app.get("/docs/{name}", include_in_schema=False)
    async def docs_file(name: str, request: Request) -> Response:
        if name not in _SWAGGER_FILES:
            raise HTTPException(HTTPStatus.NOT_FOUND)
        return await swagger.get_response(name, request.scope)

    app.mount("/static", page, name="static")
    app.add_middleware(HeadFromGet)
    app.add_middleware(AccessGuard, hosts=hosts, logins=logins)
    return app


@cache
def _make_api_routes() -> tuple[BaseRoute, ...]:
    """Build the routes of the REST API.

    They are the same for every server of a process, and FastAPI takes a tenth of a second for them.
    """
    api = APIRouter(
        prefix=API,
        generate_unique_id_function=_make_operation_id,
        responses=common.problem_responses(
            _400="Invalid HTTP/1.1, or a body that is not UTF-8.",
            _401="The token or a login is needed: for a change, and on a private server for "
            "every request.",
            _403="Host, or Origin of a change, is not this server; or the login is a viewer's.",
            _408="Timeout of headers or body.",
            _413="The body is too long.",
            _422="Invalid parameter or body.",
            _431="The headers are too long.",
            _503="Too many connections, or the data folder is not in its place.",
        ),
    )
    api.add_api_route("", index.list_routes, summary="All routes", tags=["server"])
    for router in (
        index.router,
        login.router,
        nodes.router,
        calibrations.router,
        weighings.router,
        downloads.zip_router,  # before the route with a session's id
        sessions.router,
        takes.router,
        trials.router,
        sessions.trash_router,
        downloads.router,
        takes.data_router,
        index.formats_router,
        integrity.router,
        stances.router,
        overview.router,
        comparisons.router,
        videos.router,
    ):
        api.include_router(router)
    routes = APIRouter()
    routes.include_router(api)
    return tuple(routes.routes)


def _make_operation_id(route: APIRoute) -> str:
    """Return the name of a route's function in camel case: it must stay, programs use it."""
    first, *others = route.name.split("_")
    return first + "".join(other.title() for other in others)


def _add_security_scheme(app: FastAPI) -> None:
    """Add the token to the app's OpenAPI document as an optional security scheme."""
    made = app.openapi

    def make_schema() -> dict[str, Any]:
        schema = made()
        schema["components"]["securitySchemes"] = {"token": _TOKEN}
        schema["security"] = [{}, {"token": []}]
        return schema

    app.openapi = make_schema  # type: ignore[method-assign]  # as FastAPI documents


def _find_swagger_folder() -> Path:
    """Return the folder of Swagger UI, which is an installed package: no other host is needed.

    Raises:
        FootTileError: the installation lacks it.
    """
    found = find_spec("fastapi_offline")
    for place in (found.submodule_search_locations or ()) if found is not None else ():
        folder = Path(place) / "static"
        if all((folder / name).is_file() for name in _SWAGGER_FILES):
            return folder
    raise FootTileError(
        "Swagger UI is not installed",
        expected="the package fastapi-offline",
        remedy="Install foottile again with its extra `server`",
    )


def find_page_folder() -> Path:
    """Return the folder with `index.html`.

    Raises:
        FootTileError: the installation lacks it.
    """
    here = Path(__file__).resolve().parent
    # In a wheel it is service/web, in a checkout next to service.
    for folder in (here.parent / "web", here.parents[1] / "web"):
        if (folder / "index.html").is_file():
            return folder
    raise FootTileError(
        "the live page is not installed",
        where=str(here.parent / "web"),
        remedy="Install foottile again",
    )


_GRACE_S = 3


@asynccontextmanager
async def serve_app(
    app: FastAPI,
    listening: socket.socket,
    limits: LimitSettings | None = None,
    context: ssl.SSLContext | None = None,
) -> AsyncIterator[None]:
    """Context manager: serve the app; on a new machine compile the models meanwhile."""
    compiling = None
    if not await asyncio.to_thread(load_cached_code):
        compiling = asyncio.create_task(_compile_in_process(app.state.server))
    async with run_uvicorn(app, listening, limits or LimitSettings(), context):
        try:
            yield
        finally:
            if compiling is not None:  # first: sealing waits for it
                compiling.cancel()
                await asyncio.gather(compiling, return_exceptions=True)


@asynccontextmanager
async def run_uvicorn(
    app: ASGIApp,
    listening: socket.socket,
    limits: LimitSettings,
    context: ssl.SSLContext | None = None,
) -> AsyncIterator[None]:
    """Context manager: serve an application on a socket, with limits; `context` is its TLS."""
    config = LimitedConfig(
        app,
        log_level="warning",
        access_log=False,
        workers=1,  # else uvicorn reads WEB_CONCURRENCY and fails if it is no number
        server_header=False,
        http=LimitedHttp,
        ws=LimitedWebSocket,  # websockets' sans-I/O, the fastest maintained one (performance.md)
        ws_max_size=MESSAGE_BYTES_MAX,
        ws_per_message_deflate=False,
        ws_ping_interval=20.0,
        ws_ping_timeout=20.0,
        timeout_keep_alive=limits.idle_timeout_s,  # type: ignore[arg-type]  # it takes fractions
        timeout_graceful_shutdown=_GRACE_S,
        forwarded_allow_ips=limits.trusted_peers,  # uvicorn trusts loopback by default
    )
    config.limiter = ConnectionLimiter(limits, open_files_max())
    config.messages = MessageLimiter(limits)
    config.proxies = ProxyHeadersMiddleware(app, limits.trusted_peers)  # type: ignore[arg-type]  # Starlette's scope is wider
    logging.getLogger("uvicorn.error").addFilter(_is_relevant)
    server = _Uvicorn(config)
    server.context = context
    task = asyncio.create_task(server.serve([listening]))
    try:
        while not server.started and not task.done():
            await asyncio.sleep(0.01)
        if task.done():
            task.result()
        yield
    finally:
        server.should_exit = True
        await task


_COMPILE_CODE = "from service.estimation.compilation import compile_models; compile_models()"
_NICENESS = 10
_COMPILE_TIMEOUT_S = 600.0
"""Timeout of the process: ten times the time of a slow machine."""


async def _compile_in_process(of: Server) -> None:
    """Compile the models in a low-priority process, then load them.

    Without a writable cache the process has no effect: then they are compiled here, and all wait.
    """
    with mark_compiling():
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", _COMPILE_CODE),
            stdin=asyncio.subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the server
        )
        try:
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
            with suppress(TimeoutError):
                await asyncio.wait_for(process.wait(), _COMPILE_TIMEOUT_S)
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        await asyncio.to_thread(compile_models)
    for node in of.nodes:
        of.notify_node_changed(node)


_IGNORED_LOG_TEXTS = (
    # We refuse a handshake with an HTTP answer and a reason; uvicorn logs that as an error.
    "without completing handshake",
    # The sender gets an answer; clients must not be able to fill the log.
    "Invalid HTTP request received",
    "Unsupported upgrade request",
)


def _is_relevant(record: logging.LogRecord) -> bool:
    return not any(text in record.getMessage() for text in _IGNORED_LOG_TEXTS)


class _Uvicorn(uvicorn.Server):
    """uvicorn without signal handling, with limited connections."""

    config: LimitedConfig
    context: ssl.SSLContext | None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=[])
        self._accepting = [
            asyncio.create_task(
                accept_connections(each, self._protocol, self.config.limiter, self.context)
            )
            for each in sockets or ()
        ]

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for task in self._accepting:
            task.cancel()
        await asyncio.gather(*self._accepting, return_exceptions=True)
        await super().shutdown(sockets)

    def _protocol(self) -> asyncio.Protocol:
        return LimitedHttp(self.config, self.server_state, self.lifespan.state)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield
