"""A live stream: an iterator of Arrow batches that goes on by itself when its connection breaks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Self

import pyarrow as pa
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from foottile.errors import FootTileError
from foottile.live_protocol import MESSAGE_BYTES_MAX, Asked, LiveProtocol, Loss


class Live:
    """Made by `Server.live`. It connects when the first batch is asked for; `close` ends it.

    Each batch has consecutive frames of one stream, with `seq`, `t_ns`, the columns asked for, and
    `recomputed`. The array is described in `batch.schema.metadata[b"foottile.array_info"]`.
    """

    def __init__(
        self,
        asked: Asked,
        headers: Mapping[str, str],
        *,
        on_loss: Callable[[Loss], None] | None = None,
        give_up_s: float | None = None,
    ) -> None:
        self._closing = ExitStack()
        self._protocol = LiveProtocol(asked, on_loss)
        self._headers = dict(headers)
        self._give_up_s = give_up_s
        self._socket: ClientConnection | None = None
        self._heard_s = time.monotonic()
        self._is_over = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

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
                code, reason = (1006, "") if end.rcvd is None else (end.rcvd.code, end.rcvd.reason)
                if not self._is_over:
                    self._protocol.closed(int(code), reason)
                    self._pause(end)
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
    def position(self) -> tuple[str, int] | None:
        """`boot_id` and `from_seq` of the frame that is wanted next; None before the first."""
        return self._protocol.position

    @property
    def is_connected(self) -> bool:
        """Is there a connection now?"""
        return self._socket is not None

    @property
    def losses(self) -> Sequence[Loss]:
        """What was left out, as far as it was said; the newest thousand."""
        return tuple(self._protocol.losses)

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
                    self._protocol.address(),
                    additional_headers=self._headers,
                    compression=None,
                    max_size=MESSAGE_BYTES_MAX,
                    close_timeout=1.0,
                    proxy=None,
                )
                self._socket = self._closing.enter_context(connection)
            except InvalidStatus as error:
                answer = error.response
                if (problem := self._protocol.refused(answer.status_code, answer.body)) is not None:
                    raise problem from error
                self._pause(error)
            except (OSError, InvalidHandshake, EOFError) as error:
                self._pause(error)
        return self._socket

    def _pause(self, error: Exception) -> None:
        """Wait before it is tried again; errors as of `LiveProtocol.again_s`."""
        silent_s = time.monotonic() - self._heard_s
        time.sleep(self._protocol.again_s(error, silent_s, self._give_up_s))
