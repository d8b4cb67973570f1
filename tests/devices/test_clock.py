"""Injected time, and a server's UTC."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import SystemClock, UtcAnchor, VirtualClock, server_utc_ns

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
        assert clock.now_ns() == clock.now_ns() == latest
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


@pytest.mark.parametrize("t_ns", [5_001_000, 1_000, 999, -1])
def test_the_system_clock_sleeps_until_the_instant_has_come(
    t_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    time = ImpatientTime()
    monkeypatch.setattr("devices.clock.time", time)
    clock = SystemClock()
    assert clock.now_ns() == 1_000
    clock.sleep_until_ns(t_ns)
    assert clock.now_ns() >= t_ns
    if t_ns > 1_000:
        assert time.sleeps[0] == pytest.approx(0.005)
        assert len(time.sleeps) > 1
    else:
        assert time.sleeps == []


@given(t_mono_ns=st.integers(0, 2**62), t_ns=st.integers(0, 2**62))
def test_an_anchor_converts_the_time_of_one_clock_to_the_other(t_mono_ns: int, t_ns: int) -> None:
    anchor = UtcAnchor.from_readings(t_mono_ns, t_ns, clock_set=False)
    assert t_mono_ns + anchor.offset_ns == t_ns
    assert not anchor.clock_set


class StoppedTime:
    """Stands in for module `time`: the process is stopped for a minute behind one of its calls."""

    def __init__(self, stopped_behind: int) -> None:
        self.t_ns, self.calls, self.stopped_behind = 1_000, 0, stopped_behind

    def monotonic_ns(self) -> int:
        self.calls += 1
        t_ns = self.t_ns
        self.t_ns += 60_000_000_000 if self.calls == self.stopped_behind else 100
        return t_ns

    def time_ns(self) -> int:
        return self.monotonic_ns() + 5_000_000_000


@pytest.mark.parametrize("stopped_behind", range(1, 16))
def test_a_stop_between_two_clocks_is_not_in_the_anchor(
    stopped_behind: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("devices.clock.time", StoppedTime(stopped_behind))
    anchor = UtcAnchor.measure(clock_set=True)
    assert anchor.offset_ns == pytest.approx(5_000_000_000, abs=1_000)


HOUR_NS = 3_600_000_000_000


def test_a_servers_utc_is_the_date_of_its_machine() -> None:
    assert abs(server_utc_ns() - time.time_ns()) < HOUR_NS


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS])
def test_a_servers_utc_does_not_follow_a_step_of_the_machines_clock(
    monkeypatch: pytest.MonkeyPatch, step_ns: int
) -> None:
    before_ns, real = server_utc_ns(), time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + step_ns)
    assert 0 <= server_utc_ns() - before_ns < 60_000_000_000


def test_a_servers_utc_never_goes_back() -> None:
    readings = [server_utc_ns() for _ in range(1000)]
    assert readings == sorted(readings)
