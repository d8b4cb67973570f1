"""A recording goes on in a stream that comes back, and leaves out nothing that is here."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.sessions.lifecycle import Abandon, Reevaluate, Stop, apply_event, create_session
from storage.intervals import Intervals
from storage.sessions.folder import Part, Session
from storage.sessions.ledger import group_numbers_by_stream
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running
from tests.service.server.test_streams import NEW, OLD, Told

PIECE = 5


class Recorded:
    """A recording of a node whose place a copy of it takes now and then."""

    def __init__(self, told: Told) -> None:
        self.told = told
        self.taken = {NEW: 0, OLD: 0}
        self.told.connect()
        self.send(NEW)
        self.session: Session = create_session(
            told.info[NEW],
            "trial",
            Part(stream_id=NEW, seq_first=0),
            scene_content={},
            calibration=None,
            calibration_source="node",
        )

    def send(self, stream_id: str) -> None:
        first = self.taken[stream_id]
        self.taken[stream_id] += PIECE
        self.told.take(first, first + PIECE - 1, stream_id)

    def connect(self, stream_id: str) -> None:
        """The node connects with its one stream, or its copy with another one."""
        seq = self.taken[stream_id]
        self.told.connect(
            array_info=self.told.info[stream_id],
            stored=((0, seq - 1),) if seq else (),
            next_seq=seq,
        )
        self.follow()

    def follow(self) -> None:
        facts = self.told.node.make_session_facts()
        self.session = apply_event(self.session, Reevaluate(), facts).session


@settings(max_examples=60, deadline=None)
@given(
    happened=st.lists(st.sampled_from(["node", "copy", "frames", "server restarts"]), max_size=12)
)
def test_a_session_has_all_frames_of_each_stream_that_it_was_in(happened: list[str]) -> None:
    with TemporaryDirectory() as folder:
        told = Told(Path(folder))
        recorded = Recorded(told)
        present = NEW
        for what in [*happened, "node", "frames"]:
            if what == "frames":
                recorded.send(present)
            elif what == "server restarts":
                told.synced()
                told.restart()
                recorded.connect(present)
            else:
                present = {"node": NEW, "copy": OLD}[what]
                recorded.connect(present)
        assert recorded.session.parts[-1] == Part(
            stream_id=NEW, seq_first=recorded.session.parts[-1].seq_first
        )
        facts = told.node.make_session_facts()
        stopped = apply_event(recorded.session, Stop(), facts).session
        sealed = apply_event(stopped, Abandon(), facts).session
        parts = group_numbers_by_stream(sealed.parts)
        for stream_id, stream in told.node.streams.items():
            if stream_id in parts:
                assert not stream.stored - parts[stream_id], stream_id
        held = told.node.streams[NEW].stored
        assert parts[NEW] == held == Intervals([(0, recorded.taken[NEW] - 1)])
        # No number twice.
        for stream_id, numbers in parts.items():
            own = [part for part in sealed.parts if part.stream_id == stream_id]
            lengths = [(part.seq_last or 0) - part.seq_first + 1 for part in own]
            assert numbers.number_count == sum(lengths)
        told.close()


def test_a_copy_that_sent_nothing_leaves_no_trace(tmp_path: Path) -> None:
    told = Told(tmp_path)
    recorded = Recorded(told)
    recorded.connect(OLD)
    assert [part.stream_id for part in recorded.session.parts] == [NEW, OLD]
    recorded.connect(NEW)
    assert recorded.session.parts == (Part(stream_id=NEW, seq_first=0),)
    assert recorded.session.max_lost_tail_frames == {}
    told.close()


def test_a_stream_that_did_not_come_back_is_gone_on_from_as_ever(tmp_path: Path) -> None:
    """The node was switched on anew, and remembers its streams: nothing is attached again."""
    told = Told(tmp_path)
    recorded = Recorded(told)
    said = told.earlier(array_info=told.info[NEW], stored=((0, 4),), next_seq=5)
    told.connect(array_info=told.info[OLD], earlier=(said,))
    recorded.follow()
    assert recorded.session.parts == (
        Part(stream_id=NEW, seq_first=0, seq_last=4),
        Part(stream_id=OLD, seq_first=0),
    )
    recorded.follow()
    assert len(recorded.session.parts) == 2
    told.close()


@pytest.mark.parametrize("copy_frames", [0, 40])
def test_a_recording_survives_a_copy_that_took_its_nodes_place(
    running: Running, tared: FakeNode, node_of: NodeOf, copy_frames: int
) -> None:
    session = tared.record()
    tared.deliver(50)
    tared.leave()
    missed = tared.frames(30)
    copy = node_of(running, secret=tared.secret)
    copy.next_t_mono_ns = tared.next_t_mono_ns
    copy.connect()
    if copy_frames:
        copy.deliver(copy_frames)
    copy.leave()
    assert tared.connect() == [(120, None)]
    tared.send_again(missed)
    tared.deliver(20)
    sealed = tared.finish(session)
    assert sealed["frames"] == 100 + copy_frames
    assert sealed["lost"] == {}
    found = group_numbers_by_stream([Part.model_validate(part) for part in sealed["parts"]])
    assert found[tared.stream_id] == Intervals([(70, 169)])
    if not copy_frames:
        assert sealed["complete"] is True
        assert len(sealed["parts"]) == 1
