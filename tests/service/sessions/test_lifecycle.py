"""Every state and event of a session, and the ledger's law over any sequence of events."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, get_args

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import service.sessions.lifecycle as lifecycle
from devices.errors import StateError
from service.sessions.lifecycle import (
    Abandon,
    Delete,
    Edit,
    Event,
    Reevaluate,
    Resume,
    Sealed,
    Step,
    Stop,
    apply_event,
    compute_present_ledger,
    iterate_needed_parts,
)
from service.sessions.parts import (
    FramesToCome,
    NodeFacts,
    NodeReport,
    SeqsAround,
    SessionStream,
    close_part,
)
from storage.clock.log import ClockOffset
from storage.intervals import NO_END, Intervals, Losses
from storage.sessions.folder import Part, Session, SessionState
from storage.sessions.ledger import group_numbers_by_stream
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array

STREAM = "a" * 32
STATES: tuple[SessionState, ...] = get_args(SessionState)
EVENTS: dict[str, Event] = {
    "Reevaluate": Reevaluate(),
    "Stop": Stop(),
    "Resume": Resume(),
    "Abandon": Abandon(),
    "Edit": Edit({"notes": "wet"}),
    "Delete": Delete(),
}
NEXT: dict[str, set[str]] = {
    "follows streams, or ends": {"recording", "pending", "sealing"},
    "sealing, or pending": {"sealing", "pending"},
    **{state: {state} for state in STATES},
}


def session(state: SessionState, **content: Any) -> Session:
    closed = None if state == "recording" else 9
    facts: dict[str, Any] = {
        "id": "20200101T000000Z-00000a",
        "name": "walk",
        "node": "bench",
        "state": state,
        "started_t_ns": UTC_NS,
        "stopped_t_ns": None if state == "recording" else UTC_NS + 10 * PERIOD_NS,
        "parts": (Part(stream_id=STREAM, seq_first=0, seq_last=closed),),
        "scene": "test",
    }
    return Session(**facts | content)


def test_a_part_is_closed_by_its_value_and_no_other_session_s_part_is() -> None:
    recording = session("recording")
    (part,) = recording.parts
    closed = close_part(recording, Part(**part.model_dump()), 4)
    assert [each.seq_last for each in closed.parts] == [4]
    with pytest.raises(ValueError, match="not in list"):
        close_part(closed, part, 5)


def table_cells() -> Iterator[tuple[str, SessionState, str]]:
    """The cells of the table that stands above the machine's code."""
    lines = (lifecycle.__doc__ or "").splitlines()
    rows = [[cell.strip(" `") for cell in x.strip("|").split("|")] for x in lines if x[:1] == "|"]
    (_, *states), _, *events = rows
    assert tuple(states) == STATES
    for name, *cells in events:
        yield from ((name, state, cell) for state, cell in zip(STATES, cells, strict=True))


@pytest.mark.parametrize("stored", [9, 4, None])
@pytest.mark.parametrize("has_reported", [True, False])
@pytest.mark.parametrize("unsynced", [0, 2])
@pytest.mark.parametrize("frames_to_come", get_args(FramesToCome))
def test_each_state_takes_each_event_as_the_table_says(
    stored: int | None, has_reported: bool, unsynced: int, frames_to_come: FramesToCome
) -> None:
    held = Intervals([] if stored is None else [(0, stored)])
    stream = SessionStream(
        stored=held,
        obtainable=Intervals() if has_reported else Intervals([(0, 9)]),
        unsynced=held.restricted_to(0, unsynced - 1),
    )
    node = NodeFacts(
        now_t_ns=UTC_NS + 20 * PERIOD_NS,
        find_stream={STREAM: stream}.get,
        stream_ids=(STREAM,),
        has_reported=has_reported,
        frames_to_come=frames_to_come,
    )
    seen = set()
    for name, state, cell in table_cells():
        seen.add(name)
        before = session(state)
        event = EVENTS.get(name) or Sealed(before.model_copy(update={"state": "sealed"}))
        if cell == "refused":
            with pytest.raises(StateError, match="session"):
                apply_event(before, event, node)
            continue
        step = apply_event(before, event, node)
        allowed = {state} if cell == "same" else NEXT[cell]
        assert step.session.state in allowed, (name, state, cell)
        assert (step.action == "seal") == (step.session.state == "sealing") or name != "Reevaluate"
        if not step.is_changed:
            assert step.session == before
            assert not step.sessions_to_save
    assert seen == {event.__name__ for event in get_args(Event)}


