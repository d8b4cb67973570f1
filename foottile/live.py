"""A live stream: an iterator of Arrow batches that goes on by itself when its connection breaks."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pyarrow as pa
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection, connect

from foottile.closing import Closing
from foottile.errors import FootTileError
from foottile.live_state import LiveState
from foottile.websocket import Connection


class Live(LiveState, Closing):
    """Made by `Server.live`. It connects when the first batch is asked for; `close` ends it.

    Each batch has consecutive frames of one stream, with `seq`, `t_ns`, the columns asked for, and
    `is_recomputed`. The array is described in `batch.schema.metadata[b"foottile.array_info"]`.
    """

    def __init__(self, *asked: Any, **how: Any) -> None:
        self._closing = ExitStack()
        self._socket: ClientConnection | None = None
        super().__init__(*asked, **how)

    def __del__(self) -> None:
        # A `for` loop that is left has nobody else who would close it.
        self.close()

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        return self

    def __next__(self) -> pa.RecordBatch:
        """The next frames; waits for them.

        Raises:
            UsageError: what was asked for is not there.
            NoAnswerError: there is no server, at first, or not for `give_up_s`.
            FootTileError: it refuses, or is no foottile server.
            StopIteration: it was closed.
        """
        while not self._is_over:
            try:
                message = self._connected().recv()
            except ConnectionClosed as end:
                self._drop()
                time.sleep(self._closed_s(end))
                continue
            self._heard_s = time.monotonic()
            try:
                batch = self._protocol.take(message)
            except FootTileError:
                self.close()
                raise
            if batch is not None:
                return batch
        raise StopIteration

    @property
    def is_connected(self) -> bool:
        """Is there a connection now?"""
        return self._socket is not None

    def close(self) -> None:
        """End it; who waits for a batch, in another thread, gets none any more."""
        self._is_over = True
        self._drop()

    def _drop(self) -> None:
        self._socket = None
        self._closing.close()

    def _connected(self) -> ClientConnection:
        while self._socket is None:
            try:
                connection = connect(
                    self._protocol.address(), create_connection=Connection, **self._options()
                )
                self._socket = self._closing.enter_context(connection)
            except (OSError, InvalidHandshake, EOFError) as error:
                time.sleep(self._failed_s(error))
        return self._socket
