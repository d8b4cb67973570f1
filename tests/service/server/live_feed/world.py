"""A node, the server's side of it and one reader, moved step by step without a socket.

The node takes frames; they come at once, late or never, over a link that breaks; node and server
are switched on again whenever a test wants. Everything but the link is the product's own.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from devices.arrays import Ints
from devices.errors import DamagedFramesError
from devices.frames import ArrayInfo, FrameBatch
from service.estimation.calibration import Calibration
from service.estimation.records import ColumnDict
from service.protocol.link import EarlierStream, Hello
from service.protocol.live import Policy
from service.server.live_feed.buffer import FeedBuffer
from service.server.live_feed.events import Position
from service.server.live_feed.reader import FeedReader
from service.server.node import ServerNode
from storage.intervals import NO_END, Intervals
from storage.schema import wire_schema
from storage.wire import encode_frames
from tests.builders.arrays import COUNT_KPA, PERIOD_NS, UNLOADED_KPA, UTC_NS, make_array
from tests.builders.calibrations import make_calibration, make_tare
from tests.builders.frames import make_frames
from tests.builders.hello import make_hello

LOST = "disk_full"
WAITING = 6
"""At most so many frames wait for their look-ahead of 10 ms."""


@dataclass
class Taken:
    """A stream as its node knows it."""

    info: ArrayInfo
    begin_t_mono_ns: int
    taken: int = 0
    lost: Intervals = field(default_factory=Intervals)
    counts: Callable[[Ints], Ints] = lambda seq: (
        470 + np.stack([(7 * seq) % 31, (11 * seq) % 29], 1)
    )
    """Counts of both tiles by number; they tell stream and number."""
    forgotten: int = 0
    """So many of the first it has not any more, for the server has them."""

    @property
    def held(self) -> Intervals:
        """What the node can give."""
        kept = Intervals([(self.forgotten, self.taken - 1)] if self.taken > self.forgotten else [])
        return kept - self.lost

    def frames(self, first: int, last: int) -> FrameBatch:
        """Frames by their numbers."""
        seq = np.arange(first, last + 1)
        t_mono_ns = self.begin_t_mono_ns + PERIOD_NS * seq
        return make_frames(seq, t_mono_ns=t_mono_ns, pressure_raw=self.counts(seq))


class World:
    """A node and its server, in a folder; it begins connected.

    Args:
        folder: of the server.
        is_recording: do sessions need every frame of every stream?
        array: facts of its array.
    """

    def __init__(self, folder: Path, *, is_recording: bool = True, **array: Any) -> None:
        self._array = array
        self.folder = folder
        self.is_recording = is_recording
        self.streams: dict[str, Taken] = {}
        """By stream_id, oldest first."""
        self.published: dict[tuple[str, int], tuple[float, ...]] = {}
        """What live estimates have given since the server was started, by stream and number."""
        self.node: ServerNode
        self.memory: FeedBuffer
        self._loop = asyncio.Runner()
        self._is_there = False
        self.calibration: Calibration | None = make_calibration("T01", "T02")
        self._boot()
        self.start()
        self.tare(UTC_NS - 1)
        self.connect()

    @property
    def present(self) -> Taken:
        """The stream that the node takes now."""
        return next(reversed(self.streams.values()))

    @property
    def stream_id(self) -> str:
        """Its name."""
        return self.present.info.stream_id

    def close(self) -> None:
        self._end_server()
        self._loop.close()

    # --- the node ---------------------------------------------------------------------------------

    def take(self, n: int) -> None:
        """The node takes frames, and keeps them for now."""
        self.present.taken += n

    def lose(self, n: int) -> None:
        """It takes frames and loses them."""
        first = self.present.taken
        self.present.taken += n
        self.present.lost.add(first, first + n - 1)
        if self._is_there:
            self.node.present_stream.set_node_losses({LOST: tuple(self.present.lost)})

    def send_newest(self, n: int) -> None:
        """It takes frames, which come at once if the link is there."""
        first = self.present.taken
        self.take(n)
        if self._is_there:
            self._send(self.present, first, first + n - 1)

    def send(self, first: int, last: int) -> None:
        """It sends frames of the present stream."""
        self._send(self.present, first, last)

    def send_lacking(self) -> None:
        """It sends all that the server has asked for, the present stream's last."""
        if not self._is_there:
            return
        for each in self.node.needed_and_present_frames_to_request(self.needed()):
            stream = self.streams[each.stream_id]
            wanted = Intervals((a, NO_END if b is None else b) for a, b in each.numbers)
            for first, last in wanted & stream.held:
                for begin in range(first, last + 1, 10):
                    self._send(stream, begin, min(last, begin + 9))

    def reboot(self) -> None:
        """It is switched off and on again, and connects if it was connected."""
        self._boot()
        if self._is_there:
            self.connect()

    def forget_sent(self, n: int) -> None:
        """It has only what it took after its first `n` frames."""
        self.present.forgotten = n

    def payload(self, first: int, last: int) -> bytes:
        """It takes frames of the present stream up to `last`; the message of some."""
        self.present.taken = last + 1
        return encode_frames(self.present.frames(first, last), wire_schema(self.present.info))

    def _boot(self) -> None:
        number = len(self.streams)
        info = make_array(stream_id=f"{number:032x}", **self._array)
        self.streams[info.stream_id] = Taken(info, begin_t_mono_ns=number * 10**12)

    def _send(self, stream: Taken, first: int, last: int) -> None:
        stream_id = stream.info.stream_id
        payload = encode_frames(stream.frames(first, last), wire_schema(stream.info))
        due = self.node.receive_frames(self.node.streams[stream_id], payload, UTC_NS)
        self.memory.add_batches(self.node.stream_id, due)
        for frames, columns in due:
            for at, seq in enumerate(frames.seq.tolist()):
                self.published[stream_id, seq] = bits(columns, at)

    # --- the server -------------------------------------------------------------------------------

    def start(self) -> None:
        """The server is started; the node is away."""
        self.node = ServerNode(self.folder / "node", self.folder / "journal", self._hello())
        self.memory = FeedBuffer(asyncio.Semaphore(1))
        self.published.clear()
        self._is_there = False

    def restart(self) -> None:
        """It is stopped and started; the node is away."""
        self._end_server()
        self.start()

    def _end_server(self) -> None:
        self.node.save_hello()
        for stream in self.node.streams.values():
            stream.close()

    def tare(self, t_ns: int, counts: int = 0) -> None:
        """A tare is taken at this instant of the node's UTC, of a foot that bears so much."""
        tare = make_tare(t_ns=t_ns, baseline_kpa=UNLOADED_KPA + counts * COUNT_KPA)
        self.node.estimator.tare_history.store_tare_in_force(tare, self.present.info)
        self.node.estimator.live.set_tare(tare)

    def connect(self) -> None:
        """The node connects."""
        self.node.apply_checked_hello(self._hello(), UTC_NS)
        self._is_there = True

    def leave(self) -> None:
        """The link breaks."""
        self._is_there = False

    def forget(self) -> None:
        """The server's memory has room for the newest piece only."""
        self.memory._bytes_max = 1
        self.memory.add_batches(self.node.stream_id, [])

    def prune(self) -> None:
        """It deletes what nobody needs."""
        while self.node.delete_old_frames_and_up_to_one_ended_journal(self.needed()):
            pass

    def needed(self) -> Mapping[str, Intervals]:
        """What sessions need."""
        everything = Intervals([(0, NO_END)])
        return dict.fromkeys(self.streams, everything) if self.is_recording else {}

    def _hello(self) -> Hello:
        def said(each: Taken) -> dict[str, Any]:
            return {
                "array_info": each.info,
                "stored": tuple(each.held),
                "next_seq": each.taken,
                "lost": {LOST: tuple(each.lost)} if each.lost else {},
                "t_ns_first": UTC_NS + each.begin_t_mono_ns if each.held else 0,
            }

        *earlier, present = self.streams.values()
        told_before = tuple(EarlierStream(**said(each)) for each in earlier)
        facts: dict[str, Any] = {
            "t_mono_ns": 10**15,
            "scene": {"auto_tare": False},
            "earlier": told_before,
        }
        return make_hello(calibration=self.calibration, **facts, **said(present))

    # --- readers ----------------------------------------------------------------------------------

    def reader(self, policy: Policy, position: Position | None) -> FeedReader:
        """One who reads from here on."""

        def damaged(error: DamagedFramesError) -> None:
            if error.where:
                stream = self.node.streams[Path(error.where).parent.name]
                stream.invalidate(Intervals([(error.seq_first, error.seq_last)]), are_corrupt=True)

        return FeedReader(
            self.node,
            self.memory,
            policy,
            position,
            needed_frames=self.needed,
            invalidate_damaged=damaged,
        )

    def read(self, reader: FeedReader) -> Any:
        """What it is given next; None: nothing yet."""
        return self._loop.run(reader.next_event())


def bits(columns: ColumnDict, row: int) -> tuple[float, ...]:
    """Estimates of a frame; equal if their bits are, or both are not known."""
    values = [np.atleast_1d(columns[name][row]) for name in sorted(columns)]
    return tuple(
        -1.0 if value != value else float(value) for one in values for value in one.tolist()
    )