def test_a_sealed_session_is_changed_by_people_only() -> None:
    done = session("sealed")
    for event in (Reevaluate(), Stop(), Delete()):
        assert apply_event(done, event) == Step(done)
    edited = apply_event(done, Edit({"markers": ()}))
    assert (edited.session.state, edited.action) == ("sealed", "write_markers")
    assert apply_event(done, Edit({"name": "mud"})).action is None


def test_what_people_changed_during_sealing_stays() -> None:
    before = session("sealing")
    result = before.model_copy(update={"state": "sealed", "frames": 10})
    now = apply_event(before, Edit({"name": "mud", "tags": ("wet",)})).session
    step = apply_event(now, Sealed(result))
    assert (step.session.name, step.session.tags, step.session.frames) == ("mud", ("wet",), 10)
    assert step.action is None


def test_an_interrupted_recording_forgets_its_earlier_stop() -> None:
    resumed = apply_event(session("sealing"), Resume()).session
    assert (resumed.state, resumed.stopped_t_ns) == ("recording", None)
    assert resumed.parts == (Part(stream_id=STREAM, seq_first=0),)


@dataclass(frozen=True)
class Frames(SessionStream):
    """A stream without files: frame n is sampled `n` periods after the begin."""

    begin_t_ns: int = 0

    def find_batch_t_ns_near(self, seq: int, *, at_or_before: bool) -> int | None:
        inside = (0, seq) if at_or_before else (seq, NO_END)
        near = self.stored.restricted_to(*inside)
        found = near.last if at_or_before else near.first
        return None if found is None else self.begin_t_ns + found * PERIOD_NS

    def find_seqs_around(
        self, t_ns: int, *, min_seq: int, may_be_stale: bool = False
    ) -> SeqsAround | None:
        del may_be_stale
        passed = (t_ns - self.begin_t_ns) // PERIOD_NS
        if self.stored.restricted_to(max(passed + 1, min_seq), NO_END).first is None:
            return None
        before = self.stored.restricted_to(min_seq, passed).last if passed >= 0 else None
        last = min_seq - 1 if before is None else before
        after = self.stored.restricted_to(last + 1, NO_END).first
        assert after is not None
        return SeqsAround(last, after)


@pytest.mark.parametrize("at_stop", [{}, {STREAM: -9 * PERIOD_NS}])
def test_a_stream_is_cut_by_no_measurement_to_another_clock_than_the_stops(
    at_stop: dict[str, int],
) -> None:
    """The server was started anew with an earlier date, then stopped, and both streams came."""
    later = "b" * 32
    row = ClockOffset(stream_id=STREAM, t_mono_ns=0, server_minus_node_ns=0, uncertainty_ns=1)
    stopped_t_ns = UTC_NS - 5 * PERIOD_NS
    before = session(
        "pending",
        stopped_t_ns=stopped_t_ns,
        parts=(Part(stream_id=STREAM, seq_first=0),),
        clock=(row,),
        server_minus_node_ns_at_stop=at_stop,
    )
    stored = Intervals([(0, 9)])
    streams = {
        STREAM: Frames(stored=stored, next_seq=10, begin_t_ns=UTC_NS),
        later: Frames(begin_t_ns=UTC_NS + 20 * PERIOD_NS, offset_ns=-9 * PERIOD_NS),
    }
    node = NodeFacts(
        now_t_ns=UTC_NS + 30 * PERIOD_NS,
        find_stream=streams.get,
        stream_ids=(STREAM, later),
        is_running=True,
        has_reported=True,
        offset_ns=-9 * PERIOD_NS,
        report=NodeReport(UTC_NS + 20 * PERIOD_NS, 5, 0, UTC_NS + 20 * PERIOD_NS),
    )
    (part,) = apply_event(before, Reevaluate(), node).session.parts
    # Without a measurement at the stop, all frames are kept rather than some lost.
    assert part.seq_last == (4 if at_stop else 9)


