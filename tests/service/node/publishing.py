"""A publisher that runs while a block of a test does, and its checks."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from service.node.frame_sender import NodeCallbacks
from service.node.publisher import Publisher
from service.protocol.link import EarlierStream, Hello, NodeStatus, RetentionMessage
from storage.intervals import Intervals
from storage.journal.node.stream import NodeStream
from storage.journal.stream_notes import StreamNotes
from storage.wire import EncodedBatch
from tests.service.fake_node import FakeNode
from tests.service.running import Running
from tests.tokens import SHARED_TOKEN
from tests.waiting import PATIENCE_S


class Publishing:
    """A publisher that runs while a test's block does, with a fake node as its source of frames."""

    def __init__(
        self,
        node: FakeNode,
        server: str,
        token: str = SHARED_TOKEN,
        earlier: Sequence[NodeStream] = (),
        ca: Path | None = None,
    ) -> None:
        self.node = node
        self.stream = NodeStream(Path("nowhere"), StreamNotes(array_info=node.info), None)
        self.earlier = tuple(earlier)
        self.reports: list[str] = []
        self.wanted: list[tuple[str, RetentionMessage, tuple[str, ...]]] = []
        self.behind: list[int] = []
        self.damaged: list[Intervals] = []
        self.publisher = Publisher(
            server,
            NodeCallbacks(
                get_present_stream=lambda: self.stream,
                get_streams=lambda: {s.stream_id: s for s in (*self.earlier, self.stream)},
                make_hello=self._hello,
                get_secret=lambda server_id: node.secret,
                make_status=self._status,
                on_retention_request=lambda *said: self.wanted.append(said),
                on_damaged_frames=lambda stream, numbers: self.damaged.append(numbers),
            ),
            token=token,
            report=self.reports.append,
            ca_path=ca,
        )

    async def __aenter__(self) -> Publishing:
        self._before = asyncio.all_tasks()
        self._task = asyncio.create_task(self.publisher.publish_forever())
        return self

    async def __aexit__(self, *_: object) -> None:
        assert not self._task.done(), self._task
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        await self.until(lambda: asyncio.all_tasks() <= self._before)

    def take(self, n: int) -> None:
        for batch in batches(self.node, n):
            self.stream.queue_batch_and_record_gap(batch, 0)
        self.publisher.notify_new_frames()

    async def until(self, condition: Callable[[], object], timeout_s: float = PATIENCE_S) -> None:
        end_s = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end_s, (self.reports, self.stream.acked)
            await asyncio.sleep(0.005)

    async def emptied(self) -> None:
        await self.until(lambda: self.stream.acked.number_count == self.stream.next_seq)

    def _hello(self) -> Hello:
        hello: Hello = self.node.hello(
            stored=tuple(self.stream.available),
            next_seq=self.stream.next_seq,
            lost=self.stream.lost.to_pairs(),
            earlier=tuple(
                EarlierStream(array_info=s.info, stored=tuple(s.available), next_seq=s.next_seq)
                for s in self.earlier
            ),
        )
        return hello

    def _status(self, behind: int) -> NodeStatus:
        self.behind.append(behind)
        return NodeStatus(missed_slots=0, backlog_frames=behind)


def batches(node: FakeNode, n: int) -> list[EncodedBatch]:
    frames = node.frames(n)
    return [
        EncodedBatch.from_frames_and_payload(rows, node.payload(rows))
        for rows in (frames.slice_rows(begin, begin + 10) for begin in range(0, n, 10))
    ]


def assert_all_arrived(running: Running, node: FakeNode) -> None:
    found = np.concatenate([b.seq for b in running.journal(node.stream_id).read_frames(0, 2**61)])
    np.testing.assert_array_equal(found, np.arange(node.seq))
