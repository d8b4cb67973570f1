"""Runs the application in uvicorn on a socket known to be ours, until it is told to stop."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

import pyarrow as pa
import uvicorn
from fastapi import FastAPI

from service.api.doors import Bounds, Doors, open_files_max
from service.api.protocols import DoorsConfig, Http, WebSocket, accept
from service.estimation.warm import warm_up
from service.link import MESSAGE_BYTES_MAX

_GRACE_S = 3


@asynccontextmanager
async def serving(
    app: FastAPI, listening: socket.socket, bounds: Bounds | None = None
) -> AsyncIterator[None]:
    """Serve while the block runs; on a new machine the models are compiled before, in seconds."""
    # Arrow's own pool keeps what any of its threads has used: 190 MB after 200 pictures of a
    # session of 3 h, and 56 with this one, in no more time.
    pa.set_memory_pool(pa.system_memory_pool())
    await asyncio.to_thread(warm_up)
    bounds = bounds if bounds is not None else Bounds()
    config = DoorsConfig(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        http=Http,
        ws=WebSocket,  # on websockets' sans-I/O, the fastest that is kept up (performance.md)
        ws_max_size=MESSAGE_BYTES_MAX,
        ws_per_message_deflate=False,
        ws_ping_interval=20.0,
        ws_ping_timeout=20.0,
        timeout_keep_alive=bounds.idle_timeout_s,  # type: ignore[arg-type]  # it takes fractions
        timeout_graceful_shutdown=_GRACE_S,
    )
    config.doors = Doors(bounds, open_files_max())
    logging.getLogger("uvicorn.error").addFilter(_is_news)
    server = _Uvicorn(config)
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


_NO_NEWS = (
    # We refuse a handshake with an HTTP answer that says why; uvicorn takes that for a mistake.
    "without completing handshake",
    # It is told to the one who sent it; a log that others can fill is no log.
    "Invalid HTTP request received",
    "Unsupported upgrade request",
)


def _is_news(record: logging.LogRecord) -> bool:
    return not any(text in record.getMessage() for text in _NO_NEWS)


class _Uvicorn(uvicorn.Server):
    """Leaves signals to its caller, and takes connections in through the doors."""

    config: DoorsConfig

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=[])
        self._accepting = [
            asyncio.create_task(accept(each, self._protocol, self.config.doors))
            for each in sockets or ()
        ]

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for task in self._accepting:
            task.cancel()
        await asyncio.gather(*self._accepting, return_exceptions=True)
        await super().shutdown(sockets)

    def _protocol(self) -> asyncio.Protocol:
        return Http(self.config, self.server_state, self.lifespan.state)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield
