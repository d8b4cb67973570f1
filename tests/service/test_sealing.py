"""The ledger of a session: every frame is recorded, lost for a reason, or still to come."""

from __future__ import annotations

from typing import Any

from hypothesis import example, given
from hypothesis import strategies as st

from service.sealing import ledger_of
from storage.intervals import Intervals
from storage.session import Ledger, Part, Session

TOP = 50
BOOTS = ("a" * 32, "b" * 32, "c" * 32)

numbers = st.integers(0, TOP)
pairs = st.tuples(numbers, numbers).map(lambda ends: (min(ends), max(ends)))
held_sets = st.lists(pairs, max_size=6).map(Intervals)


def session(*parts: Part, **changes: Any) -> Session:
    content: dict[str, Any] = {
        "id": "20200101T000000Z-000000",
        "name": "walk",
        "node": "bench",
        "state": "recording",
        "started_t_ns": 0,
        "parts": parts,
        "scene": "mud",
    }
    return Session(**content | changes)


def part(first: int, last: int | None, boot: int = 0) -> Part:
    return Part(boot_id=BOOTS[boot], seq_first=first, seq_last=last)


def ledger(of: Session, *held: Intervals, **changes: Any) -> Ledger:
    options: dict[str, Any] = {
        "open_boot_id": None,
        "node_first_seq": 0,
        "missed_slots": 0,
        "finished": True,
    }
    return ledger_of(of, dict(zip(BOOTS, held, strict=False)), **options | changes)


def members(intervals: Intervals) -> set[int]:
    return {n for first, last in intervals for n in range(first, last + 1)}


@given(
    parts=st.lists(st.tuples(pairs, held_sets), min_size=1, max_size=3),
    still_open=st.one_of(st.none(), st.integers(0, 2)),
    node_first_seq=st.integers(0, TOP + 5),
    tails=st.dictionaries(st.sampled_from(BOOTS), st.integers(0, 3)),
    finished=st.booleans(),
)
def test_every_frame_of_every_part_is_counted_once(
    parts: list[tuple[tuple[int, int], Intervals]],
    still_open: int | None,
    node_first_seq: int,
    tails: dict[str, int],
    finished: bool,
) -> None:
    found = ledger(
        session(
            *(part(*ends, boot) for boot, (ends, _) in enumerate(parts)), unsynced_tail_max=tails
        ),
        *(held for _, held in parts),
        open_boot_id=None if still_open is None else BOOTS[still_open],
        node_first_seq=node_first_seq,
        missed_slots=7,
        finished=finished,
    )
    for boot, ((first, last), held) in enumerate(parts):
        one, asked = found.parts[boot], set(range(first, last + 1))
        missing = asked - members(held)
        assert (one.boot_id, one.seq_first, one.seq_last) == (BOOTS[boot], first, last)
        assert one.recorded + sum(one.lost.values()) + one.pending == len(asked)
        assert one.recorded == len(asked) - len(missing)
        evicted = {n for n in missing if n < node_first_seq}
        if boot == still_open:
            assert one.lost == ({"evicted": len(evicted)} if evicted else {})
        else:  # nobody has it any more
            assert one.lost == ({"node_restarted": len(missing)} if missing else {})
            assert one.pending == 0
        assert one.unsynced_tail_max == tails.get(BOOTS[boot], 0)
    lost = any(one.lost or one.unsynced_tail_max for one in found.parts)
    pending = any(one.pending for one in found.parts)
    assert found.lossy == lost
    assert found.complete == (finished and not lost and not pending)
    assert found.missed_slots == 7


@given(first=numbers, held=held_sets)
@example(first=0, held=Intervals([(0, 0)]))
def test_a_part_without_end_reaches_to_the_newest_frame_that_is_held(
    first: int, held: Intervals
) -> None:
    found = ledger(session(part(first, None)), held, open_boot_id=BOOTS[0])
    (one,) = found.parts
    here = {n for n in members(held) if n >= first}
    assert one.recorded == len(here)
    length = max(here) - first + 1 if here else 0
    assert one.recorded + sum(one.lost.values()) + one.pending == length
    if here:
        assert one.seq_last == max(here)
    assert not found.complete


def test_a_stream_without_a_journal_is_lost_or_still_to_come() -> None:
    of = session(part(10, 19))
    assert ledger(of).parts[0].lost == {"node_restarted": 10}
    later = ledger(of, open_boot_id=BOOTS[0], node_first_seq=0)
    assert (later.parts[0].pending, later.parts[0].lost) == (10, {})
    assert not later.lossy
    assert not later.complete


def test_a_session_without_parts_that_is_finished_is_complete() -> None:
    found = ledger(session())
    assert (found.complete, found.lossy, found.parts) == (True, False, ())


def test_a_part_that_is_held_is_complete_whatever_else_is_held_or_evicted() -> None:
    of = session(part(10, 19), part(0, 5, boot=1))
    found = ledger(
        of,
        Intervals([(0, 100)]),
        Intervals([(0, 5)]),
        open_boot_id=BOOTS[0],
        node_first_seq=1000,
    )
    assert found.complete
    assert [one.recorded for one in found.parts] == [10, 6]
