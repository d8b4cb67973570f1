"""Live streams: an iterator of Arrow batches that reconnects by itself.

The protocol (messages, positions, retry delays) has neither socket nor clock: `LiveStream` is for
threads, and `foottile.asyncio_client` has the one for an event loop.
"""

from __future__ import annotations

import json
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, Literal, get_args
from urllib.parse import urlencode

import pyarrow as pa
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection, connect

from foottile.connection import (
    Closeable,
    UpgradeRejection,
    Websocket,
    explain_foreign_response,
    explain_tls,
)
from foottile.errors import (
    ClientError,
    DamagedError,
    FramesLostWarning,
    InvalidRequestError,
    ServerUnavailableError,
    make_error,
)
from foottile.http import HttpClient

Policy = Literal["lossless", "drop_oldest", "latest"]
POLICIES: tuple[Policy, ...] = get_args(Policy)

MESSAGE_BYTES_MAX = 1 << 24
_POLICY, _NO_STREAM, _UNREADABLE = 1008, 4011, 4012
_LOSSES_MAX = 1000
_RETRY_DELAYS_S = (0.1, 5.0)
_NO_CLOSE_FRAME = 1006


@dataclass(frozen=True)
class LiveRequest:
    """Request for a live stream.

    Attributes:
        url: address of the server.
        node: name of the node; None: the only one.
        columns: names; empty: all.
        policy: rule for dropping frames of a slow reader.
        stream_id: stream of the first frame; None: the present one.
        from_seq: number of the first frame; None: the next frame.
    """

    url: str
    node: str | None
    columns: tuple[str, ...]
    policy: Policy
    stream_id: str | None = None
    from_seq: int | None = None

    @classmethod
    def create(
        cls, url: str, node: str | None, columns: str | Sequence[str], policy: Policy, *begin: Any
    ) -> LiveRequest:
        """Return a request; `columns` may be a single name."""
        return cls(
            url, node, (columns,) if isinstance(columns, str) else (*columns,), policy, *begin
        )


@dataclass(frozen=True)
class FrameLoss:
    """Interval of frames that a live stream lacks, ends included.

    Attributes:
        stream_id: id of the stream.
        from_seq: first missing frame.
        to_seq: last missing frame; None: unknown.
        reason: reason as in docs/api.md.
    """

    stream_id: str
    from_seq: int
    to_seq: int | None
    reason: str

    def __str__(self) -> str:
        until = "on" if self.to_seq is None else f"to {self.to_seq}"
        frames = f"frames from {self.from_seq} {until} of stream {self.stream_id}"
        return f"{frames} are lost: {self.reason}"


