"""The same facts give the same session, whoever asks: server, node alone, recovery or verify."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.node.local_recording import LocalRecording
from service.protocol.link import PROTOCOL, Hello
from service.server.node import ServerNode
from service.server.nodes import NodeRegistry
from service.server.recorder import Recorder
from service.server.session_store import SessionStore, Trash
from service.sessions.lifecycle import Abandon, apply_event, compute_present_ledger
from service.sessions.recovery import recover_locked_folder
from service.sessions.tares import TareHistory
from storage.clock.log import ClockOffset
from storage.intervals import Losses
from storage.journal.journal import Journal
from storage.journal.node.journal import NodeJournal
from storage.journal.stream_notes import StreamNotes
from storage.sessions.folder import Part, Session, SessionsFolder
from storage.verify.session import verify_session
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array
from tests.builders.calibrations import make_calibration, make_tare
from tests.builders.frames import make_frames

ID = "20200101T000000Z-00000a"
BOOT, PRESENT = "a" * 32, "b" * 32
INFO = make_array(stream_id=BOOT)
BATCH, BATCHES = 5, 8
SERVER_MINUS_NODE_NS = 7_000_000_000
REASONS = ("disk_full", "evicted", "corrupt")
FATES = st.sampled_from(("held", "held", "missing", *REASONS))
CALIBRATIONS: list[dict[str, Any] | None] = [
    None,
    {"this": "is none"},
    make_calibration("T01", "T02").model_dump(mode="json"),
]


def t_ns(seq: int) -> int:
    return UTC_NS + PERIOD_NS * seq


@dataclass
class Stream:
    """A stream as it lies on a disk: what became of each batch, and what is said of its end."""

    fates: list[str]
    notes: dict[str, Any]

    def write(self, data: Path) -> None:
        folder = data / "journal" / "bench" / BOOT
        journal = Journal(folder, INFO)
        lost: dict[str, list[tuple[int, int]]] = {}
        for number, fate in enumerate(self.fates):
            first, last = number * BATCH, number * BATCH + BATCH - 1
            if fate == "held":
                journal.append_new_frames(make_frames(np.arange(first, last + 1)))
            elif fate in REASONS:
                lost.setdefault(fate, []).append((first, last))
        StreamNotes(array_info=INFO, lost=Losses(lost).to_pairs(), **self.notes).save(folder)
        journal.close()


@st.composite
def streams(draw: st.DrawFn, *, has_ended: bool) -> Stream:
    fates = draw(st.lists(FATES, min_size=1, max_size=BATCHES))
    if "held" not in fates:
        fates[0] = "held"
    notes = {"missed_slots": draw(st.integers(0, 9))}
    if has_ended or draw(st.booleans()):
        beyond = draw(st.integers(0, 3))
        notes |= {"next_seq": len(fates) * BATCH + beyond}
        notes |= {"max_lost_tail_frames": draw(st.sampled_from((0, 0, 40)))}
    return Stream(fates, notes)


def session(**content: Any) -> Session:
    facts: dict[str, Any] = {
        "id": ID,
        "name": "walk",
        "node": "bench",
        "started_t_ns": t_ns(0),
        "scene": "test",
    }
    return Session(**facts | {"state": "pending", "scene_content": {"name": "test"}} | content)


SEQ = st.integers(0, BATCHES * BATCH)


def keep(data: Path, kept: Session) -> Path:
    folder = SessionsFolder(data / "sessions")
    folder.save_session_json(kept)
    return folder.get_path(kept.id)


def loaded(data: Path) -> Session:
    return SessionsFolder(data / "sessions").load(ID)


def what_it_is(done: Session) -> dict[str, Any]:
    names = {"parts", "stopped_t_ns", "max_lost_tail_frames", "problem", "calibration_id", "frames"}
    return {"ledger": done.ledger, **done.model_dump(include=names)}


@pytest.mark.slow
@given(
    stream=streams(has_ended=True),
    first=SEQ,
    length=st.none() | SEQ,
    calibration=st.sampled_from(CALIBRATIONS),
)
@settings(max_examples=25, deadline=None)
def test_a_node_alone_and_recovery_in_its_folder_seal_the_same_session(
    stream: Stream, first: int, length: int | None, calibration: dict[str, Any] | None
) -> None:
    end = None if length is None else first + length - 1
    begun = session(
        state="recording",
        parts=(Part(stream_id=BOOT, seq_first=first, seq_last=end),),
        calibration=calibration,
    )
    with TemporaryDirectory() as path:
        alone, recovered = Path(path) / "alone", Path(path) / "recovered"
        stream.write(alone)
        folder = keep(alone, begun)
        counted = verify_session(folder).ledger
        shutil.copytree(alone, recovered)
        journal = NodeJournal(alone, "bench")
        recording = LocalRecording(
            alone,
            "bench",
            journal,
            session_name=None,
            calibration=None,
            scene_content={},
            is_emulated=True,
            report=lambda _: None,
        )
        recording.seal_earlier_sessions()
        journal.end_streams_and_close()
        recover_locked_folder(recovered)
        done = loaded(alone)
        assert done.state == "sealed"
        assert what_it_is(done) == what_it_is(loaded(recovered))
        if end is not None:
            assert counted is not None
            assert done.ledger is not None
            assert counted.parts == done.ledger.parts
            assert counted.missed_slots == done.ledger.missed_slots


@given(
    stream=streams(has_ended=False),
    first=SEQ,
    length=st.none() | SEQ,
    stopped=SEQ,
    is_measured=st.booleans(),
    missed_slots_at_stop=st.none() | st.integers(0, 9),
    calibration=st.sampled_from(CALIBRATIONS),
    tared=st.none() | SEQ,
)
@settings(max_examples=25, deadline=None)
def test_a_server_and_recovery_in_its_folder_come_to_the_same_session(
    stream: Stream,
    first: int,
    length: int | None,
    stopped: int,
    is_measured: bool,
    missed_slots_at_stop: int | None,
    calibration: dict[str, Any] | None,
    tared: int | None,
) -> None:
    end = None if length is None else first + length - 1
    row = ClockOffset(
        stream_id=BOOT,
        t_mono_ns=0,
        server_minus_node_ns=SERVER_MINUS_NODE_NS if is_measured else 0,
        uncertainty_ns=1,
    )
    begun = session(
        stopped_t_ns=t_ns(stopped) + row.server_minus_node_ns,
        parts=(Part(stream_id=BOOT, seq_first=first, seq_last=end),),
        clock=(row,) if is_measured else (),
        server_minus_node_ns_at_stop={BOOT: row.server_minus_node_ns} if is_measured else {},
        missed_slots_at_start=2,
        missed_slots_at_stop={} if missed_slots_at_stop is None else {BOOT: missed_slots_at_stop},
        calibration=calibration,
    )
    with TemporaryDirectory() as path:
        data = Path(path)
        stream.write(data)
        if tared is not None:
            history = TareHistory(data / "nodes" / "bench" / "tares.json")
            history.store_tare_in_force(make_tare(t_ns=t_ns(tared)), INFO)
        recorder, node = server_on(data, begun)
        made = recorder.collect_inputs_from_journals(ID)
        waiting = recorder.get_ledger(ID)
        if end is not None:
            counted = verify_session(data / "sessions" / ID).ledger
            assert counted is not None
            assert (counted.parts, counted.missed_slots) == (waiting.parts, waiting.missed_slots)
            (one,) = recover_locked_folder(data).sessions
            assert one.outcome == "sealed" or one.ledger == waiting
            keep(data, begun)
        facts = node.make_session_facts()
        abandoned = apply_event(begun, Abandon(), facts).session
        (one,) = recover_locked_folder(data, abandon_missing=True).sessions
        done = one.session
        assert done.state == "sealed"
        assert (done.parts, done.is_abandoned) == (abandoned.parts, True)
        assert done.max_lost_tail_frames == abandoned.max_lost_tail_frames
        assert done.ledger == compute_present_ledger(abandoned, facts)
        if done.frames and made.problem is not None:
            assert done.problem == f"no estimates: {made.problem}"
        assert (made.calibration is None) == (made.problem is not None)


def server_on(data: Path, begun: Session) -> tuple[Recorder, ServerNode]:
    """A server that was started on this folder, whose node has not connected since."""
    nodes = NodeRegistry(data)
    hello = Hello(
        protocol=PROTOCOL,
        array_info=make_array(stream_id=PRESENT),
        stored=(),
        next_seq=0,
        t_mono_ns=0,
        scene={},
        emulated=True,
        calibration=None,
        calibration_problem="for this test",
    )
    node = nodes.check_hello_and_get_or_create(hello)
    node.save_hello()
    keep(data, begun)
    book = SessionStore(
        SessionsFolder(data / "sessions"), Trash(data / "trash"), on_change=lambda _: None
    )
    return Recorder(book, nodes, request_resend=lambda _: None), node
