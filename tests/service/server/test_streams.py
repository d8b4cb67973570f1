"""What a server makes of a node's streams, in whatever order their frames come, and how often."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.frames import FRAME_COLUMNS, FrameBatch
from service.protocol.link import EarlierStream, Hello
from service.server.node import ServerNode
from storage.intervals import NO_END, Intervals
from storage.schema import wire_schema
from storage.wire import encode_frames
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array
from tests.builders.frames import make_frames
from tests.builders.hello import make_hello

PER_MESSAGE = 5
OLD, NEW = "a" * 32, "b" * 32


def frames(first: int, last: int, boot: str) -> FrameBatch:
    seq = np.arange(first, last + 1)
    return make_frames(
        seq,
        t_mono_ns=seq * PERIOD_NS + (0 if boot == OLD else 10**12),
        pressure_raw=300 + np.stack([seq % 97, seq % 89], axis=1),
    )


class Told:
    """A node as the server knows it, told what a test wants without a socket."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.info = {boot: make_array(stream_id=boot) for boot in (OLD, NEW)}
        self.node: ServerNode
        self.restart()

    def restart(self) -> None:
        if hasattr(self, "node"):
            self.close()
        self.node = ServerNode(self.folder / "node", self.folder / "journal", self.hello())

    def hello(self, **changes: Any) -> Hello:
        facts: dict[str, Any] = {"array_info": self.info[NEW], "t_mono_ns": 10**12}
        return make_hello(**(facts | changes))

    def earlier(self, **changes: Any) -> EarlierStream:
        content: dict[str, Any] = {"array_info": self.info[OLD], "stored": (), "next_seq": 0}
        return EarlierStream(**(content | changes))

    def connect(self, **changes: Any) -> None:
        self.node.apply_checked_hello(self.hello(**changes), UTC_NS)

    def take(self, first: int, last: int, boot: str = NEW) -> list[int]:
        """Numbers whose estimates are due then."""
        payload = encode_frames(frames(first, last, boot), wire_schema(self.info[boot]))
        due = self.node.receive_frames(self.node.streams[boot], payload, UTC_NS)
        return [int(seq) for batch, _ in due for seq in batch.seq]

    def synced(self) -> dict[str, Intervals]:
        """Sync as the server does; what it would acknowledge then."""
        acks = {}
        for boot, stream in self.node.streams.items():
            stream.sync()
            acks[boot], stream.unacked, stream.unsynced = stream.unacked, Intervals(), Intervals()
        return acks

    def lacks(self, **needed: list[tuple[int, int]]) -> dict[str, list[tuple[int, int | None]]]:
        named = {{"old": OLD, "new": NEW}[name]: Intervals(n) for name, n in needed.items()}
        return {
            each.stream_id: [*each.numbers]
            for each in self.node.needed_and_present_frames_to_request(named)
        }

    def close(self) -> None:
        for stream in self.node.streams.values():
            if stream.journal is not None:
                stream.journal.close()


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    one = Told(tmp_path)
    yield one
    one.close()


messages = st.tuples(st.sampled_from([OLD, NEW]), st.integers(0, 7))


@settings(max_examples=25, deadline=None)
@given(
    order=st.permutations([(boot, n) for boot in (OLD, NEW) for n in range(8)]),
    again=st.lists(messages, max_size=8),
    breaks=st.sets(st.integers(0, 23), max_size=4),
    restarts=st.sets(st.integers(0, 23), max_size=2),
)
def test_frames_of_two_streams_in_any_order_and_any_number_of_times_are_each_held_once(
    order: list[tuple[str, int]],
    again: list[tuple[str, int]],
    breaks: set[int],
    restarts: set[int],
) -> None:
    with TemporaryDirectory() as folder:
        told = Told(Path(folder))
        total = 8 * PER_MESSAGE
        whole = ((0, total - 1),)
        shown: list[int] = []
        sent = {OLD: Intervals(), NEW: Intervals()}
        acked = {OLD: Intervals(), NEW: Intervals()}

        def connect() -> None:
            told.connect(
                stored=whole,
                next_seq=total,
                earlier=(told.earlier(stored=whole, next_seq=total),),
            )
            lacks = told.lacks(old=[(0, NO_END)])
            for boot in (OLD, NEW):
                missing = [*Intervals(whole) - sent[boot]]
                if boot == NEW:  # nothing beyond what the node has taken is here yet
                    joined = [*Intervals([*missing, (total, NO_END)])]
                    missing = [(a, None if b == NO_END else b) for a, b in joined]
                assert lacks.get(boot, []) == missing

        def note_acks() -> None:
            for boot, numbers in told.synced().items():
                for interval in numbers:
                    acked[boot].add(*interval)

        connect()
        for step, (boot, n) in enumerate([*order, *again]):
            if step in restarts:
                told.restart()
                shown = []
            if step in restarts or step in breaks:
                connect()
            first, last = n * PER_MESSAGE, (n + 1) * PER_MESSAGE - 1
            shown += told.take(first, last, boot)
            sent[boot].add(first, last)
            assert shown == sorted(set(shown)), "the live picture never goes back"
            if step % 3 == 0:
                note_acks()
        note_acks()
        for boot in (OLD, NEW):
            journal = told.node.streams[boot].journal
            assert journal is not None
            assert journal.stored == Intervals(whole)
            assert acked[boot] == Intervals(whole)
            found = FrameBatch.concatenate(list(journal.read_frames(0, total)))
            for name in FRAME_COLUMNS:
                np.testing.assert_array_equal(
                    getattr(found, name), getattr(frames(0, total - 1, boot), name)
                )
        assert told.node.present_stream_lost_by_reason == {}
        assert told.node.present_stream_backlog_frames == 0
        told.close()


