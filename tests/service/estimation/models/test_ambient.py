"""`ambient`: a bare tile tells of weather and water."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import UsageError
from service.estimation.models.ambient import SMOOTHING_S, initial_state, low_pass_ambient_kpa
from tests.builders.arrays import array_at
from tests.builders.calibrations import make_effects, newton_tile
from tests.builders.estimates import newton_plan
from tests.builders.readings import through


def head(kpa: Any, t_s: Any) -> np.ndarray:
    """Averaged pressure around the foot."""
    t_ns = np.rint(1e9 * np.asarray(t_s, dtype=float)).astype(np.int64)
    return through(low_pass_ambient_kpa, None, initial_state(), np.asarray(kpa, dtype=float), t_ns)


def test_water_that_comes_at_once_is_known_after_thirty_milliseconds_to_two_thirds() -> None:
    t_s = np.array([0.0, 0.001, 0.031, 0.061, 60.0])
    expected = 1 - np.exp(-t_s[1:] / SMOOTHING_S)
    assert head([0.0, 1.0, 1.0, 1.0, 1.0], t_s)[1:] == pytest.approx(expected, abs=1e-9)


def test_the_first_reading_counts_at_once_and_the_last_holds_for_a_while() -> None:
    out = head([math.nan, 0.7, math.nan, math.inf, math.nan], 0.06 * np.arange(5))
    assert np.isnan(out[0])
    assert out[1:].tolist() == [0.7] * 4


@pytest.mark.parametrize("back_s", [0.0, 0.001, 60.0])
def test_time_that_stands_still_or_goes_back_changes_nothing(back_s: float) -> None:
    assert head([0.0, 0.0, 1.0], [0.0, 100.0, 100.0 - back_s]).tolist() == [0.0] * 3


@given(
    kpa=st.lists(st.floats(-5, 5), min_size=1, max_size=40),
    step_s=st.sampled_from([-60.0, 0.0, 1e-9, 0.002, 60.0]),
)
def test_it_is_never_outside_what_was_read(kpa: list[float], step_s: float) -> None:
    out = head(kpa, step_s * np.arange(len(kpa)))
    assert (out >= min(kpa) - 1e-12).all()
    assert (out <= max(kpa) + 1e-12).all()


def test_a_dome_passes_on_what_its_wall_gives_way_to() -> None:
    # hardware.md 9: c p/(1 + c p), a ninth of it with 0.00124 per kPa at 100 kPa
    tiles = [newton_tile("T01", effects=make_effects())]
    bare = array_at([(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)], references=[1])
    plan = newton_plan(bare, models=("static", "ambient"), tiles=tiles)
    assert plan.model_set.ambient is not None
    give = 0.0013 * plan.baseline_kpa[0]
    assert plan.model_set.ambient.transmitted_fraction == pytest.approx([give / (1 + give)])
    assert plan.model_set.ambient.relative_sigma == pytest.approx(0.0002 / 0.0013)
    with pytest.raises(UsageError, match="bare reference tile"):
        newton_plan(array_at([(0.0, 0.0, 0.0)]), models=("static", "ambient"), tiles=tiles)


def test_a_bare_tile_that_falls_silent_is_believed_for_a_fifth_of_a_second() -> None:
    t_ns = np.arange(300, dtype=np.int64) * 2_000_000
    kpa = np.where(np.arange(300) < 100, 1.0, np.nan)
    state = initial_state()
    head_kpa = through(low_pass_ambient_kpa, None, state, kpa, t_ns)
    assert head_kpa[:200] == pytest.approx(1.0)
    assert np.isnan(head_kpa[200:]).all()
    later = through(low_pass_ambient_kpa, None, state, 2.0, t_ns[-1] + t_ns[1:10])
    assert np.isfinite(later).all(), "and again as soon as it speaks"
