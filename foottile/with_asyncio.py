"""The same for asyncio: questions are asked in threads, and live streams are read in the loop.

No rule is here: what is asked, and what an answer means, is in the modules that this one wraps.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

import pyarrow as pa
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from foottile.closing import AsyncClosing
from foottile.data import Clock, Data
from foottile.errors import FootTileError
from foottile.live_protocol import Asked, Loss, Policy
from foottile.live_state import LiveState
from foottile.server import Server
from foottile.sessions import Marker, Session
from foottile.websocket import AsyncConnection

T = TypeVar("T")


async def _each(items: Iterator[T]) -> AsyncIterator[T]:
    """What an iterator gives, taken in a thread."""
    nothing = object()
    while (item := await asyncio.to_thread(next, items, nothing)) is not nothing:
        yield item  # type: ignore[misc]  # it is a T, since it is not `nothing`


class AsyncData:
    """Frames of a session, as `Data`; arguments, results and errors are the same."""

    def __init__(self, data: Data) -> None:
        self._data = data

    def __getitem__(self, what: slice | list[str] | tuple[str, ...]) -> AsyncData:
        """Less of the same: a list of columns, or seconds."""
        return AsyncData(self._data[what])

    def batches(self) -> AsyncIterator[pa.RecordBatch]:
        """As `Data.batches`."""
        return _each(self._data.batches())

    async def arrow(self) -> pa.Table:
        """As `Data.arrow`."""
        return await asyncio.to_thread(self._data.arrow)

    async def pandas(self) -> Any:
        """As `Data.pandas`."""
        return await asyncio.to_thread(self._data.pandas)

    async def numpy(self) -> dict[str, Any]:
        """As `Data.numpy`."""
        return await asyncio.to_thread(self._data.numpy)


class AsyncSession:
    """A session, as `Session`; arguments, results and errors are the same."""

    def __init__(self, session: Session) -> None:
        self.now = session
        """As it was described last: `now.id`, `now.state`, `now.facts`."""

    def __repr__(self) -> str:
        return repr(self.now)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await asyncio.to_thread(self.now.__exit__, kind, error, trace)

    def open(
        self,
        columns: Sequence[str] = (),
        *,
        start_s: float | None = None,
        end_s: float | None = None,
        clock: Clock = "node",
    ) -> AsyncData:
        """As `Session.open`."""
        return AsyncData(self.now.open(columns, start_s=start_s, end_s=end_s, clock=clock))

    async def refresh(self) -> Self:
        """As `Session.refresh`."""
        await asyncio.to_thread(self.now.refresh)
        return self

    async def markers(self) -> list[Marker]:
        """As `Session.markers`."""
        return await asyncio.to_thread(self.now.markers)

    async def add_marker(self, label: str, *, t_ns: int | None = None) -> Marker:
        """As `Session.add_marker`."""
        return await asyncio.to_thread(self.now.add_marker, label, t_ns=t_ns)

    async def describe(self, **changes: Any) -> Self:
        """As `Session.make_array_info`."""
        await asyncio.to_thread(self.now.describe, **changes)
        return self

    async def stop(self) -> Self:
        """As `Session.stop`."""
        await asyncio.to_thread(self.now.stop)
        return self

    async def wait(self, timeout_s: float = 60.0) -> Self:
        """As `Session.wait`."""
        await asyncio.to_thread(self.now.wait, timeout_s)
        return self

    async def download(self, path: Any, **how: Any) -> Any:
        """As `Session.download`."""
        return await asyncio.to_thread(self.now.download, path, **how)


class AsyncServer(AsyncClosing):
    """One server, as `Server`; made by `foottile.connect_async`."""

    def __init__(self, url: str, token: str | None = None, **how: Any) -> None:
        self._server = Server(url, token, **how)

    async def close(self) -> None:
        """As `Server.close`."""
        self._server.close()

    async def nodes(self) -> list[dict[str, Any]]:
        """As `Server.nodes`."""
        return await asyncio.to_thread(self._server.nodes)

    async def node(self, name: str) -> dict[str, Any]:
        """As `Server.node`."""
        return await asyncio.to_thread(self._server.node, name)

    async def sessions(self, search: str | None = None, **only: Any) -> AsyncIterator[AsyncSession]:
        """As `Server.sessions`: `async for session in server.sessions("mud")`."""
        async for session in _each(self._server.sessions(search, **only)):
            yield AsyncSession(session)

    async def session(self, session_id: str) -> AsyncSession:
        """As `Server.session`."""
        return AsyncSession(await asyncio.to_thread(self._server.session, session_id))

    async def download_take(self, take: str, path: Any, **how: Any) -> Any:
        """As `Server.download_take`."""
        return await asyncio.to_thread(self._server.download_take, take, path, **how)

    async def record(self, node: str, name: str, **described: Any) -> AsyncSession:
        """As `Server.record`; `async with` stops it."""
        return AsyncSession(await asyncio.to_thread(self._server.record, node, name, **described))

    async def tare(self, node: str, reason: str = "") -> dict[str, Any]:
        """As `Server.tare`."""
        return await asyncio.to_thread(self._server.tare, node, reason)

    async def tares(self, node: str) -> list[dict[str, Any]]:
        """As `Server.tares`."""
        return await asyncio.to_thread(self._server.tares, node)

    def live(
        self,
        node: str | None = None,
        columns: Sequence[str] = (),
        *,
        policy: Policy = "lossless",
        stream_id: str | None = None,
        from_seq: int | None = None,
        on_loss: Callable[[Loss], None] | None = None,
        give_up_s: float | None = None,
    ) -> AsyncLive:
        """As `Server.live`: `async for batch in server.live("left")`."""
        asked = Asked.of(self._server.url, node, columns, policy, stream_id, from_seq)
        return AsyncLive(asked, self._server.http, on_loss=on_loss, give_up_s=give_up_s)


class AsyncLive(LiveState, AsyncClosing):
    """A live stream, as `Live`: an asynchronous iterator of Arrow batches."""

    def __init__(self, *asked: Any, **how: Any) -> None:
        super().__init__(*asked, **how)
        self._socket: ClientConnection | None = None

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> pa.RecordBatch:
        """The next frames; errors as of `Live`."""
        while not self._is_over:
            try:
                message = await (await self._connected()).recv()
            except ConnectionClosed as end:
                self._socket = None
                await asyncio.sleep(self._closed_s(end))
                continue
            self._heard_s = time.monotonic()
            try:
                batch = self._protocol.take(message)
            except FootTileError:
                await self.close()
                raise
            if batch is not None:
                return batch
        raise StopAsyncIteration

    async def close(self) -> None:
        """End it."""
        self._is_over = True
        socket, self._socket = self._socket, None
        if socket is not None:
            await socket.close()

    async def _connected(self) -> ClientConnection:
        while self._socket is None:
            try:
                self._socket = await connect(
                    self._protocol.address(), create_connection=AsyncConnection, **self._options()
                )
            except (OSError, InvalidHandshake, EOFError) as error:
                await asyncio.sleep(self._failed_s(error))
        return self._socket
