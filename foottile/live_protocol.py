"""What is said on a live websocket, and when to go on after it broke: no socket, no clock here."""

from __future__ import annotations

import json
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, Literal, get_args
from urllib.parse import urlencode

import pyarrow as pa

from foottile.errors import (
    DamagedError,
    FootTileError,
    FramesLostWarning,
    NoAnswerError,
    UsageError,
    refused,
)
from foottile.foreign import explain_foreign
from foottile.tls import explain_tls

Policy = Literal["lossless", "drop_oldest", "latest"]
POLICIES: tuple[Policy, ...] = get_args(Policy)

MESSAGE_BYTES_MAX = 1 << 24
_POLICY, _NO_STREAM, _UNREADABLE = 1008, 4011, 4012
_LOSSES_MAX = 1000
_AGAIN_S = (0.1, 5.0)


@dataclass(frozen=True)
class Asked:
    """What is asked for.

    Attributes:
        url: the server's address.
        node: the node; None: the only one.
        columns: names; none: all.
        policy: what is left out, if anything.
        stream_id: stream to begin in; None: the present one.
        from_seq: frame to begin with; None: the next that comes.
    """

    url: str
    node: str | None
    columns: tuple[str, ...]
    policy: Policy
    stream_id: str | None = None
    from_seq: int | None = None

    @classmethod
    def of(
        cls, url: str, node: str | None, columns: str | Sequence[str], policy: Policy, *begin: Any
    ) -> Asked:
        """The same, where a name alone may stand for columns."""
        return cls(
            url, node, (columns,) if isinstance(columns, str) else (*columns,), policy, *begin
        )


