"""The other sides of bridges: a viewer of Foxglove's protocol, and what tests share."""

from __future__ import annotations

import base64
import json
import re
import struct
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from service.bridges.follower import LiveFrames
from storage.schema import map_flat_columns
from tests.builders.arrays import make_array
from tests.waiting import PATIENCE_S, left_s


def make_live_frames(
    t_server_ns: np.ndarray, node: str, *, tiles: int = 2, seq_first: int = 0
) -> LiveFrames:
    """Frames in which every value differs, and every second row has no estimate."""
    info = make_array(tiles, node=node)
    n = len(t_server_ns)
    columns = {
        name: np.arange(n) + number
        for number, name in enumerate(map_flat_columns(tiles))
        if name.startswith(("seq", "tile_flags", "frame_flags", "t_mono_ns", "t_ns"))
    }
    for number, (name, column) in enumerate(map_flat_columns(tiles).items()):
        if name not in columns:
            values = np.where(np.arange(n) % 2, np.nan, 100.0 + number)
            columns[name] = values.astype(np.float32)  # as of the live feed
            if column.name == "contact":
                columns[name] = np.where(np.arange(n) % 2, 255, 1)
    columns["seq"] = columns["seq"] + seq_first
    columns |= {"t_server_ns": t_server_ns, "t_server_uncertainty_ns": np.full(n, 300)}
    return LiveFrames(node, info.stream_id, info, columns)


_UNKNOWN_CHANNEL = re.compile(r"Unknown channel ID: (\d+)")


class Seen(NamedTuple):
    """A message as a viewer sees it."""

    topic: str
    log_time_ns: int
    content: Any


class Viewer:
    """A viewer that subscribes to all topics, as Foxglove's protocol says.

    Text messages advertise channels with their schemas; a binary one has the byte 1, the number of
    the subscription, the log time in ns and the content (github.com/foxglove/ws-protocol).
    """

    def __init__(self, url: str) -> None:
        self.topics: dict[int, str] = {}
        self.schemas: dict[str, str] = {}
        self._decoders: dict[int, Callable[[bytes], Any]] = {}
        self.closed: set[int] = set()
        self._stack = ExitStack()
        self._socket = self._stack.enter_context(
            connect(
                url,
                subprotocols=[Subprotocol("foxglove.sdk.v1")],
                max_size=None,
                proxy=None,
                close_timeout=0.2,
            )
        )

    def close(self) -> None:
        self._stack.close()

    def receive(self, timeout_s: float = PATIENCE_S) -> Seen:
        """The next message of any topic."""
        end_s = time.monotonic() + timeout_s
        while True:
            message = self._socket.recv(timeout=left_s(end_s))
            if isinstance(message, bytes):
                kind, channel, log_time_ns = struct.unpack_from("<BIQ", message)
                assert kind == 1
                content = self._decoders[channel](message[13:])
                return Seen(self.topics[channel], log_time_ns, content)
            content = json.loads(message)
            match content["op"]:
                case "advertise":
                    for channel in content["channels"]:
                        self._read_schema(channel)
                        self._subscribe(channel["id"])
                case "unadvertise":
                    self.closed.update(content["channelIds"])
                case "status" if found := _UNKNOWN_CHANNEL.fullmatch(content["message"]):
                    # foxglove-sdk 0.30.3 advertises a channel before it knows it itself.
                    if int(found[1]) not in self.closed:
                        self._subscribe(int(found[1]))

    def skip_message(self, timeout_s: float) -> bool:
        """Receive a message of any topic; whether one came within this time."""
        try:
            self.receive(timeout_s)
        except TimeoutError:
            return False
        return True

    def receive_of(self, topic: str, is_wanted: Callable[[Any], bool] = bool) -> Seen:
        """The next message of a topic that is wanted."""
        end_s = time.monotonic() + PATIENCE_S
        while True:
            seen = self.receive(left_s(end_s))
            if seen.topic == topic and is_wanted(seen.content):
                return seen

    def _subscribe(self, number: int) -> None:
        # One by one: a channel that was closed meanwhile would have the others refused.
        asked = [{"id": number, "channelId": number}]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))

    def _read_schema(self, channel: dict[str, Any]) -> None:
        assert channel["encoding"] == channel["schemaEncoding"] == "protobuf"
        number, name = channel["id"], channel["schemaName"]
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
            pool.Add(file)
        self.topics[number], self.schemas[channel["topic"]] = channel["topic"], name
        self._decoders[number] = GetMessageClass(pool.FindMessageTypeByName(name)).FromString
