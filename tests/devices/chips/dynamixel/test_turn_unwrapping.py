"""Whole turns of a count: continued or not known, and never a plausible wrong one."""

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
    """What happens between two readings."""

    wait_ms: int
    speed: float
    """Of the greatest that a joint can have, -1 to 1."""
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
def test_a_position_is_the_true_one_or_its_turn_is_not_known(
    count_range: CountRange, start: int, steps: list[Step]
) -> None:
    counter, true, zero, t_ms = TurnUnwrapper(), start, 0, 0
    counter.unwrap(reading(true, t_ms, count_range=count_range))
    for step in steps:
        t_ms += step.wait_ms
        true += round(step.speed * 2.9 * TURN * step.wait_ms * 1e-3)
        if count_range is CountRange.ONE_TURN:
            true = max(0, min(true, TURN - 1))
        if step.restarts:
            zero = true // TURN * TURN
        counts = true % TURN if count_range is CountRange.WRAPPED else true - zero
        found = counter.unwrap(
            reading(counts, t_ms, restarted=step.restarts, count_range=count_range)
        )
        if found.is_turn_known:
            assert found.counts == true
        else:
            assert found.counts == counts, "as it was read"


@given(start=st.integers(0, TURN - 1), steps=steps)
def test_a_servo_that_answers_quickly_is_followed_over_every_restart(
    start: int, steps: list[Step]
) -> None:
    counter, true, zero = TurnUnwrapper(), start, 0
    counter.unwrap(reading(true, 0))
    for i, step in enumerate(steps, start=1):
        true += round(step.speed * 2.9 * TURN * 0.1)
        if step.restarts:
            zero = true // TURN * TURN
        found = counter.unwrap(reading(true - zero, 100 * i, restarted=step.restarts))
        assert (found.is_turn_known, found.counts) == (True, true)


def test_after_a_long_silence_in_which_it_restarted_the_turn_stays_unknown() -> None:
    counter = TurnUnwrapper()
    counter.unwrap(reading(5000, 0))
    for i in range(5):
        found = counter.unwrap(reading(904, 1000 + 10 * i, restarted=i == 0))
        assert (found.is_turn_known, found.counts) == (False, 904)


def test_a_long_silence_without_a_restart_costs_nothing() -> None:
    counter = TurnUnwrapper()
    counter.unwrap(reading(5000, 0))
    assert counter.unwrap(reading(9000, 3000)).is_turn_known


@pytest.mark.parametrize("leap", [TURN, -TURN, 3 * TURN])
def test_a_leap_by_whole_turns_is_no_movement(leap: int) -> None:
    # Torque switched on in position control: no restart, and the count begins anew.
    counter = TurnUnwrapper()
    counter.unwrap(reading(5000, 0))
    found = counter.unwrap(reading(5000 + leap, 10))
    assert (found.is_turn_known, found.counts) == (True, 5000)


def test_a_leap_faster_than_any_joint_is_no_position() -> None:
    counter = TurnUnwrapper()
    counter.unwrap(reading(1000, 0))
    assert not counter.unwrap(reading(2000, 10)).is_turn_known
    assert not counter.unwrap(reading(2000, 20)).is_turn_known


def test_a_joint_that_cannot_leave_its_turn_is_known_again_once_it_answers() -> None:
    counter, joint = TurnUnwrapper(), CountRange.ONE_TURN
    counter.unwrap(reading(1000, 0, count_range=joint))
    first = counter.unwrap(reading(3000, 2000, restarted=True, count_range=joint))
    second = counter.unwrap(reading(3001, 2010, count_range=joint))
    assert [first.is_turn_known, second.is_turn_known] == [False, True]
    assert second.counts == 3001


def test_torque_that_was_switched_on_in_a_silence_may_have_begun_the_count_anew() -> None:
    counter, joint = TurnUnwrapper(), CountRange.ONE_TURN
    counter.unwrap(reading(5000, 0, count_range=joint))
    assert not counter.unwrap(reading(904, 1000, count_range=joint)).is_turn_known


def test_a_count_beyond_what_a_frame_holds_is_not_known() -> None:
    counter = TurnUnwrapper()
    counter.unwrap(reading(2**31 - 10, 0))
    assert not counter.unwrap(reading(-(2**31) + 10, 10)).is_turn_known
