"""A recording goes on in a stream that comes back, and leaves out nothing that is here."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.server.following import followed, given_up
from service.sessions.begin import begun
from storage.intervals import Intervals
from storage.sessions.folder import Part, Session
from storage.sessions.ledger import numbers_of
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
        self.session: Session = begun(
            told.info[NEW],
            "trial",
            Part(boot_id=NEW, seq_first=0),
            scene_content={},
            calibration=None,
            calibration_source="node",
        )

    def send(self, boot_id: str) -> None:
        first = self.taken[boot_id]
        self.taken[boot_id] += PIECE
        self.told.take(first, first + PIECE - 1, boot_id)

    def connect(self, boot_id: str) -> None:
        """The node connects with its one stream, or its copy with another one."""
        seq = self.taken[boot_id]
        self.told.connect(
            array_info=self.told.info[boot_id], held=((0, seq - 1),) if seq else (), next_seq=seq
        )
        self.follow()

    def follow(self) -> None:
        self.session = followed(self.session, self.told.node)[0]


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
            boot_id=NEW, seq_first=recorded.session.parts[-1].seq_first
        )
        sealed = given_up(recorded.session, told.node)
        parts = numbers_of(sealed.parts)
        for boot_id, stream in told.node.streams.items():
            if boot_id in parts:
                assert not stream.held - parts[boot_id], boot_id
        held = told.node.streams[NEW].held
        assert parts[NEW] == held == Intervals([(0, recorded.taken[NEW] - 1)])
        # No number twice.
        for boot_id, numbers in parts.items():
            own = [part for part in sealed.parts if part.boot_id == boot_id]
            lengths = [(part.seq_last or 0) - part.seq_first + 1 for part in own]
            assert numbers.count == sum(lengths)
        told.close()


def test_a_copy_that_sent_nothing_leaves_no_trace(tmp_path: Path) -> None:
    told = Told(tmp_path)
    recorded = Recorded(told)
    recorded.connect(OLD)
    assert [part.boot_id for part in recorded.session.parts] == [NEW, OLD]
    recorded.connect(NEW)
    assert recorded.session.parts == (Part(boot_id=NEW, seq_first=0),)
    assert recorded.session.unsynced_tail_max == {}
    told.close()


def test_a_stream_that_did_not_come_back_is_gone_on_from_as_ever(tmp_path: Path) -> None:
    """The node was switched on anew, and remembers its streams: nothing is attached again."""
    told = Told(tmp_path)
    recorded = Recorded(told)
    said = told.earlier(array_info=told.info[NEW], held=((0, 4),), next_seq=5)
    told.connect(array_info=told.info[OLD], earlier=(said,))
    recorded.follow()
    assert recorded.session.parts == (
        Part(boot_id=NEW, seq_first=0, seq_last=4),
        Part(boot_id=OLD, seq_first=0),
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
    found = numbers_of([Part.model_validate(part) for part in sealed["parts"]])
    assert found[tared.boot_id] == Intervals([(70, 169)])
    if not copy_frames:
        assert sealed["complete"] is True
        assert len(sealed["parts"]) == 1
