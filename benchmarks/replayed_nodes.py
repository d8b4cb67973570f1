"""Nodes whose frames were taken and encoded before: the load of `many_nodes.py`, in one process.

The frames are those of the paper's rolling foot, driven in virtual time by the real driver. A node
begins with its lead, then goes round the rest for ever; each time around the messages get new
numbers and instants, and nothing else changes. Behind that everything is the node's own code: its
stream in memory (there is no disk behind it), its link, its probes and questions.
"""

from __future__ import annotations

import asyncio
import os
import time
import uuid
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from recording_data import Recording, at_rate, batches, emulated

from devices.flags import FrameFlag
from devices.frames import ArrayInfo, FrameBatch
from devices.scene.scene_file import load_scene
from service.estimation.calibration import Calibration
from service.node.frame_sender import NodeCallbacks
from service.node.publisher import Publisher
from service.offline.calibration_lookup import find_calibration
from service.protocol.link import PROTOCOL, Hello, NodeStatus, generate_secret
from storage.intervals import EVICTED, Intervals
from storage.journal.node.retention import RetentionRequests
from storage.journal.node.stream import NodeStream
from storage.journal.stream_notes import StreamNotes
from storage.message_layout import check_and_compute_layout
from storage.schema import MEASURED_COLUMNS, wire_schema
from storage.wire import EncodedBatch, encode_frames

SCENE = "rolling"
LAP_S, LEAD_S = 10.0, 1.0
PITCH_M = 0.014
_FOOT_TILES = 4
DRAIN_S = 5.0
"""What was taken last is acknowledged by then, or late."""
_NUMBERED = ("seq", "t_mono_ns", "t_ns")


@dataclass(frozen=True)
class Message:
    """One batch as it was encoded, and when it was whole, ns after the first frame."""

    payload: bytes
    frames: int
    whole_ns: int


@dataclass(frozen=True)
class Played:
    """What every node sends: once its lead, then laps without end."""

    info: ArrayInfo
    calibration: Calibration
    lead: tuple[Message, ...]
    lap: tuple[Message, ...]
    lap_begin_ns: int
    lap_end_ns: int

    @property
    def frames_a_batch(self) -> float:
        """Mean of the laps."""
        return sum(message.frames for message in self.lap) / len(self.lap)


@dataclass(frozen=True)
class Sent:
    """What came of the load.

    Attributes:
        taken: frames, of all nodes.
        acknowledged: of these, on the server's disk by its word.
        late_ms: how late messages were given to the link, 99th percentile: the load's own fault.
        cpu_s: of the load.
        said: what links reported beside that they are there.
    """

    taken: int
    acknowledged: int
    late_ms: float
    cpu_s: float
    said: tuple[str, ...]


