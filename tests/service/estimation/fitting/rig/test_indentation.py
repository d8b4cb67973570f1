"""A rig recording reduced to blocks, and its state before the first press."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from devices.chips.mpl115a2 import MPL115A2
from devices.errors import CalibrationError
from service.estimation.fitting.rig.indentation import (
    Indentation,
    average_stroke_blocks,
    extract_loading_points,
    join_loading_points,
    measure_last_second_before_first_load,
)

Segment = tuple[str, list[float], list[float]]
"""Phase, absolute pressures and reference forces; a phase with * is of another tile."""


def record(*segments: Segment, period_ms: float = 10.0, **changes: Any) -> Indentation:
    phase = [name.rstrip("*") for name, kpa, _ in segments for _ in kpa]
    under = [not name.endswith("*") for name, kpa, _ in segments for _ in kpa]
    columns: dict[str, Any] = {
        "serial": "T01",
        "chip": MPL115A2,
        "where": "bench.parquet",
        "t_ns": (np.arange(len(phase)) * period_ms * 1e6).astype(np.int64),
        "kpa": np.array([p for _, kpa, _ in segments for p in kpa]),
        "reference_n": np.array([f for _, _, force in segments for f in force]),
        "phase": np.array(phase),
        "is_under_indenter": np.array(under),
        "temperature_raw": np.full(len(phase), 500.0),
    }
    return Indentation(**columns | changes)


def rest(n: int = 20, kpa: float = 100.0, force_n: float = 0.0) -> Segment:
    return "rest", [kpa] * n, [force_n] * n


def ramp(phase: str, begin: float, end: float, n: int = 60) -> Segment:
    """Pressure 100 kPa + x and force 2 x along a ramp."""
    x = np.linspace(begin, end, n)
    return phase, (100.0 + x).tolist(), (2.0 * x).tolist()


def test_baseline_noise_and_zero_are_of_the_second_before_the_first_press() -> None:
    early = rest(50, kpa=90.0, force_n=9.0)  # more than a second before
    late = ("rest", [99.0, 101.0] * 50, [0.1, 0.3] * 50)
    zero = measure_last_second_before_first_load(record(early, late, ramp("load", 0, 10)))
    assert zero.baseline_kpa == pytest.approx(100.0)
    assert zero.noise_kpa == pytest.approx(np.sqrt(100 / 99))
    assert zero.reference_zero_n == pytest.approx(0.2)


@pytest.mark.parametrize(
    "rest_segment",
    [
        ("rest*", [100.0] * 20, [7.0] * 20),
        ("rest", [100.0] * 20, [np.nan] * 20),
        ("rest", [100.0, np.nan] * 10, [0.0] * 20),
    ],
    ids=["reference over another tile", "reference without readings", "unreadable pressures"],
)
def test_missing_readings_are_in_no_baseline_and_no_zero(rest_segment: Segment) -> None:
    state = measure_last_second_before_first_load(record(rest_segment, ramp("load", 0, 10)))
    assert (state.reference_zero_n, state.baseline_kpa) == (0.0, 100.0)


def test_a_short_rest_before_the_press_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"bench\.parquet, tile T01: only 9 readings"):
        measure_last_second_before_first_load(record(rest(9), ramp("load", 0, 10)))
    assert (
        measure_last_second_before_first_load(record(rest(10), ramp("load", 0, 10))).baseline_kpa
        == 100.0
    )


def test_a_tile_that_is_never_pressed_is_refused() -> None:
    with pytest.raises(CalibrationError, match="never presses this tile"):
        measure_last_second_before_first_load(record(rest(), ("load*", [110.0] * 50, [20.0] * 50)))


def test_a_stroke_is_averaged_in_sixty_blocks_each_way() -> None:
    # 180 readings a ramp, three to a block: the mean of three neighbours is the middle one
    made = average_stroke_blocks(
        record(
            rest(force_n=0.5),
            ("load", (100 + np.arange(180) / 10).tolist(), (0.5 + np.arange(180) / 5).tolist()),
            ("unload", (118 - np.arange(180) / 10).tolist(), (36 - np.arange(180) / 5).tolist()),
        )
    )
    middles = np.arange(1, 180, 3) / 10
    assert made.gauge_kpa == pytest.approx([*middles, *(18 - middles)])
    assert made.force_n == pytest.approx([*(2 * middles), *(35.5 - 2 * middles)])
    assert made.loading.tolist() == [True] * 60 + [False] * 60
    assert made.repeat.tolist() == [0] * 120


@pytest.mark.parametrize("rests", [1, 0])
def test_repeats_are_numbered_in_order_with_or_without_rests(rests: int) -> None:
    one = (ramp("load", 0, 10), ramp("unload", 10, 0), *[rest()] * rests)
    blocks = average_stroke_blocks(record(rest(), *one, *one, *one))
    assert blocks.repeat.tolist() == [0] * 120 + [1] * 120 + [2] * 120


def test_holds_releases_taps_and_soak_are_not_used() -> None:
    fast = (
        ramp("load", 0, 10),
        ramp("hold", 10, 9),
        ramp("release", 9, 0, 5),
        rest(),
        ramp("tap", 0, 5, 4),
        rest(),
        ramp("soak", 0, 1),
    )
    slow = (ramp("load", 0, 10), ramp("unload", 10, 0))
    with_them = average_stroke_blocks(record(rest(), *slow, rest(), *fast))
    without = average_stroke_blocks(record(rest(), *slow))
    assert with_them.gauge_kpa.tolist() == without.gauge_kpa.tolist()
    assert with_them.force_n.tolist() == without.force_n.tolist()
    with pytest.raises(CalibrationError, match="no slow stroke"):
        average_stroke_blocks(record(rest(), *fast))


def test_strokes_on_other_tiles_are_not_used() -> None:
    other = (("load*", [100.0] * 60, [5.0] * 60), ("unload*", [100.0] * 60, [5.0] * 60))
    own = (ramp("load", 0, 10), ramp("unload", 10, 0))
    made = average_stroke_blocks(record(rest(), *other, rest(), *own))
    assert made.force_n.max() == pytest.approx(20.0)
    assert np.unique(made.repeat).tolist() == [0]


def test_missing_readings_shorten_their_block_only() -> None:
    kpa = (100 + np.arange(180) / 10).tolist()
    force_n = (np.arange(180) / 5).tolist()
    kpa[::3] = [np.nan] * 60  # of each block of three one is left out
    back = ramp("unload", 17.9, 0)
    made = average_stroke_blocks(record(rest(), ("load", kpa, force_n), back))
    assert made.loading.sum() == 60
    np.testing.assert_allclose(made.force_n[:60], 2.0 * made.gauge_kpa[:60], rtol=1e-12)


ZERO = (0.0, 0.1)  # of the reference, N; noise, kPa


def record_taps(n: int = 3, *, outlier_at: int | None = None) -> Indentation:
    """Record taps of 15 N and 6 kPa whose top is a single reading, and rest."""
    one_n = np.concatenate([np.zeros(40), [5.0, 10.0, 15.0, 10.0, 5.0]])
    force_n = np.tile(one_n, n)
    kpa = 100.0 + 0.4 * force_n
    if outlier_at is not None:
        kpa[outlier_at] -= 3.0
    return Indentation(
        chip=MPL115A2,
        serial="T01",
        where="taps.parquet",
        t_ns=np.arange(len(force_n), dtype=np.int64) * 3_000_000,
        kpa=kpa,
        reference_n=force_n,
        phase=np.where(force_n > 0.0, "tap", "rest"),
        is_under_indenter=np.ones(len(force_n), dtype=bool),
        temperature_raw=np.full(len(force_n), 500.0),
    )


def test_the_single_reading_at_the_top_of_a_tap_counts() -> None:
    points = extract_loading_points(record_taps(), *ZERO)
    assert np.isfinite(points.kpa[points.force_n == 15.0]).all()


def test_a_spike_without_a_force_is_left_out() -> None:
    points = extract_loading_points(
        record_taps(outlier_at=60), *ZERO
    )  # at rest between the first two taps
    assert np.flatnonzero(np.isnan(points.kpa)).tolist() == [60]


def test_joined_recordings_keep_their_loadings_apart_and_far_apart() -> None:
    one, other = (
        extract_loading_points(record_taps(3), *ZERO),
        extract_loading_points(record_taps(2), *ZERO),
    )
    both = join_loading_points([one, other])
    assert both.n_loadings == one.n_loadings + other.n_loadings == 5
    assert (np.diff(both.t_s) > 0.0).all()
    assert np.diff(both.t_s).max() >= 600.0
    assert both.loading[len(one.t_s)] == one.n_loadings
    np.testing.assert_array_equal(both.kpa, np.concatenate([one.kpa, other.kpa]))


def test_strokes_without_rests_are_separate_loadings() -> None:
    phase = np.repeat(["rest", "load", "unload", "load", "unload", "load", "hold"], 20)
    taps = record_taps(1)
    no_rests = replace(
        taps,
        t_ns=np.arange(len(phase), dtype=np.int64) * 3_000_000,
        kpa=np.full(len(phase), 100.0),
        reference_n=np.zeros(len(phase)),
        phase=phase,
        is_under_indenter=np.ones(len(phase), dtype=bool),
        temperature_raw=np.full(len(phase), 500.0),
    )
    points = extract_loading_points(no_rests, *ZERO)
    assert points.n_loadings == 3
    assert points.is_fast[points.loading == 2].all()
    assert not points.is_fast[points.loading < 2].any()


def test_readings_of_one_instant_are_one_point() -> None:
    taps = record_taps()
    coarse = extract_loading_points(replace(taps, t_ns=taps.t_ns // 12_000_000 * 12_000_000), *ZERO)
    assert (np.diff(coarse.t_s) > 0.0).all()
    assert coarse.force_n.max() > 5.0
    assert coarse.n_loadings == 3
