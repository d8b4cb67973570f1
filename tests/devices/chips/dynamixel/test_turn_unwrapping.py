"""Whole turns of a count: continued or unknown, and never wrong."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.chips.dynamixel.driver import PositionReading
from devices.chips.dynamixel.firmwares import CountRange
from devices.chips.dynamixel.position_sources import TurnUnwrapper

TURN = 4096
MS = 1_000_000


def reading(
    counts: int,
    t_ms: float,
    *,
    restarted: bool = False,
    count_range: CountRange = CountRange.MANY_TURNS,
) -> PositionReading:
    t_ns = round(t_ms * MS)
    return PositionReading(counts, t_ns, 0, t_ns, has_restarted=restarted, count_range=count_range)


@dataclass
class Step:
    """Time, movement and restart between two readings."""

    wait_ms: int
    speed: float
    """Share of the greatest speed of a joint, -1 to 1."""
    restarts: bool


steps = st.lists(
    st.builds(
        Step,
        wait_ms=st.sampled_from([1, 5, 10, 20, 100, 300, 2_000]),
        speed=st.floats(-1, 1),
        restarts=st.booleans(),
    ),
    max_size=30,
)


@given(count_range=st.sampled_from(CountRange), start=st.integers(0, TURN - 1), steps=steps)
def test_a_position_is_the_true_one_or_its_turn_is_unknown(
    count_range: CountRange, start: int, steps: list[Step]
) -> None:
    unwrapper, true, zero, t_ms = TurnUnwrapper(), start, 0, 0
    unwrapper.unwrap(reading(true, t_ms, count_range=count_range))
    for step in steps:
        t_ms += step.wait_ms
        true += round(step.speed * 2.9 * TURN * step.wait_ms * 1e-3)
        if count_range is CountRange.ONE_TURN:
            true = max(0, min(true, TURN - 1))
        if step.restarts:
            zero = true // TURN * TURN
        counts = true % TURN if count_range is CountRange.WRAPPED else true - zero
        found = unwrapper.unwrap(
            reading(counts, t_ms, restarted=step.restarts, count_range=count_range)
        )
        if found.is_turn_known:
            assert found.counts == true
        else:
            assert found.counts == counts, "as read"


@given(start=st.integers(0, TURN - 1), steps=steps)
def test_the_turn_of_a_servo_that_answers_quickly_is_known_after_every_restart(
    start: int, steps: list[Step]
) -> None:
    unwrapper, true, zero = TurnUnwrapper(), start, 0
    unwrapper.unwrap(reading(true, 0))
    for i, step in enumerate(steps, start=1):
        true += round(step.speed * 2.9 * TURN * 0.1)
        if step.restarts:
            zero = true // TURN * TURN
        found = unwrapper.unwrap(reading(true - zero, 100 * i, restarted=step.restarts))
        assert (found.is_turn_known, found.counts) == (True, true)


MANY, ONE = CountRange.MANY_TURNS, CountRange.ONE_TURN


@pytest.mark.parametrize(
    ("count_range", "first", "later", "expected"),
    # Counts, ms and restarts of later readings; None where the turn is unknown.
    [
        (MANY, 5000, [(904, 1000, True), (904, 1010, False), (904, 1020, False)], [None] * 3),
        (MANY, 5000, [(9000, 3000, False)], [9000]),
        # Torque switched on in position control: no restart, and the count begins again.
        *((MANY, 5000, [(5000 + n * TURN, 10, False)], [5000]) for n in (1, -1, 3)),
        (MANY, 1000, [(2000, 10, False), (2000, 20, False)], [None] * 2),
        (MANY, 2**31 - 10, [(-(2**31) + 10, 10, False)], [None]),
        (ONE, 1000, [(3000, 2000, True), (3001, 2010, False)], [None, 3001]),
        (ONE, 5000, [(904, 1000, False)], [None]),
    ],
    ids=[
        "a restart in a long silence",
        "a long silence without a restart",
        *("a leap by a turn", "a leap back by a turn", "a leap by three turns"),
        "a leap faster than any joint",
        "a count beyond the column",
        "a joint of one turn is known at its second answer",
        "torque may have been switched on in a silence",
    ],
)
def test_a_turn_is_known_only_where_it_is_certain(
    count_range: CountRange,
    first: int,
    later: list[tuple[int, int, bool]],
    expected: list[int | None],
) -> None:
    unwrapper = TurnUnwrapper()
    unwrapper.unwrap(reading(first, 0, count_range=count_range))
    for (counts, t_ms, restarted), position in zip(later, expected, strict=True):
        found = unwrapper.unwrap(
            reading(counts, t_ms, restarted=restarted, count_range=count_range)
        )
        assert found.is_turn_known == (position is not None)
        assert found.counts == (counts if position is None else position)
