"""The pace of a bus is found beside whatever a machine does, and again where it proves wrong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.rig.rig import FrameRateMonitor, estimate_undisturbed_rate_hz
from tests.builders.frames import make_frames

PERIOD_NS = 2_000_000


@given(
    pauses_ms=st.lists(st.floats(0.0, 200.0), min_size=1, max_size=6),
    at=st.lists(st.integers(0, 99), min_size=6, max_size=6, unique=True),
)
def test_pauses_of_a_busy_machine_do_not_make_the_bus_slower(
    pauses_ms: list[float], at: list[int]
) -> None:
    took_ns = np.full(100, PERIOD_NS)
    for pause_ms, frame in zip(pauses_ms, at, strict=False):
        took_ns[frame] += round(pause_ms * 1e6)
        # What was converting meanwhile is read at once.
        took_ns[(frame + 1) % 100] -= min(round(pause_ms * 1e6), PERIOD_NS // 3)
    t_ns = np.concatenate([[0], np.cumsum(took_ns)])
    assert estimate_undisturbed_rate_hz(t_ns.tolist()) == pytest.approx(500.0, rel=0.08)


def seen(nominal_hz: float, true_hz: float, seconds: float = 5.0) -> float | None:
    pace = FrameRateMonitor(nominal_hz)
    for begin in range(0, round(seconds * true_hz), 10):
        seq = np.arange(begin, begin + 10)
        pace.add_batch(
            make_frames(seq, 2, t_mono_ns=np.round(seq / true_hz * 1e9).astype(np.int64))
        )
    return pace.exceeding_rate_hz


@pytest.mark.parametrize(("nominal_hz", "true_hz"), [(256.0, 145.0), (500.0, 500.0), (40.0, 40.5)])
def test_a_rate_that_is_not_exceeded_stands(nominal_hz: float, true_hz: float) -> None:
    assert seen(nominal_hz, true_hz) is None


def test_a_rate_that_is_exceeded_for_seconds_is_found_again() -> None:
    assert seen(145.0, 256.0) == pytest.approx(256.0, rel=0.01)