def test_missing_frames_are_backlog_until_the_node_has_lost_them(told: Told) -> None:
    told.connect(stored=((0, 99),), next_seq=100)
    told.take(100, 104)
    assert told.node.present_stream_backlog_frames == 100
    assert told.node.present_stream_lost_by_reason == {}
    told.node.present_stream.set_node_losses({"evicted": ((0, 9),), "disk_full": ((20, 24),)})
    assert told.node.present_stream_lost_by_reason == {"evicted": 10, "disk_full": 5}
    assert told.node.present_stream_backlog_frames == 85
    told.take(50, 54)
    assert told.node.present_stream_backlog_frames == 80


def test_a_loss_that_came_all_the_same_is_none(told: Told) -> None:
    told.connect(stored=((0, 9),), next_seq=10)
    told.take(0, 9)
    told.node.present_stream.set_node_losses({"disk_full": ((5, 6),)})
    assert told.node.present_stream_lost_by_reason == {}


def test_frames_from_before_the_server_knew_the_node_are_not_lost(told: Told) -> None:
    told.connect(stored=((500, 599),), next_seq=600)
    told.take(500, 599)
    told.take(600, 609)
    assert told.node.present_stream_lost_by_reason == {}


def test_what_was_deleted_because_nobody_needs_it_is_not_lost_even_after_a_restart(
    told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.server.node.RING_DURATION_NS", 20 * PERIOD_NS)
    monkeypatch.setattr("storage.journal.segment_writer.SEGMENT_DURATION_NS", 10 * PERIOD_NS)
    told.connect()
    for n in range(0, 100, 5):
        told.take(n, n + 4)
    told.synced()
    told.node.delete_old_frames_and_up_to_one_ended_journal({NEW: Intervals([(10, 12)])})
    held = told.node.present_stream.stored
    assert held.missing_in(10, 12).number_count == 0
    assert held.missing_in(0, 99).number_count > 50
    assert told.node.present_stream_lost_by_reason == {}
    # It is not asked for again either, but what a session needs is.
    told.connect(stored=((0, 99),), next_seq=100)
    assert told.lacks() == {NEW: [(100, None)]}
    assert told.lacks(new=[(30, 39)]) == {NEW: [(30, 39), (100, None)]}
    told.restart()
    told.connect(stored=((100, 104),), next_seq=105)
    told.take(105, 109)
    assert told.node.present_stream_lost_by_reason == {}


def test_frames_that_no_session_needs_are_acknowledged_before_they_are_deleted(told: Told) -> None:
    told.connect(earlier=(told.earlier(stored=((0, 4),), next_seq=5),))
    told.take(0, 4, OLD)
    assert not told.node.delete_old_frames_and_up_to_one_ended_journal({})
    assert told.synced()[OLD] == Intervals([(0, 4)])
    assert told.node.delete_old_frames_and_up_to_one_ended_journal({})
    told.take(0, 4, OLD)
    told.node.storage_problem = "the disk is full"
    assert told.node.delete_old_frames_and_up_to_one_ended_journal({})  # it makes room


def test_of_the_present_stream_all_is_asked_for_and_what_sessions_need_first(told: Told) -> None:
    told.connect(stored=((0, 99),), next_seq=100)
    assert told.lacks() == {NEW: [(0, None)]}
    assert told.lacks(new=[(40, 49)]) == {NEW: [(40, 49), (0, 39), (50, None)]}
    assert told.lacks(new=[(40, NO_END)]) == {NEW: [(40, 99), (0, 39), (100, None)]}
    told.take(0, 59)
    assert told.lacks(new=[(40, NO_END)]) == {NEW: [(60, None)]}


def test_of_earlier_streams_only_what_sessions_need_and_the_node_has_is_asked_for(
    told: Told,
) -> None:
    told.connect(earlier=(told.earlier(stored=((0, 49), (60, 99)), next_seq=100),))
    assert told.lacks() == {NEW: [(0, None)]}
    told.take(70, 74, OLD)
    asked = told.lacks(old=[(40, NO_END)])
    assert asked == {OLD: [(40, 49), (60, 69), (75, 99)], NEW: [(0, None)]}


def test_frames_of_an_earlier_stream_are_kept_and_never_shown(told: Told) -> None:
    told.connect(earlier=(told.earlier(stored=((0, 9),), next_seq=10),))
    assert told.take(0, 4) == [0, 1, 2, 3, 4]
    assert told.take(5, 9, OLD) == []
    assert told.node.last_seq == 4
    assert (journal := told.node.streams[OLD].journal) is not None
    assert journal.stored == Intervals([(5, 9)])


def test_a_stream_can_come_until_the_node_does_not_mention_it(told: Told) -> None:
    told.connect(earlier=(told.earlier(stored=((0, 9),), next_seq=10),))
    told.take(0, 4, OLD)
    assert told.node.streams[OLD].obtainable == Intervals([(0, 9)])
    told.synced()
    told.restart()  # a new server has heard nothing
    assert told.node.streams[OLD].obtainable == Intervals([(0, NO_END)])
    told.connect()
    assert not told.node.streams[OLD].obtainable
    told.connect(earlier=(told.earlier(stored=((0, 9),), next_seq=10),))
    assert told.node.streams[OLD].obtainable == Intervals([(0, 9)])
    told.connect()  # to the same server as before
    assert not told.node.streams[OLD].obtainable


def test_what_the_node_said_of_a_stream_outlives_the_server(told: Told) -> None:
    said = told.earlier(
        stored=((0, 9),),
        next_seq=12,
        lost={"disk_full": ((10, 11),)},
        max_lost_tail_frames=280,
        missed_slots=3,
    )
    told.connect(earlier=(said,), lost={"evicted": ((0, 4),)}, next_seq=20, stored=((5, 19),))
    told.take(0, 4, OLD)
    told.take(5, 9)
    told.synced()
    told.restart()
    notes = told.node.streams[OLD].notes
    assert (notes.next_seq, notes.max_lost_tail_frames, notes.missed_slots) == (12, 280, 3)
    assert notes.lost == {"disk_full": ((10, 11),)}
    present = told.node.present_stream.notes
    assert (present.next_seq, present.lost) == (None, {"evicted": ((0, 4),)})


def test_what_was_damaged_here_is_known_after_a_restart_until_it_comes_again(told: Told) -> None:
    told.connect(stored=((0, 9),), next_seq=10)
    told.take(0, 4)
    told.take(5, 9)
    stream = told.node.present_stream
    stream.invalidate(Intervals([(0, 4)]), are_corrupt=True)
    assert not stream.lost
    told.connect(stored=((5, 9),), next_seq=10)  # the node has them no more
    assert stream.lost.to_pairs() == {"corrupt": ((0, 4),)}
    told.synced()
    told.restart()
    assert told.node.streams[NEW].make_session_stream().damaged == Intervals([(0, 4)])
    told.connect(stored=((0, 9),), next_seq=10)
    told.take(0, 4)
    told.synced()
    told.restart()
    assert not told.node.streams[NEW].make_session_stream().damaged


def test_slots_that_a_killed_node_has_forgotten_are_still_counted(told: Told) -> None:
    told.connect(stored=((0, 9),), next_seq=10)
    stream = told.node.present_stream
    stream.missed_slots = 4
    stream.apply_end_report(told.earlier(stored=((0, 9),), next_seq=10, missed_slots=0))
    assert (stream.missed_slots, stream.notes.missed_slots) == (4, 4)
    stream.apply_end_report(told.earlier(stored=((0, 9),), next_seq=10, missed_slots=5))
    assert (stream.missed_slots, stream.notes.missed_slots) == (5, 5)


@settings(max_examples=40, deadline=None)
@given(
    order=st.permutations(range(8)),
    at=st.integers(-3, 8 * PER_MESSAGE + 3),
    at_least=st.integers(0, 8 * PER_MESSAGE),
    lost=st.integers(0, 7),
)
def test_what_is_held_next_to_an_instant_is_the_same_whether_it_was_asked_before_or_not(
    order: list[int], at: int, at_least: int, lost: int
) -> None:
    with TemporaryDirectory() as folder:
        told = Told(Path(folder))
        told.connect(stored=((0, 8 * PER_MESSAGE - 1),), next_seq=8 * PER_MESSAGE)
        t_ns = UTC_NS + 10**12 + at * PERIOD_NS
        sent = Intervals()
        for n in order:
            if n == lost:
                continue
            told.take(n * PER_MESSAGE, (n + 1) * PER_MESSAGE - 1)
            sent.add(n * PER_MESSAGE, (n + 1) * PER_MESSAGE - 1)
            stream = told.node.present_stream
            found = stream.make_session_stream().find_seqs_around(t_ns, min_seq=at_least)
            held = [seq for a, b in sent for seq in range(a, b + 1) if seq >= at_least]
            until = max((seq for seq in held if seq <= at), default=at_least - 1)
            after = min((seq for seq in held if seq > at), default=None)
            assert found == (None if after is None else (until, after))
            # While frames in between may come, it may answer as before, but says that they lack.
            lazy = stream.make_session_stream().find_seqs_around(
                t_ns, min_seq=at_least, may_be_stale=True
            )
            assert (lazy is None) == (found is None)
            if lazy is not None and lazy != found:
                assert stream.obtainable.restricted_to(lazy[0] + 1, lazy[1] - 1)
        told.close()
