"""Live stream for threads: an iterator of Arrow batches that reconnects by itself."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pyarrow as pa
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection, connect

from foottile.connection import Closeable, Websocket
from foottile.errors import FootTileError
from foottile.live_protocol import LiveStreamState


class LiveStream(LiveStreamState, Closeable):
    """Iterator of live batches, created by `Server.live`; connects at the first batch.

    Each batch has consecutive frames of one stream, with `seq`, `t_ns`, the requested columns, and
    `recomputed`. `batch.schema.metadata[b"foottile.array_info"]` describes the array.
    """

    def __init__(self, *request: Any, **options: Any) -> None:
        self._exit_stack = ExitStack()
        self._socket: ClientConnection | None = None
        super().__init__(*request, **options)

    def __del__(self) -> None:
        # Nothing else closes the stream of a `for` loop that ends early.
        self.close()

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        return self

    def __next__(self) -> pa.RecordBatch:
        """Wait for the next frames and return them.

        Raises:
            UsageError: no such node, column or stream.
            ServerUnavailableError: no server at first, or not for `reconnect_timeout_s`.
            FootTileError: the server rejects the request, or is no foottile server.
            StopIteration: the stream was closed.
        """
        while not self._is_closed:
            try:
                message = self._connect().recv()
            except ConnectionClosed as end:
                self._disconnect()
                time.sleep(self._delay_after_close_s(end))
                continue
            self._last_message_s = time.monotonic()
            try:
                batch = self._protocol.parse_message(message)
            except FootTileError:
                self.close()
                raise
            if batch is not None:
                return batch
        raise StopIteration

    @property
    def is_connected(self) -> bool:
        """State of the connection."""
        return self._socket is not None

    def close(self) -> None:
        """End the stream, also for a thread that waits for a batch."""
        self._is_closed = True
        self._disconnect()

    def _disconnect(self) -> None:
        self._socket = None
        self._exit_stack.close()

    def _connect(self) -> ClientConnection:
        while self._socket is None:
            try:
                url, options = self._protocol.make_url(), self._get_options()
                connection = connect(url, create_connection=Websocket, **options)
                self._socket = self._exit_stack.enter_context(connection)
            except (OSError, InvalidHandshake, EOFError) as error:
                time.sleep(self._delay_after_failure_s(error))
        return self._socket
