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
from service.estimation.foot import (
    ServoReading,
    interpolate_servo_counts,
    store_servo_reading_and_link_to_previous,
)
from service.estimation.records import RecordArray
from tests.builders.arrays import array_at, make_servo
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import loaded_frames

TURN = 4096
MS = 1_000_000
STALE = FrameFlag.SERVO_STALE


def make_frames(
    t_ns: Sequence[int],
    readings: Sequence[tuple[int, int] | None],
    frame_flags: Any = 0,
    tiles: int = 1,
) -> FrameBatch:
    """Make frames at `t_ns`, each with a reading (instant, counts) or none."""
    pairs = list(zip(t_ns, readings, strict=True))
    return loaded_frames(
        np.zeros((len(t_ns), tiles)),
        t_mono_ns=t_ns,
        servo_counts=[NO_SERVO_COUNTS if r is None else r[1] for r in readings],
        servo_age_us=[-1 if r is None else (t - r[0]) // 1000 for t, r in pairs],
        frame_flags=frame_flags,
    )


def store_readings(
    frames: FrameBatch, broken: Sequence[bool] | None = None
) -> RecordArray[ServoReading]:
    """Store the servo readings of frames, some of them after a gap."""
    readings = ServoReading.array(len(frames))
    for i in range(len(frames)):
        store_servo_reading_and_link_to_previous(
            readings, i, frames.t_mono_ns[i], int(frames.servo_counts[i]),
            int(frames.servo_age_us[i]), frames.frame_flags[i], TURN,
            broken is not None and bool(broken[i]),
        )  # fmt: skip
    return readings


def interpolate(
    frames: FrameBatch, lag_ms: float = 100, broken: Sequence[bool] | None = None
) -> list[float]:
    readings, n = store_readings(frames, broken), len(frames)
    return [float(interpolate_servo_counts(readings, i, n, round(lag_ms * MS))) for i in range(n)]


# Frames every 2 ms; readings at 0 and 8 ms, each known half a millisecond later.
T_NS = [1 * MS, 3 * MS, 5 * MS, 7 * MS, 9 * MS, 11 * MS]
SLOW = [(0, 100)] * 4 + [(8 * MS, 900)] * 2


@pytest.mark.parametrize(
    ("lag_ms", "expected"),
    [
        (0, [100, 100, 100, 100, 900, 900]),
        (2, [100, 100, 100, 800, 900, 900]),
        (5.9, [100, 100, 600, 800, 900, 900]),
        (6, [100, 400, 600, 800, 900, 900]),
        (100, [200, 400, 600, 800, 900, 900]),
    ],
)
def test_a_position_is_interpolated_within_the_look_ahead(
    lag_ms: float, expected: list[float]
) -> None:
    assert interpolate(make_frames(T_NS, SLOW), lag_ms) == pytest.approx(expected)


def test_a_position_begins_at_the_newest_reading_before_its_frame() -> None:
    # The frame at 5 ms still carries the reading of 0, but that of 4 ms was sampled before it.
    t_ns = [3 * MS, 5 * MS, 7 * MS, 9 * MS]
    frames = make_frames(t_ns, [(0, 0), (0, 0), (4 * MS, 400), (8 * MS, 1200)])
    assert interpolate(frames) == pytest.approx([300, 600, 1000, 1200])
    assert interpolate(frames, 2) == pytest.approx([0, 400, 1000, 1200])


@pytest.mark.parametrize(
    ("readings", "frame_flags", "gap_at", "expected"),
    [
        (SLOW, [0, 0, STALE, STALE, 0, 0], None, [100, 100, np.nan, np.nan, 900, 900]),
        ([*SLOW[:2], None, *SLOW[3:]], 0, None, [100, 100, np.nan, 800, 900, 900]),
        (SLOW, 0, 2, [100, 100, 600, 800, 900, 900]),
        (SLOW, 0, 4, [100, 100, 100, 100, 900, 900]),
        # A single-turn servo goes from 4095 to 0; the line between them would be half a turn off.
        ([(0, 4090)] * 4 + [(8 * MS, 6)] * 2, 0, None, [4090] * 4 + [6] * 2),
    ],
    ids=["stale", "no reading", "a gap before a reading", "a gap at a reading", "end of a turn"],
)
def test_no_line_crosses_an_unknown_position(
    readings: list[tuple[int, int] | None],
    frame_flags: Any,
    gap_at: int | None,
    expected: list[float],
) -> None:
    frames = make_frames(T_NS, readings, frame_flags)
    found = interpolate(frames, broken=[i == gap_at for i in range(6)])
    assert found == pytest.approx(expected, nan_ok=True)


def test_a_position_of_unknown_age_stays() -> None:
    frames = loaded_frames(np.zeros((3, 1)), servo_counts=[7, 70, 700])
    assert interpolate(frames) == [7, 70, 700]


def test_ages_rounded_to_microseconds_are_no_new_readings() -> None:
    t_ns = [1_000_000, 3_000_999, 5_000_500, 7_000_001, 9_000_000]
    readings = store_readings(make_frames(t_ns, [(123, 100)] * 4 + [(8_000_123, 900)]))
    assert readings["is_new"].tolist() == [1, 0, 0, 0, 1]
    assert readings["is_next"].tolist() == [0, 0, 0, 0, 1]


def interpolate_plainly(readings: RecordArray[ServoReading], lag_ns: int) -> list[float]:
    """Interpolate counts by a search of every frame for its two readings."""
    result = []
    for i in range(len(readings)):
        t_ns = int(readings["t_ns"][i])
        here, after = i, None
        for j in range(i + 1, len(readings)):
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
@settings(max_examples=150, deadline=None)
@given(data=st.data(), lag_ms=st.sampled_from([0, 3, 10, 100]))
def test_any_readings_are_interpolated_as_by_a_loop(data: st.DataObject, lag_ms: int) -> None:
    n = data.draw(st.integers(1, 30))

    def draw(values: st.SearchStrategy[Any]) -> list[Any]:
        return data.draw(st.lists(values, min_size=n, max_size=n))

    frames = loaded_frames(
        np.zeros((n, 1)),
        t_mono_ns=np.cumsum(draw(st.integers(1, 4_000_000))),
        servo_counts=draw(st.sampled_from([NO_SERVO_COUNTS, -5, 0, 7, 7, 7, 900, 4095])),
        servo_age_us=draw(st.integers(-1, 3) | st.integers(0, 12_000)),
        frame_flags=draw(st.sampled_from([0] * 8 + [STALE])),
    )
    broken = draw(st.sampled_from([False] * 8 + [True]))
    expected = interpolate_plainly(store_readings(frames, broken), lag_ms * MS)
    found = interpolate(frames, lag_ms, broken)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9, equal_nan=True)


