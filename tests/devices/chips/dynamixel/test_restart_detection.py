"""A servo's restart, from its milliseconds since power-up."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from devices.chips.dynamixel.driver import TICK_PERIOD, RestartDetector

MS = 1_000_000


@given(
    started=st.integers(0, TICK_PERIOD - 1),
    waits_ms=st.lists(st.integers(1, 5_000), min_size=1, max_size=40),
    pace=st.floats(0.97, 1.03),
)
def test_a_servo_that_runs_on_never_restarted(
    started: int, waits_ms: list[int], pace: float
) -> None:
    watch, t_ms = RestartDetector(), 0
    watch.detect_restart(started, 0, silent_ns=0)
    for wait_ms in waits_ms:
        t_ms += wait_ms
        tick = int(started + pace * t_ms) % TICK_PERIOD
        assert not watch.detect_restart(tick, t_ms * MS, silent_ns=0)


@given(
    before=st.integers(0, TICK_PERIOD - 1),
    silent_ms=st.integers(50, 200_000),
    on_part=st.floats(0, 1),
    pace=st.floats(0.97, 1.03),
)
def test_a_restart_within_a_silence_is_always_noticed(
    before: int, silent_ms: int, on_part: float, pace: float
) -> None:
    watch = RestartDetector()
    watch.detect_restart(before, 0, silent_ns=0)
    tick = int(on_part * silent_ms * min(pace, 1.0)) % TICK_PERIOD
    assert watch.detect_restart(tick, silent_ms * MS, silent_ns=silent_ms * MS)


@given(before=st.integers(0, TICK_PERIOD - 1), silent_ms=st.integers(50, 10_000))
def test_a_silence_of_the_line_alone_is_no_restart(before: int, silent_ms: int) -> None:
    watch = RestartDetector()
    watch.detect_restart(before, 0, silent_ns=0)
    tick = (before + silent_ms) % TICK_PERIOD
    restarted = watch.detect_restart(tick, silent_ms * MS, silent_ns=silent_ms * MS)
    # Where its tick would fit a restart as well, it is taken for one.
    assert restarted == (tick <= silent_ms + 20)


def test_without_the_register_a_silence_may_have_been_a_restart() -> None:
    for tick in (None, 0):
        watch = RestartDetector()
        watch.detect_restart(tick, 0, silent_ns=0)
        assert not watch.detect_restart(tick, 1_000 * MS, silent_ns=0)
        assert watch.detect_restart(tick, 1_200 * MS, silent_ns=110 * MS)