@dataclass
class Sampled:
    """A stream at its node, and what the server has of it."""

    stream_id: str
    begin_t_ns: int
    tiles: str
    count: int = 0
    held: Intervals = field(default_factory=Intervals)
    """Frames on the node's disk."""
    lost: Intervals = field(default_factory=Intervals)
    stored: Intervals = field(default_factory=Intervals)
    """Frames on the server's disk."""
    has_ended: bool = False
    reported: tuple[Intervals, Intervals, int | None] | None = None
    """Obtainable, lost and end as the node has reported them since the server was started."""
    known: tuple[Intervals, int | None] = field(default_factory=lambda: (Intervals(), None))
    """Lost and end as the server keeps them over a restart."""

    def facts(self) -> Frames:
        obtainable = Intervals([(0, NO_END)]) if self.reported is None else self.reported[0]
        lost, next_seq = self.known
        tiles = make_array(stream_id=self.stream_id)
        named = tuple(
            tile.model_copy(update={"serial": tile.serial + self.tiles}) for tile in tiles.tiles
        )

        return Frames(
            stored=Intervals(self.stored),
            lost=Losses({"disk_full": [*(lost - self.stored)]}),
            obtainable=obtainable - lost,
            next_seq=next_seq,
            info=tiles.model_copy(update={"tiles": named}),
            offset_ns=0,
            first_t_ns=self.begin_t_ns if self.reported is not None and self.has_ended else None,
            begin_t_ns=self.begin_t_ns,
        )


class World:
    """A node, its server, and a recording from the first frame on."""

    def __init__(self) -> None:
        self.now_t_ns = UTC_NS
        self.streams: dict[str, Sampled] = {}
        self.announced: tuple[str, ...] = ()
        self.has_reported = self.is_connected = False
        self.report: NodeReport | None = None
        self.start("")
        self.connect()
        self.sample(3)
        self.deliver()
        self.sessions = [session("recording", started_t_ns=self.now_t_ns)]
        self.sessions[0] = self.sessions[0].model_copy(
            update={"parts": (Part(stream_id=self.present.stream_id, seq_first=2),)}
        )

    @property
    def present(self) -> Sampled:
        return [*self.streams.values()][-1]

    def start(self, tiles: str) -> None:
        """The node starts and begins a stream; it is not connected."""
        if self.streams:
            self.present.has_ended = True
        self.is_connected = False
        self.now_t_ns += 7 * PERIOD_NS
        stream_id = f"{len(self.streams):032x}"
        self.streams[stream_id] = Sampled(stream_id, self.now_t_ns, tiles)

    def sample(self, count: int) -> None:
        stream = self.present
        stream.held.add(stream.count, stream.count + count - 1)
        stream.count += count
        self.now_t_ns = stream.begin_t_ns + stream.count * PERIOD_NS - PERIOD_NS // 2

    def lose(self) -> None:
        """The node's disk loses the oldest frames that the server lacks."""
        for stream in self.streams.values():
            oldest = next(iter(stream.held - stream.stored), None)
            if oldest is not None:
                gone = Intervals([(oldest[0], min(oldest[1], oldest[0] + 1))])
                stream.held, stream.lost = stream.held - gone, stream.lost | gone
                break
        if self.is_connected:
            self.tell()

    def connect(self) -> None:
        self.is_connected = self.has_reported = True
        self.announced = tuple(self.streams)
        first = self.present.held.first
        begin_t_ns = self.present.begin_t_ns
        self.report = NodeReport(
            self.now_t_ns,
            self.present.count,
            first,
            0 if first is None else begin_t_ns + first * PERIOD_NS,
        )
        self.tell()

    def tell(self) -> None:
        for stream in self.streams.values():
            obtainable, end = stream.held, stream.count if stream.has_ended else None
            if end is None:
                obtainable = obtainable | Intervals([(stream.count, NO_END)])
            stream.reported = Intervals(obtainable), Intervals(stream.lost), end
            stream.known = Intervals(stream.lost), end

    def deliver(self, *, newest_only: bool = False) -> None:
        """The node sends what the server lacks, or the newest two frames before the others."""
        for stream in self.streams.values() if self.is_connected else ():
            for first, last in [*stream.held - stream.stored]:
                if not newest_only:
                    stream.stored.add(first, last)
                elif last == stream.count - 1:
                    stream.stored.add(max(first, last - 1), last)

    def restart_server(self) -> None:
        self.is_connected = self.has_reported = False
        self.report = None
        for stream in self.streams.values():
            stream.reported = None

    def facts(self) -> NodeFacts:
        def find_stream(stream_id: str) -> SessionStream | None:
            stream = self.streams.get(stream_id)
            return stream.facts() if stream is not None and stream_id in self.announced else None

        return NodeFacts(
            now_t_ns=self.now_t_ns,
            find_stream=find_stream,
            stream_ids=self.announced,
            is_running=True,
            has_reported=self.has_reported,
            is_connected=self.is_connected,
            newest_seq=self.streams[self.announced[-1]].stored.last,
            offset_ns=0,
            report=self.report,
        )

    def apply(self, event: Event) -> None:
        """Apply an event to all sessions, as a server does."""
        done = []
        for before in self.sessions:
            try:
                step = apply_event(before, event, self.facts())
            except StateError:
                done.append(before)
                continue
            done += [step.session, *step.continuations]
            if before.state == "sealed":
                assert step.session.state == "sealed"
        self.sessions = done

    def seal(self) -> None:
        self.apply(Reevaluate())
        facts = self.facts()
        for at, each in enumerate(self.sessions):
            if each.state == "sealing" and apply_event(each, Reevaluate(), facts).action == "seal":
                ledger = compute_present_ledger(each, facts)
                sealed = each.model_copy(update={"state": "sealed", "ledger": ledger})
                self.sessions[at] = apply_event(each, Sealed(sealed)).session

    def check_laws(self) -> None:
        facts = self.facts()
        for each in self.sessions:
            ledger = compute_present_ledger(each, facts)
            spans: Counter[str] = Counter()
            for part in ledger.parts:
                length = max(0, part.seq_last - part.seq_first + 1)
                spans[part.stream_id] += length
                assert part.recorded + sum(part.lost.values()) + part.pending == length
                stored = self.streams[part.stream_id].stored
                if each.state != "sealed":
                    own = stored.restricted_to(part.seq_first, part.seq_last)
                    assert part.recorded == own.number_count
            parts = (
                Part(**p.model_dump(include={"stream_id", "seq_first", "seq_last"}))
                for p in ledger.parts
            )
            numbers = group_numbers_by_stream(parts)
            assert {n: i.number_count for n, i in numbers.items()} == +spans, "a number twice"
            order = [[*self.streams].index(part.stream_id) for part in each.parts]
            assert all(a < b for a, b in pairwise(order))
            assert all(part.seq_last is not None for part in each.parts[:-1])
            if each.state in ("sealing", "sealed"):
                assert each.parts[-1].seq_last is not None
            if each.state == "sealed":
                assert not ledger.pending
            else:
                needed = group_numbers_by_stream(iterate_needed_parts(each, facts))
                for name, own in group_numbers_by_stream(each.parts).items():
                    assert not own - needed[name]


