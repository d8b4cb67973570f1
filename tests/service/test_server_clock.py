"""The server's own UTC: right at the start, and even from then on."""

from __future__ import annotations

import time

import pytest

from service.server_clock import server_utc_ns

HOUR_NS = 3_600_000_000_000


def test_it_is_the_date_of_this_machine() -> None:
    assert abs(server_utc_ns() - time.time_ns()) < HOUR_NS


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS])
def test_it_does_not_follow_a_step_of_the_machines_clock(
    monkeypatch: pytest.MonkeyPatch, step_ns: int
) -> None:
    before_ns, real = server_utc_ns(), time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + step_ns)
    assert 0 <= server_utc_ns() - before_ns < 60_000_000_000


def test_it_never_goes_back() -> None:
    readings = [server_utc_ns() for _ in range(1000)]
    assert readings == sorted(readings)
