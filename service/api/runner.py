"""Runner of the application: uvicorn on a given socket, until stopped."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress

import uvicorn
from fastapi import FastAPI
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from service.api.connection_limits import ConnectionLimiter, LimitSettings, open_files_max
from service.api.protocols import LimitedConfig, LimitedHttp, LimitedWebSocket, accept_connections
from service.estimation.compilation import compile_models, load_cached_code, mark_compiling
from service.protocol.link import MESSAGE_BYTES_MAX
from service.server.server import Server

_GRACE_S = 3


@asynccontextmanager
async def serve_app(
    app: FastAPI, listening: socket.socket, limits: LimitSettings | None = None
) -> AsyncIterator[None]:
    """Context manager: serve the app; on a new machine compile the models meanwhile."""
    compiling = None
    if not await asyncio.to_thread(load_cached_code):
        compiling = asyncio.create_task(_compile_in_process(app.state.server))
    limits = limits if limits is not None else LimitSettings()
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
    config.proxies = ProxyHeadersMiddleware(app, limits.trusted_peers)  # type: ignore[arg-type]  # Starlette's scope is wider
    logging.getLogger("uvicorn.error").addFilter(_is_relevant)
    server = _Uvicorn(config)
    task = asyncio.create_task(server.serve([listening]))
    try:
        while not server.started and not task.done():
            await asyncio.sleep(0.01)
        if task.done():
            task.result()
        yield
    finally:
        if compiling is not None:  # first: sealing waits for it
            compiling.cancel()
            await asyncio.gather(compiling, return_exceptions=True)
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

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=[])
        self._accepting = [
            asyncio.create_task(accept_connections(each, self._protocol, self.config.limiter))
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