HAPPENED = st.sampled_from(
    [
        *["sample", "deliver newest"] * 3,
        *["deliver", "lose", "disconnect", "connect", "node restarts", "other tiles"],
        *["server restarts", "change", "stop", "abandon", "seal", "edit"],
    ]
)


@settings(max_examples=400, deadline=None)
@given(happened=st.lists(HAPPENED, max_size=25))
def test_every_number_counts_once_whatever_happens(happened: list[str]) -> None:
    world = World()
    stops_t_ns: list[int] = []
    has_abandoned = False
    for what in happened:
        match what:
            case "sample":
                world.sample(2)
            case "deliver" | "deliver newest":
                world.deliver(newest_only=what == "deliver newest")
            case "lose":
                world.lose()
            case "disconnect":
                world.is_connected = False
            case "connect":
                world.connect()
                world.apply(Reevaluate())
            case "node restarts":
                world.start(world.present.tiles)
            case "other tiles":
                world.start(world.present.tiles + "x")
            case "server restarts":
                world.restart_server()
            case "change":
                world.apply(Reevaluate())
            case "stop":
                stops_t_ns += [world.now_t_ns] if not stops_t_ns else []
                world.apply(Stop())
            case "abandon":
                has_abandoned |= any(each.state == "pending" for each in world.sessions)
                world.apply(Abandon())
            case "seal":
                world.seal()
            case "edit":
                world.apply(Edit({"notes": what}))
        world.check_laws()
    # The node comes back, samples on, and sends all that it has: every session is sealed then.
    stops_t_ns += [world.now_t_ns] if not stops_t_ns else []
    world.apply(Stop())
    world.connect()
    world.apply(Reevaluate())
    world.sample(4)
    world.deliver()
    for _ in range(3):
        world.apply(Reevaluate())
        world.check_laws()
    world.seal()
    world.check_laws()
    assert {each.state for each in world.sessions} == {"sealed"}
    if has_abandoned:
        return
    found = group_numbers_by_stream(part for each in world.sessions for part in each.parts)
    for number, stream in enumerate(world.streams.values()):
        first = 2 if number == 0 else 0
        until = (stops_t_ns[0] - stream.begin_t_ns) // PERIOD_NS
        wanted = stream.stored.restricted_to(first, until)
        own = found.get(stream.stream_id, Intervals())
        assert own & stream.stored == wanted, stream.stream_id
