"""A TCP proxy that is a bad link: cut, silent, slow, throttled, or flipping bits.

It runs in a thread of its own with an event loop, and its port stays the same whatever happens.
"""

# ruff: noqa: S311  # seeded on purpose: a round can be run again

from __future__ import annotations

import asyncio
import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Protocol, Self

_PIECE_BYTES = 4096
_PIECES_WAITING = 64
_RESET = struct.pack("ii", 1, 0)
"""SO_LINGER of no time at all: closing sends RST."""


class Tap(Protocol):
    """Sees what one connection carries, as its senders sent it."""

    def to_server(self, data: bytes) -> None:
        """The node has sent this."""

    def to_node(self, data: bytes) -> None:
        """The server has sent this."""


class _NoTap:
    def to_server(self, data: bytes) -> None: ...
    def to_node(self, data: bytes) -> None: ...


@dataclass
class Quality:
    """How bad the link is; may be changed at any time."""

    delay_s: float = 0.0
    jitter_s: float = 0.0
    bytes_per_s: float | None = None
    """Each way; None: as fast as it goes."""
    flip_every_bytes: float | None = None
    """Mean distance between flipped bits on the way to the server; None: none."""


@dataclass
class _Way:
    """One direction of one connection."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    seen: Callable[[bytes], None]
    to_server: bool
    waiting: asyncio.Queue[tuple[float, bytes]] = field(
        default_factory=lambda: asyncio.Queue(_PIECES_WAITING)
    )


class Proxy:
    """Listens on a port of its own and passes on to a server's; use as a context manager.

    Args:
        server_port: where the server listens, or will listen.
        seed: of jitter and flipped bits.
        tap: makes one for each connection.
    """

    def __init__(self, server_port: int, *, seed: int = 0, tap: Callable[[], Tap] = _NoTap) -> None:
        self.quality = Quality()
        self.flips = 0
        """How many bits were flipped so far."""
        self.connections = 0
        """How many were let through so far."""
        self._server_port = server_port
        self._rng = random.Random(seed)
        self._tap = tap
        self._listening = socket.create_server(("127.0.0.1", 0), backlog=16)
        self.port: int = self._listening.getsockname()[1]
        self._refusing = False
        self._writers: set[asyncio.StreamWriter] = set()
        self._serving: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        self._flowing: asyncio.Event
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        self._call(self._open())
        return self

    def __exit__(self, *_: object) -> None:
        self._call(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10.0)
        self._loop.close()
        self._listening.close()

    def cut(self) -> None:
        """Reset every connection, and every new one, until `mend`."""
        self._call(self._cut())

    def black_hole(self) -> None:
        """Let nothing through, and say nothing, until `mend`: as when somebody walks out of reach.

        Connections stay as they are, also new ones; afterwards what was sent arrives late, as TCP
        would send it again.
        """
        self._call(self._set_flowing(False))

    def mend(self) -> None:
        """End `cut` or `black_hole`; `quality` stays."""
        self._call(self._set_flowing(True))

    def drop_connections(self) -> None:
        """Reset every connection there is, once."""
        self._call(self._reset_all())

    def _call(self, coroutine: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(10.0)

    # --- in the loop ------------------------------------------------------------------------------

    async def _open(self) -> None:
        self._flowing = asyncio.Event()
        self._flowing.set()
        self._server = await asyncio.start_server(self._begin, sock=self._listening)

    async def _close(self) -> None:
        self._server.close()
        await self._reset_all()
        for task in self._serving:
            task.cancel()
        await asyncio.gather(*self._serving, return_exceptions=True)

    async def _cut(self) -> None:
        self._refusing = True
        await self._reset_all()

    async def _set_flowing(self, flowing: bool) -> None:
        if flowing:
            self._refusing = False
            self._flowing.set()
        else:
            self._flowing.clear()

    async def _reset_all(self) -> None:
        for writer in list(self._writers):
            _reset(writer)

    async def _begin(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._serving.add(task)
        task.add_done_callback(self._serving.discard)
        # A connection that is cut is what this is here for.
        with suppress(OSError, asyncio.CancelledError):
            await self._serve(reader, writer)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        there: asyncio.StreamWriter | None = None
        try:
            if self._refusing:
                return
            await self._flowing.wait()
            server, there = await asyncio.open_connection("127.0.0.1", self._server_port)
            self._writers.add(there)
            self.connections += 1
            tap = self._tap()
            ways = (
                _Way(reader, there, tap.to_server, to_server=True),
                _Way(server, writer, tap.to_node, to_server=False),
            )
            tasks = [asyncio.create_task(self._take(way)) for way in ways]
            tasks += [asyncio.create_task(self._give(way)) for way in ways]
            try:
                await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
        finally:
            for end in filter(None, (writer, there)):
                self._writers.discard(end)
                _reset(end)

    async def _take(self, way: _Way) -> None:
        while data := await way.reader.read(_PIECE_BYTES):
            way.seen(data)
            quality = self.quality
            wait_s = quality.delay_s + self._rng.uniform(0.0, quality.jitter_s)
            await way.waiting.put((time.monotonic() + wait_s, data))
        await way.waiting.put((0.0, b""))

    async def _give(self, way: _Way) -> None:
        until_flip = self._distance()
        while True:
            due_s, data = await way.waiting.get()
            if not data:
                with suppress(OSError):
                    way.writer.write_eof()
                return
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
            await self._flowing.wait()
            if way.to_server and self.quality.flip_every_bytes is not None:
                if until_flip == float("inf"):  # they have begun to flip just now
                    until_flip = self._distance()
                data, until_flip = self._flipped(data, until_flip)
            way.writer.write(data)
            await way.writer.drain()
            if self.quality.bytes_per_s is not None:
                await asyncio.sleep(len(data) / self.quality.bytes_per_s)

    def _flipped(self, data: bytes, until_flip: float) -> tuple[bytes, float]:
        changed = bytearray(data)
        while until_flip < len(data):
            changed[int(until_flip)] ^= 1 << self._rng.randrange(8)
            self.flips += 1
            until_flip += self._distance()
        return bytes(changed), until_flip - len(data)

    def _distance(self) -> float:
        every = self.quality.flip_every_bytes
        return self._rng.expovariate(1 / every) + 1 if every is not None else float("inf")


def _reset(writer: asyncio.StreamWriter) -> None:
    """Close without a word to the other side but RST."""
    with suppress(OSError):
        connection = writer.get_extra_info("socket")
        if connection is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
    writer.transport.abort()
