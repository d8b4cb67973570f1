"""Reads what goes over the link, midway: which frames a node took, and which were promised.

It rests on the wire alone: websocket frames (RFC 6455), messages `hello`, `stream` and `ack`, and
Arrow record batches in binary messages (docs/api.md). A frame counts as promised as soon as the
server has sent its acknowledgement, whether or not that reached the node.
"""

from __future__ import annotations

import json
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.frames import ArrayInfo
from storage.schema import wire_schema

_TEXT, _BINARY = 1, 2
Columns = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Sent:
    """A batch as it left its node."""

    stream_id: str
    payload: bytes
    at_s: float
    """When it was seen, by `time.monotonic`."""


@dataclass(frozen=True)
class Ack:
    """A promise of the server."""

    stream_id: str
    seq_first: int
    seq_last: int
    at_s: float


@dataclass
class Witness:
    """What was seen of one node, over all its connections."""

    infos: dict[str, ArrayInfo] = field(default_factory=dict)
    """Streams that were announced, in order, by stream_id."""
    sent: list[Sent] = field(default_factory=list)
    acks: list[Ack] = field(default_factory=list)
    odd: list[str] = field(default_factory=list)
    """What could not be understood."""
    lock: threading.Lock = field(default_factory=threading.Lock)

    def tap(self) -> _Connection:
        """For a new connection."""
        return _Connection(self)

    def acknowledged(self, until_s: float = float("inf")) -> dict[str, npt.NDArray[np.uint64]]:
        """Numbers that were promised, rising, by stream_id."""
        found: dict[str, list[npt.NDArray[np.uint64]]] = defaultdict(list)
        for ack in [ack for ack in list(self.acks) if ack.at_s <= until_s]:
            found[ack.stream_id].append(np.arange(ack.seq_first, ack.seq_last + 1, dtype=np.uint64))
        return {stream_id: np.unique(np.concatenate(pieces)) for stream_id, pieces in found.items()}

    def newest_promised_s(self, until_s: float) -> float:
        """When the newest frame of those that were promised by then was seen first."""
        found_s = float("-inf")
        for stream_id, promised in self.acknowledged(until_s).items():
            schema, newest = wire_schema(self.infos[stream_id]), promised[-1]
            for sent in [sent for sent in list(self.sent) if sent.stream_id == stream_id]:
                batch = pa.ipc.read_record_batch(pa.py_buffer(sent.payload), schema)
                if newest in columns_of(batch)["seq"]:
                    found_s = max(found_s, sent.at_s)
                    break
        return found_s

    def frames(self, stream_id: str, until_s: float = float("inf")) -> Columns | None:
        """All frames of a stream that were seen, each once, in order; None: not one."""
        info = self.infos.get(stream_id)
        if info is None:
            return None
        schema = wire_schema(info)
        pieces = []
        for sent in list(self.sent):
            if sent.stream_id == stream_id and sent.at_s <= until_s:
                pieces.append(
                    columns_of(pa.ipc.read_record_batch(pa.py_buffer(sent.payload), schema))
                )
        return joined(pieces)

    def last_seq(self, stream_id: str, until_s: float = float("inf")) -> int | None:
        """The highest number that was seen of a stream."""
        found = self.frames(stream_id, until_s)
        return None if found is None else int(found["seq"][-1])


class _Connection:
    """One connection of the node; a tap of the proxy."""

    def __init__(self, witness: Witness) -> None:
        self._witness = witness
        self._node, self._server = Messages(), Messages()
        self._stream_id = ""

    def to_server(self, data: bytes) -> None:
        with self._witness.lock:
            for kind, payload in self._node.feed(data):
                if kind == _BINARY:
                    sent = Sent(self._stream_id, payload, time.monotonic())
                    self._witness.sent.append(sent)
                elif kind == _TEXT:
                    self._node_said(json.loads(payload))

    def to_node(self, data: bytes) -> None:
        with self._witness.lock:
            for kind, payload in self._server.feed(data):
                if kind != _TEXT:
                    continue
                said = json.loads(payload)
                if said["type"] == "ack":
                    stream_id = said.get("stream_id", self._stream_id)
                    ack = Ack(stream_id, said["seq_first"], said["seq_last"], time.monotonic())
                    self._witness.acks.append(ack)

    def _node_said(self, said: dict[str, Any]) -> None:
        if said["type"] == "hello":
            earlier = [stream["array_info"] for stream in said.get("earlier", ())]
            for content in (*earlier, said["array_info"]):
                info = ArrayInfo.model_validate(content)
                self._witness.infos.setdefault(info.stream_id, info)
                self._stream_id = info.stream_id
        elif said["type"] == "stream":
            self._stream_id = said["stream_id"]


class Messages:
    """Websocket messages out of the bytes of one direction, after the HTTP head."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._in_head = True
        self._kind = 0
        self._message = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Whole messages, text (1) or binary (2), that end in this data."""
        self._bytes += data
        if self._in_head:
            _, end, rest = self._bytes.partition(b"\r\n\r\n")
            if not end:
                return
            self._in_head, self._bytes = False, bytearray(rest)
        while (frame := self._frame()) is not None:
            is_last, kind, payload = frame
            if kind >= 8:  # ping, pong and close may stand between the pieces of a message
                continue
            self._kind = kind or self._kind
            self._message += payload
            if is_last:
                yield self._kind, bytes(self._message)
                self._message.clear()

    def _frame(self) -> tuple[bool, int, bytes] | None:
        data = self._bytes
        if len(data) < 2:
            return None
        length, at = data[1] & 0x7F, 2
        if length >= 126:
            wide = 2 if length == 126 else 8
            length, at = int.from_bytes(data[2 : 2 + wide], "big"), 2 + wide
        mask = b""
        if data[1] & 0x80:
            mask, at = bytes(data[at : at + 4]), at + 4
        if len(data) < at + length:
            return None
        payload = np.frombuffer(bytes(data[at : at + length]), dtype=np.uint8)
        if mask:
            keys = np.frombuffer(mask * (length // 4 + 1), dtype=np.uint8)[:length]
            payload = payload ^ keys
        is_last, kind = bool(data[0] & 0x80), data[0] & 0x0F
        del data[: at + length]
        return is_last, kind, payload.tobytes()


def columns_of(batch: pa.RecordBatch) -> Columns:
    """Columns as numpy, (n,) or (n, tiles)."""
    found: Columns = {}
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        if isinstance(column, pa.FixedSizeListArray):
            values = column.flatten().to_numpy(zero_copy_only=False)
            found[name] = values.reshape(len(batch), column.type.list_size)
        else:
            found[name] = column.to_numpy(zero_copy_only=False)
    return found


def joined(pieces: list[Columns]) -> Columns | None:
    """Batches as one, each number once, in order; None if there is none."""
    if not pieces:
        return None
    every = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    _, first = np.unique(every["seq"], return_index=True)
    return {name: values[first] for name, values in every.items()}