class LiveProtocol:
    """State of a live stream across connections.

    Args:
        request: node, columns, policy and position.
        on_loss: receives each loss; None: a loss is a warning, for `lossless`.
    """

    def __init__(
        self, request: LiveRequest, on_loss: Callable[[FrameLoss], None] | None = None
    ) -> None:
        self.losses: deque[FrameLoss] = deque(maxlen=_LOSSES_MAX)
        """Newest thousand losses that the server reported."""
        self._request = request
        self._on_loss = on_loss
        self._stream_id, self._next_seq = request.stream_id, request.from_seq
        self._schema: pa.Schema | None = None
        self._failures = 0
        self._has_connected = False

    @property
    def position(self) -> tuple[str, int] | None:
        """Stream and number of the next frame; None before the first."""
        if self._stream_id is None or self._next_seq is None:
            return None
        return self._stream_id, self._next_seq

    def make_url(self) -> str:
        """Return the websocket address that begins or resumes the stream."""
        request = self._request
        query = {"format": "arrow", "policy": request.policy}
        position = {"node": request.node, "columns": ",".join(request.columns) or None}
        position |= {"stream_id": self._stream_id}
        position |= {"from_seq": None if self._next_seq is None else str(self._next_seq)}
        query |= {name: value for name, value in position.items() if value is not None}
        self._schema = None
        return f"ws{request.url.removeprefix('http')}/api/v1/live?{urlencode(query)}"

    def parse_message(self, message: str | bytes) -> pa.RecordBatch | None:
        """Return the new frames of a message; None without frames.

        Raises:
            DamagedError: not a valid message of a foottile server.
        """
        self._has_connected = True
        try:
            if isinstance(message, str):
                self._parse_text(json.loads(message))
                return None
            if self._schema is None:
                self._schema = pa.ipc.read_schema(pa.py_buffer(message))
                return None
            return self._drop_known(pa.ipc.read_record_batch(pa.py_buffer(message), self._schema))
        except (ValueError, KeyError, TypeError, pa.ArrowException) as error:
            raise DamagedError(f"{self._request.url}: not a live message: {error}") from error

    def check_close(self, code: int, reason: str) -> None:
        """Handle the close code of a connection; returning means: reconnect.

        Raises:
            InvalidRequestError: no such node, column or stream.
            DamagedError: the server cannot read the next frame.
        """
        if code == _POLICY:
            raise InvalidRequestError(f"{self._request.url}: {reason}")
        if code == _UNREADABLE:
            raise DamagedError(f"{self._request.url}: {reason}")
        if code == _NO_STREAM:
            if not self._has_connected or self._stream_id is None:
                raise InvalidRequestError(f"{self._request.url}: {reason}")
            loss = FrameLoss(self._stream_id, self._next_seq or 0, None, "no_stream")
            self._stream_id, self._next_seq = None, 0  # all stored frames of the present one
            self._add_loss(loss)

    def explain_rejection(
        self, status: int, headers: Mapping[str, str], body: bytes
    ) -> ClientError | None:
        """Return the error for an HTTP response in place of a websocket; None: retry.

        Args:
            status: HTTP status.
            headers: headers, with names in lower case.
            body: content.
        """
        url = self._request.url
        foreign = explain_foreign_response(url, status, headers)
        if foreign is None and status == HTTPStatus.OK:  # no websocket server
            foreign = explain_foreign_response(url, status, headers, expected="a websocket")
        if self._has_connected and (
            foreign is not None or status == HTTPStatus.SERVICE_UNAVAILABLE
        ):
            return None
        if foreign is not None:
            return ServerUnavailableError(f"{url}: {foreign}", status=status)
        try:
            content: Any = json.loads(body)
        except ValueError:
            content = None
        return make_error(status, content, url)

    def compute_retry_delay_s(
        self, error: Exception, silence_s: float, timeout_s: float | None
    ) -> float:
        """Return the delay before the next attempt, with exponential backoff.

        Args:
            error: failure of the last attempt.
            silence_s: time since the last message.
            timeout_s: longest silence; None: unlimited after the first message.

        Raises:
            ServerUnavailableError: no message yet, or a longer silence.
        """
        if not self._has_connected or (timeout_s is not None and silence_s > timeout_s):
            what = explain_tls(error) or f"no answer: {error}"
            raise ServerUnavailableError(f"{self._request.url}: {what}") from error
        self._failures += 1
        least, most = _RETRY_DELAYS_S
        return float(min(most, least * 2 ** min(self._failures - 1, 10)))

    def _parse_text(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        if not isinstance(kind, str):
            raise TypeError("a message without a type")
        if kind == "stream":
            if message["stream_id"] != self._stream_id or self._next_seq is None:
                self._stream_id, self._next_seq = message["stream_id"], int(message["from_seq"])
            self._schema = None
        elif kind in ("lost", "dropped"):
            first, last = int(message["from_seq"]), int(message["to_seq"])
            self._check_no_gap(first)
            self._stream_id, self._next_seq = message["stream_id"], last + 1
            self._add_loss(FrameLoss(message["stream_id"], first, last, str(message["reason"])))

    def _drop_known(self, batch: pa.RecordBatch) -> pa.RecordBatch | None:
        seq = batch.column("seq")
        first, last = seq[0].as_py(), seq[-1].as_py()
        if first is None or last is None or last - first + 1 != batch.num_rows:
            raise ValueError("the frame numbers are not consecutive")
        self._check_no_gap(first)
        self._failures = 0
        if self._next_seq is not None and first < self._next_seq:  # already received
            batch = batch.slice(self._next_seq - first)
        self._next_seq = max(last + 1, self._next_seq or 0)
        return batch if batch.num_rows else None

    def _check_no_gap(self, seq: int) -> None:
        """Reject a gap that the server did not report as a loss."""
        if self._next_seq is not None and seq > self._next_seq:
            raise ValueError(f"frame {seq} follows {self._next_seq - 1} without a reported loss")

    def _add_loss(self, loss: FrameLoss) -> None:
        self._failures = 0
        self.losses.append(loss)
        if self._on_loss is not None:
            self._on_loss(loss)
        elif self._request.policy == "lossless":
            warnings.warn(str(loss), FramesLostWarning, stacklevel=5)


class LiveStreamState:
    """Base class of live streams for threads and for asyncio."""

    def __init__(
        self,
        request: LiveRequest,
        http: HttpClient,
        *,
        on_loss: Callable[[FrameLoss], None] | None = None,
        reconnect_timeout_s: float | None = None,
    ) -> None:
        self._protocol = LiveProtocol(request, on_loss)
        self._http = http
        self._reconnect_timeout_s = reconnect_timeout_s
        self._last_message_s = time.monotonic()
        self._is_closed = False

    @property
    def position(self) -> tuple[str, int] | None:
        """`stream_id` and `from_seq` of the next frame; None before the first."""
        return self._protocol.position

    @property
    def losses(self) -> Sequence[FrameLoss]:
        """Newest thousand losses that the server reported."""
        return tuple(self._protocol.losses)

    def _get_options(self) -> dict[str, Any]:
        """Return the websocket options of a connection."""
        return {
            "additional_headers": self._http.headers,
            "ssl": self._http.context,
            "compression": None,
            "max_size": MESSAGE_BYTES_MAX,
            "close_timeout": 1.0,
            "proxy": None,
        }

    def _delay_after_close_s(self, end: ConnectionClosed) -> float:
        """Return the delay before reconnecting after a closed connection.

        Raises:
            ClientError: reconnecting is useless.
        """
        if self._is_closed:
            return 0.0
        code, reason = _NO_CLOSE_FRAME, ""
        if end.rcvd is not None:
            code, reason = end.rcvd.code, end.rcvd.reason
        self._protocol.check_close(int(code), reason)
        return self._retry_delay_s(end)

    def _delay_after_failure_s(self, error: Exception) -> float:
        """Return the delay before reconnecting after a failed attempt.

        Raises:
            ClientError: another attempt is useless.
        """
        if isinstance(error, UpgradeRejection):
            problem = self._protocol.explain_rejection(error.status, error.headers, error.body)
            if problem is not None:
                raise problem from error
        return self._retry_delay_s(error)

    def _retry_delay_s(self, error: Exception) -> float:
        silence_s = time.monotonic() - self._last_message_s
        return self._protocol.compute_retry_delay_s(error, silence_s, self._reconnect_timeout_s)


class LiveStream(LiveStreamState, Closeable):
    """Iterator of live batches, created by `Client.live`; connects at the first batch.

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
            InvalidRequestError: no such node, column or stream.
            ServerUnavailableError: no server at first, or not for `reconnect_timeout_s`.
            ClientError: the server rejects the request, or is no foottile server.
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
            except ClientError:
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