@dataclass(frozen=True)
class Loss:
    """Frames that are left out of a live stream, ends included.

    Attributes:
        stream_id: the stream.
        from_seq: the first of them.
        to_seq: the last of them; None: not known.
        reason: why; as docs/api.md says.
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
    """A live stream over as many connections as it takes.

    Args:
        asked: what for.
        on_loss: told of frames that are left out; None: warned of, for `lossless`.
    """

    def __init__(self, asked: Asked, on_loss: Callable[[Loss], None] | None = None) -> None:
        self.losses: deque[Loss] = deque(maxlen=_LOSSES_MAX)
        """What was left out, as far as it was said; the newest thousand."""
        self._asked = asked
        self._on_loss = on_loss
        self._stream_id, self._next_seq = asked.stream_id, asked.from_seq
        self._schema: pa.Schema | None = None
        self._failures = 0
        self._has_begun = False

    @property
    def position(self) -> tuple[str, int] | None:
        """Stream and number of the frame that is wanted next; None before the first."""
        if self._stream_id is None or self._next_seq is None:
            return None
        return self._stream_id, self._next_seq

    def address(self) -> str:
        """Where to connect to, to begin or to go on."""
        asked = self._asked
        query = {"format": "arrow", "policy": asked.policy}
        given = {"node": asked.node, "columns": ",".join(asked.columns) or None}
        given |= {"stream_id": self._stream_id}
        given |= {"from_seq": None if self._next_seq is None else str(self._next_seq)}
        query |= {name: value for name, value in given.items() if value is not None}
        self._schema = None
        return f"ws{asked.url.removeprefix('http')}/api/v1/live?{urlencode(query)}"

    def take(self, message: str | bytes) -> pa.RecordBatch | None:
        """A message; its frames, if it has some.

        Raises:
            DamagedError: it is not one of a foottile server.
        """
        self._has_begun = True
        try:
            if isinstance(message, str):
                self._said(json.loads(message))
                return None
            if self._schema is None:
                self._schema = pa.ipc.read_schema(pa.py_buffer(message))
                return None
            return self._news(pa.ipc.read_record_batch(pa.py_buffer(message), self._schema))
        except (ValueError, KeyError, TypeError, pa.ArrowException) as error:
            raise DamagedError(f"{self._asked.url}: not a live message: {error}") from error

    def closed(self, code: int, reason: str) -> None:
        """The connection has ended; it is to be opened again, unless this raises.

        Raises:
            UsageError: what was asked for is not there.
            DamagedError: the server cannot read the frame that is wanted next.
        """
        if code == _POLICY:
            raise UsageError(f"{self._asked.url}: {reason}")
        if code == _UNREADABLE:
            raise DamagedError(f"{self._asked.url}: {reason}")
        if code == _NO_STREAM:
            if not self._has_begun or self._stream_id is None:
                raise UsageError(f"{self._asked.url}: {reason}")
            loss = Loss(self._stream_id, self._next_seq or 0, None, "no_stream")
            self._stream_id, self._next_seq = None, 0  # all that there is of the present one
            self._lose(loss)

    def refused(self, status: int, headers: Mapping[str, str], body: bytes) -> FootTileError | None:
        """The server has answered with HTTP; None: it may be asked again.

        Args:
            status: of the answer.
            headers: of the answer, their names in small letters.
            body: its content.
        """
        foreign = explain_foreign(self._asked.url, status, headers)
        if foreign is None and status == HTTPStatus.OK:  # it has not understood
            foreign = explain_foreign(self._asked.url, status, headers, expected="a websocket")
        if self._has_begun and (foreign is not None or status == HTTPStatus.SERVICE_UNAVAILABLE):
            return None
        if foreign is not None:
            return NoAnswerError(f"{self._asked.url}: {foreign}", status=status)
        try:
            content: Any = json.loads(body)
        except ValueError:
            content = None
        return refused(status, content, self._asked.url)

    def again_s(self, error: Exception, silent_s: float, give_up_s: float | None) -> float:
        """How long to wait before it is tried again.

        Args:
            error: what went wrong.
            silent_s: since something was heard.
            give_up_s: how long that may be; None: without end, once it has begun.

        Raises:
            NoAnswerError: it is not to be tried again.
        """
        if not self._has_begun or (give_up_s is not None and silent_s > give_up_s):
            what = explain_tls(error) or f"no answer: {error}"
            raise NoAnswerError(f"{self._asked.url}: {what}") from error
        self._failures += 1
        least, most = _AGAIN_S
        return float(min(most, least * 2 ** min(self._failures - 1, 10)))

    def _said(self, said: dict[str, Any]) -> None:
        kind = said["type"]
        if not isinstance(kind, str):
            raise TypeError("a message without a type")
        if kind == "stream":
            if said["stream_id"] != self._stream_id or self._next_seq is None:
                self._stream_id, self._next_seq = said["stream_id"], int(said["from_seq"])
            self._schema = None
        elif kind in ("lost", "dropped"):
            self._check_next(int(said["from_seq"]))
            self._stream_id, self._next_seq = said["stream_id"], int(said["to_seq"]) + 1
            reason = str(said["reason"])
            self._lose(Loss(said["stream_id"], int(said["from_seq"]), int(said["to_seq"]), reason))

    def _news(self, batch: pa.RecordBatch) -> pa.RecordBatch | None:
        seq = batch.column("seq")
        first, last = seq[0].as_py(), seq[-1].as_py()
        if first is None or last is None or last - first + 1 != batch.num_rows:
            raise ValueError("frames whose numbers do not follow one another")
        self._check_next(first)
        self._failures = 0
        if self._next_seq is not None and first < self._next_seq:  # it was here already
            batch = batch.slice(self._next_seq - first)
        self._next_seq = max(last + 1, self._next_seq or 0)
        return batch if batch.num_rows else None

    def _check_next(self, seq: int) -> None:
        """No frame is missing of which nothing was said."""
        if self._next_seq is not None and seq > self._next_seq:
            raise ValueError(
                f"frame {seq} after {self._next_seq - 1}, and no word of those between"
            )

    def _lose(self, loss: Loss) -> None:
        self._failures = 0
        self.losses.append(loss)
        if self._on_loss is not None:
            self._on_loss(loss)
        elif self._asked.policy == "lossless":
            warnings.warn(str(loss), FramesLostWarning, stacklevel=5)
