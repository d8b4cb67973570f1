"""The servo's position at a frame's own instant: by hand, and against a loop over the frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.flags import FrameFlag
from devices.frames import NO_SERVO_COUNTS, FrameBatch
from service.estimation.estimate import Estimator
from service.estimation.foot.geometry import (
    ServoReading,
    interpolate_servo_counts,
    store_servo_reading_and_flag_wraps,
)
from service.estimation.records import RecordArray
from tests.builders.arrays import array_at, make_servo
from tests.builders.estimates import newton_plan
from tests.builders.frames import loaded_frames

TURN = 4096
MS = 1_000_000
US = 1000
STALE = FrameFlag.SERVO_STALE


def carried(
    t_ns: Sequence[int],
    readings: Sequence[tuple[int, int] | None],
    frame_flags: Sequence[int] | None = None,
    tiles: int = 1,
) -> FrameBatch:
    """Frames at `t_ns`, each with a reading (instant, counts) or none."""
    n = len(t_ns)
    columns: dict[str, Any] = {
        "t_mono_ns": t_ns,
        "servo_counts": [NO_SERVO_COUNTS if r is None else r[1] for r in readings],
        "servo_age_us": [
            -1 if r is None else (t - r[0]) // US for t, r in zip(t_ns, readings, strict=True)
        ],
        "frame_flags": [0] * n if frame_flags is None else frame_flags,
    }
    return loaded_frames(np.zeros((n, tiles)), **columns)


def readings_of(frames: FrameBatch, broken: Sequence[bool]) -> RecordArray[ServoReading]:
    """Store the servo readings of frames, some of them after a gap."""
    readings = ServoReading.array(len(frames))
    for i, after_gap in enumerate(broken):
        store_servo_reading_and_flag_wraps(
            readings,
            i,
            frames.t_mono_ns[i],
            int(frames.servo_counts[i]),
            int(frames.servo_age_us[i]),
            frames.frame_flags[i],
            TURN,
            bool(after_gap),
        )
    return readings


def positions(
    frames: FrameBatch, lag_ms: float, broken: Sequence[bool] | None = None
) -> list[float]:
    readings = readings_of(frames, [False] * len(frames) if broken is None else broken)
    n = len(frames)
    return [float(interpolate_servo_counts(readings, i, n, round(lag_ms * MS))) for i in range(n)]


# Frames every 2 ms; readings at 0 and 8 ms, each known half a millisecond later.
T_NS = [1 * MS, 3 * MS, 5 * MS, 7 * MS, 9 * MS, 11 * MS]
SLOW = [(0, 100)] * 4 + [(8 * MS, 900)] * 2


def test_between_two_readings_the_position_is_on_the_line_that_joins_them() -> None:
    frames = carried(T_NS, SLOW)
    assert positions(frames, 100) == pytest.approx([200, 400, 600, 800, 900, 900])


@pytest.mark.parametrize(
    ("lag_ms", "expected"),
    [
        (0, [100, 100, 100, 100, 900, 900]),
        (2, [100, 100, 100, 800, 900, 900]),
        (5.9, [100, 100, 600, 800, 900, 900]),
        (6, [100, 400, 600, 800, 900, 900]),
    ],
)
def test_a_reading_beyond_the_look_ahead_is_not_known_and_the_one_before_is_held(
    lag_ms: float, expected: list[float]
) -> None:
    assert positions(carried(T_NS, SLOW), lag_ms) == pytest.approx(expected)


def test_a_reading_that_was_on_its_way_is_the_one_before() -> None:
    # The frame at 5 ms still carries the reading of 0, but that of 4 ms was sampled before it.
    t_ns = [3 * MS, 5 * MS, 7 * MS, 9 * MS]
    frames = carried(t_ns, [(0, 0), (0, 0), (4 * MS, 400), (8 * MS, 1200)])
    assert positions(frames, 100) == pytest.approx([300, 600, 1000, 1200])
    assert positions(frames, 2) == pytest.approx([0, 400, 1000, 1200])


def test_a_stale_position_is_unknown_and_nothing_reaches_across_it() -> None:
    frames = carried(T_NS, SLOW, frame_flags=[0, 0, STALE, STALE, 0, 0])
    expected = [100, 100, np.nan, np.nan, 900, 900]
    assert positions(frames, 100) == pytest.approx(expected, nan_ok=True)


def test_no_reading_is_unknown_and_nothing_reaches_across_it() -> None:
    frames = carried(T_NS, [SLOW[0], SLOW[1], None, *SLOW[3:]])
    expected = [100, 100, np.nan, 800, 900, 900]
    assert positions(frames, 100) == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize("gap_at", [2, 3, 4])
def test_nothing_reaches_across_a_gap(gap_at: int) -> None:
    frames = carried(T_NS, SLOW)
    broken = [i == gap_at for i in range(6)]
    line = [200, 400, 600, 800]
    expected = [100.0] * gap_at + line[gap_at:] + [900, 900]
    assert positions(frames, 100, broken) == pytest.approx(expected)


def test_a_turn_that_ends_is_not_a_way_back() -> None:
    # A single-turn servo goes from 4095 to 0; the line between them would be half a turn off.
    frames = carried(T_NS, [(0, 4090)] * 4 + [(8 * MS, 6)] * 2)
    assert positions(frames, 100) == [4090] * 4 + [6] * 2


def test_a_position_of_unknown_age_is_held() -> None:
    frames = loaded_frames(np.zeros((3, 1)), servo_counts=[7, 70, 700])
    assert positions(frames, 100) == [7, 70, 700]


def test_ages_cut_to_microseconds_make_no_new_readings() -> None:
    t_ns = [1_000_000, 3_000_999, 5_000_500, 7_000_001, 9_000_000]
    frames = carried(t_ns, [(123, 100)] * 4 + [(8_000_123, 900)])
    readings = readings_of(frames, [False] * 5)
    assert readings["is_new"].tolist() == [1, 0, 0, 0, 1]
    assert readings["is_next"].tolist() == [0, 0, 0, 0, 1]


def loop(readings: RecordArray[ServoReading], lag_ns: int) -> list[float]:
    """What `interpolate_servo_counts` says, frame by frame."""
    result = []
    n = len(readings["t_ns"])
    for i in range(n):
        t_ns = int(readings["t_ns"][i])
        here, after = i, None
        for j in range(i + 1, n):
            if readings["t_ns"][j] > t_ns + lag_ns or (
                readings["is_new"][j] and not readings["is_next"][j]
            ):
                break
            if readings["is_next"][j]:
                if readings["sampled_ns"][j] > t_ns:
                    after = j
                    break
                if here != i:
                    break
                here = j
        counts = float(readings["counts"][here])
        if after is not None:
            begin_ns, end_ns = int(readings["sampled_ns"][here]), int(readings["sampled_ns"][after])
            part = (t_ns - begin_ns) / (end_ns - begin_ns)
            counts += part * int(readings["counts"][after] - readings["counts"][here])
        result.append(counts if readings["is_valid"][i] else np.nan)
    return result


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(data=st.data(), lag_ms=st.sampled_from([0, 3, 10, 100]))
def test_any_readings_give_what_a_loop_over_the_frames_gives(
    data: st.DataObject, lag_ms: int
) -> None:
    n = data.draw(st.integers(1, 30))

    def drawn(values: st.SearchStrategy[int]) -> list[int]:
        return data.draw(st.lists(values, min_size=n, max_size=n))

    t_ns = np.cumsum(drawn(st.integers(1, 4_000_000)))
    frames = loaded_frames(
        np.zeros((n, 1)),
        t_mono_ns=t_ns,
        servo_counts=drawn(st.sampled_from([NO_SERVO_COUNTS, -5, 0, 7, 7, 7, 900, 4095])),
        servo_age_us=drawn(st.integers(-1, 3) | st.integers(0, 12_000)),
        frame_flags=drawn(st.sampled_from([0] * 8 + [STALE])),
    )
    broken = data.draw(st.lists(st.sampled_from([False] * 8 + [True]), min_size=n, max_size=n))
    expected = loop(readings_of(frames, broken), lag_ms * MS)
    found = positions(frames, lag_ms, broken)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9, equal_nan=True)


@settings(deadline=None)
@given(
    start=st.integers(-28_672, 28_672),
    counts_per_s=st.integers(-5000, 5000),
    period_us=st.integers(2000, 15_000),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_steady_turn_is_followed_to_a_count_over_any_number_of_turns(
    start: int, counts_per_s: int, period_us: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    t_ns = 20 * MS + np.cumsum(rng.integers(1_800_000, 3_200_000, 60))
    true = start + counts_per_s * t_ns * 1e-9
    known_ns = t_ns - 700 * US  # an answer takes so long
    sampled_ns = known_ns // (period_us * US) * period_us * US
    counts = np.floor(start + counts_per_s * sampled_ns * 1e-9).astype(np.int64)
    frames = carried(t_ns.tolist(), list(zip(sampled_ns.tolist(), counts.tolist(), strict=True)))
    at = positions(frames, 100)
    followed = t_ns < sampled_ns[-1]
    assert np.abs(at - true)[followed].max(initial=0.0) <= 1.01


def test_an_estimate_turns_with_the_servo_between_its_readings() -> None:
    servo = make_servo(counts_per_turn=TURN, zero_counts=100, sign=-1, ratio=0.1)
    plan = newton_plan(array_at([(0.0, 0.0, -0.15), (0.02, 0.0, -0.15)], servo=servo), lag_ms=6)
    frames = carried(T_NS, SLOW, tiles=2)
    estimator = Estimator(plan)
    estimates, last = estimator.process_frames(frames), estimator.finish()
    assert last is not None
    angle_rad = np.concatenate([estimates.angle_rad, last.angle_rad])
    expected = -0.1 * 2 * np.pi * np.array([0, 300, 500, 700, 800, 800]) / TURN
    assert angle_rad == pytest.approx(expected, abs=1e-15)
