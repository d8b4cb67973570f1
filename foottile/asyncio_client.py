"""Client for asyncio: requests run in threads, live streams in the event loop.

It wraps the modules for threads, which have all logic of requests and responses.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from typing import Any, Self, TypeVar

import pyarrow as pa
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from foottile.client import Client
from foottile.connection import AsyncCloseable, AsyncWebsocket
from foottile.errors import ClientError
from foottile.live import FrameLoss, LiveRequest, LiveStreamState, Policy
from foottile.sessions import Clock, RemoteSession, SessionData, SessionMarker

T = TypeVar("T")


async def _iterate_in_thread(items: Iterator[T]) -> AsyncIterator[T]:
    """Yield the items of a blocking iterator; each is fetched in a thread."""
    nothing = object()
    while (item := await asyncio.to_thread(next, items, nothing)) is not nothing:
        yield item  # type: ignore[misc]  # a T, as it is not `nothing`


class AsyncSessionData:
    """Asynchronous `SessionData`, with the same arguments, results and errors."""

    def __init__(self, data: SessionData) -> None:
        self._data = data

    def __getitem__(self, key: slice | list[str] | tuple[str, ...]) -> AsyncSessionData:
        """Return a selection of columns or seconds."""
        return AsyncSessionData(self._data[key])

    def iter_batches(self) -> AsyncIterator[pa.RecordBatch]:
        """Yield batches, as `SessionData.iter_batches`."""
        return _iterate_in_thread(self._data.iter_batches())

    async def to_arrow(self) -> pa.Table:
        """Call `SessionData.to_arrow` in a thread."""
        return await asyncio.to_thread(self._data.to_arrow)

    async def to_pandas(self) -> Any:
        """Call `SessionData.to_pandas` in a thread."""
        return await asyncio.to_thread(self._data.to_pandas)

    async def to_numpy(self) -> dict[str, Any]:
        """Call `SessionData.to_numpy` in a thread."""
        return await asyncio.to_thread(self._data.to_numpy)


class AsyncSession:
    """Asynchronous `RemoteSession`, with the same arguments, results and errors."""

    def __init__(self, session: RemoteSession) -> None:
        self.snapshot = session
        """Session at the last response: `snapshot.id`, `snapshot.state`, `snapshot.metadata`."""

    def __repr__(self) -> str:
        return repr(self.snapshot)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, kind: object, error: object, trace: object) -> None:
        await asyncio.to_thread(self.snapshot.__exit__, kind, error, trace)

    def open(
        self,
        columns: Sequence[str] = (),
        *,
        start_s: float | None = None,
        end_s: float | None = None,
        clock: Clock = "node",
    ) -> AsyncSessionData:
        """Return the frames, as `RemoteSession.open`."""
        data = self.snapshot.open(columns, start_s=start_s, end_s=end_s, clock=clock)
        return AsyncSessionData(data)

    async def refresh(self) -> Self:
        """Call `RemoteSession.refresh` in a thread."""
        await asyncio.to_thread(self.snapshot.refresh)
        return self

    async def markers(self) -> list[SessionMarker]:
        """Call `RemoteSession.markers` in a thread."""
        return await asyncio.to_thread(self.snapshot.markers)

    async def add_marker(self, label: str, *, t_ns: int | None = None) -> SessionMarker:
        """Call `RemoteSession.add_marker` in a thread."""
        return await asyncio.to_thread(self.snapshot.add_marker, label, t_ns=t_ns)

    async def update(self, **changes: Any) -> Self:
        """Call `RemoteSession.update` in a thread."""
        await asyncio.to_thread(self.snapshot.update, **changes)
        return self

    async def stop(self) -> Self:
        """Call `RemoteSession.stop` in a thread."""
        await asyncio.to_thread(self.snapshot.stop)
        return self

    async def wait_until_sealed(self, timeout_s: float = 60.0) -> Self:
        """Call `RemoteSession.wait_until_sealed` in a thread."""
        await asyncio.to_thread(self.snapshot.wait_until_sealed, timeout_s)
        return self

    async def download(self, path: Any, **options: Any) -> Any:
        """Call `RemoteSession.download` in a thread."""
        return await asyncio.to_thread(self.snapshot.download, path, **options)


class AsyncClient(AsyncCloseable):
    """Asynchronous `Client`, created by `foottile.connect_async`."""

    def __init__(self, url: str, token: str | None = None, **options: Any) -> None:
        self._client = Client(url, token, **options)

    async def close(self) -> None:
        """Close all connections."""
        self._client.close()

    async def nodes(self) -> list[dict[str, Any]]:
        """Call `Client.nodes` in a thread."""
        return await asyncio.to_thread(self._client.nodes)

    async def node(self, name: str) -> dict[str, Any]:
        """Call `Client.node` in a thread."""
        return await asyncio.to_thread(self._client.node, name)

    async def sessions(
        self, search: str | None = None, **filters: Any
    ) -> AsyncIterator[AsyncSession]:
        """Yield sessions, as `Client.sessions`: `async for session in server.sessions("mud")`."""
        async for session in _iterate_in_thread(self._client.sessions(search, **filters)):
            yield AsyncSession(session)

    async def session(self, session_id: str) -> AsyncSession:
        """Call `Client.session` in a thread."""
        return AsyncSession(await asyncio.to_thread(self._client.session, session_id))

    async def download_take(self, take: str, path: Any, **options: Any) -> Any:
        """Call `Client.download_take` in a thread."""
        return await asyncio.to_thread(self._client.download_take, take, path, **options)

    async def record(self, node: str, name: str, **options: Any) -> AsyncSession:
        """Call `Client.record` in a thread; `async with` stops the recording."""
        return AsyncSession(await asyncio.to_thread(self._client.record, node, name, **options))

    async def tare(self, node: str, reason: str = "") -> dict[str, Any]:
        """Call `Client.tare` in a thread."""
        return await asyncio.to_thread(self._client.tare, node, reason)

    async def tares(self, node: str) -> list[dict[str, Any]]:
        """Call `Client.tares` in a thread."""
        return await asyncio.to_thread(self._client.tares, node)

    def live(
        self,
        node: str | None = None,
        columns: Sequence[str] = (),
        *,
        policy: Policy = "lossless",
        stream_id: str | None = None,
        from_seq: int | None = None,
        on_loss: Callable[[FrameLoss], None] | None = None,
        reconnect_timeout_s: float | None = None,
    ) -> AsyncLiveStream:
        """Return a live stream: `async for batch in server.live("left")`."""
        request = LiveRequest.create(self._client.url, node, columns, policy, stream_id, from_seq)
        return AsyncLiveStream(
            request, self._client.http, on_loss=on_loss, reconnect_timeout_s=reconnect_timeout_s
        )


class AsyncLiveStream(LiveStreamState, AsyncCloseable):
    """Asynchronous iterator of live batches, as `LiveStream`."""

    def __init__(self, *request: Any, **options: Any) -> None:
        super().__init__(*request, **options)
        self._socket: ClientConnection | None = None

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> pa.RecordBatch:
        """Wait for the next frames and return them; errors as for `LiveStream`."""
        while not self._is_closed:
            try:
                message = await (await self._connect()).recv()
            except ConnectionClosed as end:
                self._socket = None
                await asyncio.sleep(self._delay_after_close_s(end))
                continue
            self._last_message_s = time.monotonic()
            try:
                batch = self._protocol.parse_message(message)
            except ClientError:
                await self.close()
                raise
            if batch is not None:
                return batch
        raise StopAsyncIteration

    async def close(self) -> None:
        """End the stream."""
        self._is_closed = True
        socket, self._socket = self._socket, None
        if socket is not None:
            await socket.close()

    async def _connect(self) -> ClientConnection:
        while self._socket is None:
            try:
                url, options = self._protocol.make_url(), self._get_options()
                self._socket = await connect(url, create_connection=AsyncWebsocket, **options)
            except (OSError, InvalidHandshake, EOFError) as error:
                await asyncio.sleep(self._delay_after_failure_s(error))
        return self._socket