@settings(max_examples=50, deadline=None)
@given(
    start=st.integers(-28_672, 28_672),
    counts_per_s=st.integers(-5000, 5000),
    period_us=st.integers(2000, 15_000),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_steady_turn_is_followed_to_a_count(
    start: int, counts_per_s: int, period_us: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    t_ns = 20 * MS + np.cumsum(rng.integers(1_800_000, 3_200_000, 60))
    true = start + counts_per_s * t_ns * 1e-9
    known_ns = t_ns - 700_000  # an answer takes so long
    sampled_ns = known_ns // (period_us * 1000) * period_us * 1000
    counts = np.floor(start + counts_per_s * sampled_ns * 1e-9).astype(np.int64)
    readings = list(zip(sampled_ns.tolist(), counts.tolist(), strict=True))
    off = np.abs(interpolate(make_frames(t_ns.tolist(), readings)) - true)
    assert off[t_ns < sampled_ns[-1]].max(initial=0.0) <= 1.01


def test_an_estimate_interpolates_the_servo() -> None:
    servo = make_servo(counts_per_turn=TURN, zero_counts=100, sign=-1, ratio=0.1)
    plan = newton_plan(array_at([(0.0, 0.0, -0.15), (0.02, 0.0, -0.15)], servo=servo), lag_ms=6)
    angle_rad = estimate(plan, make_frames(T_NS, SLOW, tiles=2)).angle_rad
    expected = -0.1 * 2 * np.pi * np.array([0, 300, 500, 700, 800, 800]) / TURN
    assert angle_rad == pytest.approx(expected, abs=1e-15)