def played(tiles: int, rate_hz: float) -> Played:
    """Frames of so many tiles at so many a second.

    More than four tiles are the same foot side by side: the frames of four tiles, of which as many
    are left out as the rate asks for. To press each of 64 on the bench would take minutes.
    """
    foot = emulated(_FOOT_TILES, LEAD_S + LAP_S)
    if tiles > _FOOT_TILES:
        foot = thinned(foot, rate_hz)
    foot = at_rate(foot, rate_hz)
    bench = find_calibration("emulated-rig", foot.info.serials)
    serials = [f"T{i + 1:02d}" for i in range(tiles)]
    places = [i % _FOOT_TILES for i in range(tiles)]
    info = foot.info.model_copy(
        update={
            "tiles": tuple(
                foot.info.tiles[k].model_copy(
                    update={
                        "serial": serial,
                        "mux": 0x70 + i // 8,
                        "channel": i % 8,
                        "y_m": PITCH_M * (i // _FOOT_TILES),
                    }
                )
                for i, (serial, k) in enumerate(zip(serials, places, strict=True))
            ),
            "models": load_scene(SCENE).models,
        }
    )
    known = [bench.get_tile_or_wildcard(serial) for serial in foot.info.serials]
    calibration = bench.model_copy(
        update={
            "tiles": tuple(
                known[k].model_copy(update={"serial": s})
                for s, k in zip(serials, places, strict=True)
            )
        }
    )
    period_ns = round(1e9 / rate_hz)
    wide = replace(
        foot.frames,
        pressure_raw=foot.frames.pressure_raw[:, places],
        temperature_raw=foot.frames.temperature_raw[:, places],
        tile_flags=foot.frames.tile_flags[:, places],
        sample_offset_us=np.broadcast_to(
            np.arange(tiles, dtype=np.int32) * (period_ns // tiles // 1000),
            (len(foot.frames), tiles),
        ),
    )
    began_ns = int(wide.t_mono_ns[0])
    wide = replace(
        wide,
        seq=np.arange(len(wide), dtype=np.uint64),
        t_mono_ns=wide.t_mono_ns - began_ns,
        t_ns=wide.t_mono_ns - began_ns,
    )
    is_lead = (wide.frame_flags & FrameFlag.LEAD) != 0
    lead_frames = int(np.flatnonzero(is_lead)[-1]) + 1
    schema = wire_schema(info)
    lead, lap = (
        tuple(_messages(rows, schema, period_ns))
        for rows in (wide.slice_rows(0, lead_frames), wide.slice_rows(lead_frames, len(wide)))
    )
    lap_begin_ns = int(wide.t_mono_ns[lead_frames])
    return Played(info, calibration, lead, lap, lap_begin_ns, int(wide.t_mono_ns[-1]) + period_ns)


def thinned(recording: Recording, rate_hz: float) -> Recording:
    """The same time with fewer frames of it."""
    frames = recording.frames
    since_s = (frames.t_mono_ns - frames.t_mono_ns[0]) * 1e-9
    rows = np.unique(np.searchsorted(since_s, np.arange(0.0, since_s[-1], 1.0 / rate_hz)))
    columns = {column.name: getattr(frames, column.name)[rows] for column in MEASURED_COLUMNS}
    return replace(recording, frames=FrameBatch(**columns))


def _messages(frames: FrameBatch, schema: pa.Schema, period_ns: int) -> Iterator[Message]:
    for batch in batches(frames):
        # A frame is whole when the next one begins.
        yield Message(
            encode_frames(batch, schema), len(batch), int(batch.t_mono_ns[-1]) + period_ns
        )


class Renumbered:
    """Messages with other numbers and instants: the rest of their bytes is what it was."""

    def __init__(self, played: Played) -> None:
        schema = wire_schema(played.info)
        names = [column.name for column in MEASURED_COLUMNS]
        self._content: dict[int, tuple[bytearray, list[Any], list[Any]]] = {}
        for message in (*played.lead, *played.lap):
            content = bytearray(message.payload)
            layout = check_and_compute_layout(
                pa.ipc.read_message(pa.py_buffer(message.payload)), schema
            )
            views = []
            for name in _NUMBERED:
                at, _ = layout.columns[names.index(name)]
                kind = np.uint64 if name == "seq" else np.int64
                views.append(np.frombuffer(content, kind, message.frames, at))
            self._content[id(message)] = content, views, [view.copy() for view in views]

    def of(self, message: Message, later: int, later_ns: int, utc_offset_ns: int) -> EncodedBatch:
        """The message with its numbers so much higher and its instants so much later."""
        content, views, known = self._content[id(message)]
        shifts: tuple[Any, ...] = (np.uint64(later), later_ns, later_ns + utc_offset_ns)
        for view, values, shift in zip(views, known, shifts, strict=True):
            np.add(values, shift, out=view)
        seq, _, t_ns = views
        ends = int(seq[0]), int(seq[-1]), int(t_ns[0]), int(t_ns[-1])
        return EncodedBatch(*ends, bytes(content))


class ReplayedNode:
    """One node: a stream in memory, and the node's own link."""

    def __init__(self, played: Played, name: str, server: str) -> None:
        self._played = played
        self._utc_offset_ns = time.time_ns() - time.monotonic_ns()
        info = played.info.model_copy(
            update={
                "node": name,
                "stream_id": uuid.uuid4().hex,
                "utc_offset_ns": self._utc_offset_ns,
            }
        )
        nowhere = Path("/nonexistent")
        self.stream = NodeStream(nowhere, StreamNotes(array_info=info), None)
        self._wanted = RetentionRequests(nowhere)
        self.said: list[str] = []
        secret = generate_secret()
        source = NodeCallbacks(
            get_present_stream=lambda: self.stream,
            get_streams=lambda: {self.stream.stream_id: self.stream},
            make_hello=self._hello,
            get_secret=lambda server_id: secret,
            make_status=lambda backlog: NodeStatus(missed_slots=0, backlog_frames=backlog),
            on_retention_request=lambda server_id, wanted, known: None,
            on_damaged_frames=lambda stream, numbers: None,
        )
        self.publisher = Publisher(
            server, source, token=os.environ.get("FOOTTILE_TOKEN"), report=self.said.append
        )
        self.late_ms: list[float] = []
        self._kept: deque[Intervals] = deque()

    def _hello(self) -> Hello:
        return Hello(
            protocol=PROTOCOL,
            array_info=self.stream.info,
            stored=tuple(self.stream.available),
            next_seq=self.stream.next_seq,
            t_mono_ns=time.monotonic_ns(),
            scene=load_scene(SCENE).model_dump(mode="json"),
            emulated=True,
            calibration=self._played.calibration,
            calibration_problem=None,
        )

    async def run(self, renumbered: Renumbered, wait_s: float) -> None:
        """The lead at once, then laps at their pace, until cancelled."""
        played = self._played
        while not self.publisher.is_connected:
            await asyncio.sleep(0.01)
        began_ns = time.monotonic_ns() + round(wait_s * 1e9) - played.lap_begin_ns
        for message in played.lead:
            self._put(renumbered.of(message, 0, began_ns, self._utc_offset_ns))
        lap_frames = sum(message.frames for message in played.lap)
        lap_ns = played.lap_end_ns - played.lap_begin_ns
        later, later_ns = 0, began_ns
        while True:
            for message in played.lap:
                due_ns = message.whole_ns + later_ns
                await asyncio.sleep(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
                self.late_ms.append((time.monotonic_ns() - due_ns) * 1e-6)
                self._put(renumbered.of(message, later, later_ns, self._utc_offset_ns))
            later, later_ns = later + lap_frames, later_ns + lap_ns

    def _put(self, batch: EncodedBatch) -> None:
        self.stream.queue_batch_and_record_gap(batch)
        self.publisher.notify_new_frames()
        # What the server has on its disk is let go of: there is no other place for it here.
        self._kept.append(batch.numbers)
        acked = self.stream.acked
        while self._kept and not self._kept[0] - acked:
            self._kept.popleft()
            self.stream.drop_oldest_waiting_and_record_unacked_loss(EVICTED, self._wanted)


def run_load(played: Played, count: int, server: str, control: Connection) -> None:
    """Body of the load's process: runs until something is sent to it, then says what came of it."""
    control.send(asyncio.run(_load(played, count, server, control)))


async def _load(played: Played, count: int, server: str, control: Connection) -> Sent:
    nodes = [ReplayedNode(played, f"node{i:02d}", server) for i in range(count)]
    renumbered = Renumbered(played)
    publishing = [asyncio.create_task(node.publisher.publish_forever()) for node in nodes]
    # Nodes do not beat together.
    batch_s = 1e-9 * (played.lap_end_ns - played.lap_begin_ns) / len(played.lap)
    taking = [
        asyncio.create_task(node.run(renumbered, 0.1 + batch_s * i / count))
        for i, node in enumerate(nodes)
    ]
    loop = asyncio.get_running_loop()
    stop = loop.run_in_executor(None, control.recv)
    await asyncio.wait([*publishing, *taking, stop], return_when=asyncio.FIRST_COMPLETED)
    for task in taking:
        task.cancel()
    failed = [each for each in await asyncio.gather(*taking, return_exceptions=True) if each]
    failed = [each for each in failed if not isinstance(each, asyncio.CancelledError)]
    end_s = loop.time() + DRAIN_S
    while loop.time() < end_s and any(
        n.stream.acked.number_count < n.stream.next_seq for n in nodes
    ):
        await asyncio.sleep(0.05)
    cpu_s = time.process_time()
    for task in publishing:
        task.cancel()
    await asyncio.gather(*publishing, return_exceptions=True)
    late_ms = np.concatenate([node.late_ms for node in nodes])
    said = [text for node in nodes for text in node.said if not text.startswith("connected")]
    return Sent(
        taken=sum(node.stream.next_seq for node in nodes),
        acknowledged=sum(node.stream.acked.number_count for node in nodes),
        late_ms=float(np.percentile(late_ms, 99)) if len(late_ms) else float("nan"),
        cpu_s=cpu_s,
        said=(*said, *map(repr, failed)),
    )
