"""Time that is injected."""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import SystemClock, UtcAnchor, VirtualClock

instants = st.integers(-(2**62), 2**62)


@given(start=instants, targets=st.lists(instants))
def test_a_virtual_clock_stands_still_until_it_is_moved_and_never_goes_back(
    start: int, targets: list[int]
) -> None:
    clock = VirtualClock(start)
    latest = start
    for target in targets:
        clock.sleep_until_ns(target)
        latest = max(latest, target)
        assert clock.now_ns() == latest
        assert clock.now_ns() == latest


def test_a_virtual_clock_begins_at_power_up() -> None:
    assert VirtualClock().now_ns() == 0


class ImpatientTime:
    """Stands in for module `time`: every sleep ends halfway, as after a signal."""

    def __init__(self) -> None:
        self.t_ns = 1_000
        self.sleeps: list[float] = []

    def monotonic_ns(self) -> int:
        return self.t_ns

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0, "time.sleep would raise"
        self.sleeps.append(seconds)
        self.t_ns += max(1, round(seconds * 1e9) // 2)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> ImpatientTime:
    stand_in = ImpatientTime()
    monkeypatch.setattr("devices.clock.time", stand_in)
    return stand_in


def test_the_system_clock_sleeps_on_until_the_instant_has_come(impatient: ImpatientTime) -> None:
    SystemClock().sleep_until_ns(5_001_000)
    assert impatient.t_ns >= 5_001_000
    assert impatient.sleeps[0] == pytest.approx(0.005)
    assert len(impatient.sleeps) > 1


@pytest.mark.parametrize("t_ns", [1_000, 999, -1])
def test_the_system_clock_does_not_sleep_for_an_instant_that_has_passed(
    impatient: ImpatientTime, t_ns: int
) -> None:
    SystemClock().sleep_until_ns(t_ns)
    assert impatient.sleeps == []


def test_the_system_clock_is_the_monotonic_one(impatient: ImpatientTime) -> None:
    assert SystemClock().now_ns() == 1_000


@given(t_mono_ns=st.integers(0, 2**62), t_ns=st.integers(0, 2**62))
def test_an_anchor_carries_one_clock_over_to_the_other(t_mono_ns: int, t_ns: int) -> None:
    anchor = UtcAnchor.from_readings(t_mono_ns, t_ns, clock_set=False)
    assert t_mono_ns + anchor.offset_ns == t_ns
    assert not anchor.clock_set


def test_an_anchor_cannot_be_moved() -> None:
    anchor = UtcAnchor.from_readings(0, 1, clock_set=True)
    with pytest.raises(dataclasses.FrozenInstanceError):
        anchor.offset_ns = 2  # type: ignore[misc]  # it is frozen
