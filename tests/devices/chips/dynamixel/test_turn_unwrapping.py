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


def test_the_turn_stays_unknown_after_a_restart_in_a_long_silence() -> None:
    unwrapper = TurnUnwrapper()
    unwrapper.unwrap(reading(5000, 0))
    for i in range(5):
        found = unwrapper.unwrap(reading(904, 1000 + 10 * i, restarted=i == 0))
        assert (found.is_turn_known, found.counts) == (False, 904)


def test_the_turn_is_known_after_a_long_silence_without_a_restart() -> None:
    unwrapper = TurnUnwrapper()
    unwrapper.unwrap(reading(5000, 0))
    assert unwrapper.unwrap(reading(9000, 3000)).is_turn_known


@pytest.mark.parametrize("leap", [TURN, -TURN, 3 * TURN])
def test_a_leap_by_whole_turns_is_no_movement(leap: int) -> None:
    # Torque switched on in position control: no restart, and the count begins again.
    unwrapper = TurnUnwrapper()
    unwrapper.unwrap(reading(5000, 0))
    found = unwrapper.unwrap(reading(5000 + leap, 10))
    assert (found.is_turn_known, found.counts) == (True, 5000)


def test_the_turn_is_unknown_after_a_leap_faster_than_any_joint() -> None:
    unwrapper = TurnUnwrapper()
    unwrapper.unwrap(reading(1000, 0))
    assert not unwrapper.unwrap(reading(2000, 10)).is_turn_known
    assert not unwrapper.unwrap(reading(2000, 20)).is_turn_known


def test_the_turn_of_a_joint_of_one_turn_is_known_at_its_second_answer() -> None:
    unwrapper, joint = TurnUnwrapper(), CountRange.ONE_TURN
    unwrapper.unwrap(reading(1000, 0, count_range=joint))
    first = unwrapper.unwrap(reading(3000, 2000, restarted=True, count_range=joint))
    second = unwrapper.unwrap(reading(3001, 2010, count_range=joint))
    assert [first.is_turn_known, second.is_turn_known] == [False, True]
    assert second.counts == 3001


def test_the_turn_is_unknown_if_torque_may_have_been_switched_on_in_a_silence() -> None:
    unwrapper, joint = TurnUnwrapper(), CountRange.ONE_TURN
    unwrapper.unwrap(reading(5000, 0, count_range=joint))
    assert not unwrapper.unwrap(reading(904, 1000, count_range=joint)).is_turn_known


def test_the_turn_of_a_count_beyond_the_column_is_unknown() -> None:
    unwrapper = TurnUnwrapper()
    unwrapper.unwrap(reading(2**31 - 10, 0))
    assert not unwrapper.unwrap(reading(-(2**31) + 10, 10)).is_turn_known
