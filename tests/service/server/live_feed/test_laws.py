"""What holds for readers of every frame, in whatever order things happen to node, link and server.

A reader counts every number of every stream from its first frame on once: as a frame, or as left
out. `lossless` leaves out only what cannot be had.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import ClassVar

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from service.protocol.codec import CloseConnection, LinkCloseCode
from service.protocol.live import Policy
from service.server.live_feed.events import FeedEvent, FrameRows, Gap, Position, StreamStart
from tests.service.server.live_feed.world import LOST, WAITING, World, bits

few = st.integers(1, 30)


class Reading(RuleBasedStateMachine):
    """A reader that goes on from its position whenever its connection ends."""

    policy: ClassVar[Policy]

    @initialize(is_recording=st.booleans(), is_from_the_first=st.booleans())
    def begin(self, is_recording: bool, is_from_the_first: bool) -> None:
        self.closing = contextlib.ExitStack()
        folder = self.closing.enter_context(TemporaryDirectory())
        self.world = World(Path(folder), is_recording=is_recording)
        self.closing.callback(self.world.close)
        self.position = Position(self.world.stream_id, 0) if is_from_the_first else None
        self.resume()

    @rule(n=few)
    def frames_come(self, n: int) -> None:
        self.world.send_newest(n)

    @rule(n=few)
    def frames_are_late(self, n: int) -> None:
        self.world.take(n)

    @rule(n=few)
    def frames_are_lost(self, n: int) -> None:
        self.world.lose(n)

    @rule()
    def late_frames_come(self) -> None:
        self.world.send_lacking()

    @rule()
    def the_link_breaks(self) -> None:
        self.world.leave()

    @rule()
    def the_node_connects(self) -> None:
        self.world.connect()

    @precondition(lambda self: len(self.world.streams) < 5)
    @rule()
    def the_node_is_switched_on_again(self) -> None:
        self.world.reboot()

    @rule(comes_back=st.booleans())
    def the_server_is_restarted(self, comes_back: bool) -> None:
        self.world.restart()
        if comes_back:
            self.world.connect()
        self.resume()

    @rule()
    def memory_is_short(self) -> None:
        self.world.forget()

    @rule()
    def what_nobody_needs_is_deleted(self) -> None:
        self.world.prune()

    @rule()
    def the_reader_comes_back(self) -> None:
        self.resume()

    @rule(share=st.floats(0.0, 1.0))
    def its_connection_breaks_in_the_middle_of_frames(self, share: float) -> None:
        item = self.read()
        if isinstance(item, FrameRows):
            had = round(share * (item.last_seq + 1 - item.first_seq))
            self.position = Position(item.stream_id, item.first_seq + had)
        self.resume()

    @rule(n=st.integers(1, 4))
    def the_reader_reads(self, n: int) -> None:
        for _ in range(n):
            self.read()

    def resume(self) -> None:
        self.reader = self.world.reader(self.policy, self.position)

    def read(self) -> FeedEvent | None:
        try:
            item: FeedEvent | None = self.world.read(self.reader)
        except CloseConnection as end:
            if end.code != LinkCloseCode.TOO_SLOW or end.reason != f"too slow; {self.position}":
                raise
            self.resume()
            return self.read()
        match item:
            case None:
                return None
            case StreamStart(stream_id=stream_id, first_seq=seq):
                assert seq == 0
                self.go_over_to(stream_id)
            case _:
                if self.position is None:
                    self.position = Position(item.stream_id, item.first_seq)
                while self.position.stream_id != item.stream_id:
                    self.go_over_to(self.following())
                assert item.first_seq == self.position.seq
                self.position = Position(item.stream_id, item.last_seq + 1)
                self.check(item)
        return item

    def check(self, item: FrameRows | Gap) -> None:
        """Frames are those that were taken, with what was published live."""
        if isinstance(item, Gap):
            assert item.first_seq <= item.last_seq
            self.check_missing(item)
            return
        frames, columns = item.batch
        taken = self.world.streams[item.stream_id].frames(item.first_seq, item.last_seq)
        np.testing.assert_array_equal(frames.seq, taken.seq)
        np.testing.assert_array_equal(frames.pressure_raw, taken.pressure_raw)
        assert item.is_recomputed <= (self.policy == "lossless")
        for row, seq in enumerate(frames.seq.tolist()):
            if item.is_recomputed:
                assert self.world.memory.find_batch(item.stream_id, seq) is None
            else:
                assert self.world.published[item.stream_id, seq] == bits(columns, row)

    def check_missing(self, item: Gap) -> None:
        """Who would rather have what is new is told what was left out for that."""
        assert item.reason in ("slow", "late")
        assert item.last_seq < self.world.streams[item.stream_id].taken

    def following(self) -> str:
        """The stream after that of the position."""
        assert self.position is not None
        names = list(self.world.streams)
        return names[names.index(self.position.stream_id) + 1]

    def go_over_to(self, stream_id: str) -> None:
        """Every number of the stream before is counted."""
        assert self.position is not None
        assert stream_id == self.following()
        assert self.position.seq == self.world.streams[self.position.stream_id].taken
        self.position = Position(stream_id, 0)

    def teardown(self) -> None:
        """In the end everything comes that can, and the reader gets to it."""
        try:
            world = self.world
            world.connect()
            world.send_lacking()
            world.send_newest(12)
            world.send_newest(12)
            while self.read() is not None:
                pass
            if self.position is not None:
                assert self.position.stream_id == world.stream_id
                assert self.position.seq >= world.present.taken - WAITING
        finally:
            self.closing.close()


class Lossless(Reading):
    """Every frame that can be had."""

    policy = "lossless"

    def check_missing(self, item: Gap) -> None:
        world, stream = self.world, self.world.streams[item.stream_id]
        numbers = range(item.first_seq, item.last_seq + 1)
        if item.reason == LOST:
            assert all(stream.lost.restricted_to(seq, seq) for seq in numbers)
        else:  # of a stream that is over, and of which nobody needs the rest
            assert item.reason == "not_kept"
            assert not world.is_recording
            assert item.stream_id != world.node.stream_id
            kept = world.node.streams[item.stream_id].stored
            assert not kept.restricted_to(item.first_seq, item.last_seq)
            assert not stream.lost.restricted_to(item.first_seq, item.last_seq)


class DropOldest(Reading):
    """What is here, and not what is older than the queue."""

    policy = "drop_oldest"


class Latest(Reading):
    """The newest piece."""

    policy = "latest"


TestLossless = Lossless.TestCase
TestLossless.settings = settings(max_examples=25, stateful_step_count=30)
TestDropOldest = DropOldest.TestCase
TestDropOldest.settings = settings(max_examples=12, stateful_step_count=30)
TestLatest = Latest.TestCase
TestLatest.settings = settings(max_examples=12, stateful_step_count=30)
