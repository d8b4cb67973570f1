"""What the indenter's strokes say of a dome."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.domes import DOMES, PAPER_DOME
from service.estimation.fitting.rig.indentation import Strokes
from studies.reproduce.experiments import (
    OVERLOAD_FACTOR,
    compute_repeatability,
    evaluate_dome,
    indent_tile,
    make_dome_scene,
    pool_repeatability,
)

FORCE_N = np.linspace(0.5, 30.0, 60)


def strokes_with(gains: list[float]) -> Strokes:
    """Loadings and unloadings of a concave dome, each loading with a gain of its output."""
    kpa = 9.0 * np.log1p(FORCE_N / 8.0)
    return Strokes(
        gauge_kpa=np.concatenate([gain * kpa for gain in gains for _ in range(2)]),
        force_n=np.tile(FORCE_N, 2 * len(gains)),
        repeat=np.repeat(np.arange(len(gains)), 2 * len(FORCE_N)),
        loading=np.tile(np.repeat([True, False], len(FORCE_N)), len(gains)),
    )


@given(gains=st.lists(st.floats(0.9, 1.1), min_size=2, max_size=8))
def test_the_spread_between_loadings_is_that_of_their_gains(gains: list[float]) -> None:
    expected = np.std(np.array(gains) / np.mean(gains), ddof=1)
    assert compute_repeatability(strokes_with(gains)) == pytest.approx(expected, abs=1e-9)


def test_the_pooled_spread_has_its_truth_in_95_of_100_intervals() -> None:
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(1000):
        spreads = (0.03 * rng.standard_normal((6, 4))).std(axis=1, ddof=1)
        _, (low, high) = pool_repeatability(spreads.tolist(), 4)
        hits += low <= 0.03 <= high
    assert 930 <= hits <= 970


def test_every_dome_is_pressed_past_its_expected_end_and_within_the_indenter_s_range() -> None:
    loads_n = [make_dome_scene(dome).ground.load_n for dome in DOMES]  # type: ignore[union-attr]  # it has one
    assert pytest.approx(max(loads_n), rel=1e-3) == OVERLOAD_FACTOR * 41.65
    assert max(loads_n) < 50.0


@pytest.mark.slow
def test_a_dome_that_is_pressed_is_found_to_saturate_where_it_does() -> None:
    found = evaluate_dome(
        PAPER_DOME, indent_tile(make_dome_scene(PAPER_DOME), seed=0, parts_seed=0)
    )
    assert found.is_full_scale_reached
    assert found.indented_tile.tile.repeats == 4
    full_n, half_n = found.full_scale_n
    # Its slow force at 115 kPa is 30.4 N; creep, loop and loadings make some newtons of that.
    assert 25.0 <= full_n <= 35.0
    assert 0.2 < half_n < 4.0
    assert found.indented_tile.tile.rig is not None
    assert found.indented_tile.tile.rig.r2_of_mean > 0.999
