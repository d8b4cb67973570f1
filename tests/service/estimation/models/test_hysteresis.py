"""`hysteresis`: the loop of the rubber undone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.models import hysteresis
from service.estimation.models.hysteresis import LOOP_OPENING, WIDTHS_N
from tests.builders.readings import through

PART = (0.05, 0.04, 0.03)


def looped(force_n: list[float], part: tuple[float, ...]) -> list[float]:
    """What appears of forces: every play is dragged along when the force leaves it behind."""
    plays = [0.0] * len(part)
    apparent = []
    for force in force_n:
        for m, width in enumerate(WIDTHS_N):
            half = min(width, LOOP_OPENING * force) if force > 0.0 else 0.0
            if plays[m] < force - half:
                plays[m] = force - half
            elif plays[m] > force + half:
                plays[m] = force + half
        apparent.append(force + sum(w * (y - force) for w, y in zip(part, plays, strict=True)))
    return apparent


def compensated(apparent_n: list[float], part: tuple[float, ...] = PART) -> np.ndarray:
    laws = hysteresis.HysteresisModel(np.array([part])).to_records()
    felt_n = np.array(apparent_n, dtype=float)
    return through(
        hysteresis.compensate_hysteresis, laws, hysteresis.initial_state(1), felt_n, math.nan
    )


@given(
    force_n=st.lists(st.floats(-5.0, 60.0), min_size=1, max_size=40),
    part=st.sampled_from([PART, (0.3, 0.3, 0.3), (0.0, 0.0, 0.0), (0.0, 0.0, 0.98)]),
)
def test_forces_come_back_from_what_is_felt_of_them(
    force_n: list[float], part: tuple[float, ...]
) -> None:
    assert compensated(looped(force_n, part), part) == pytest.approx(force_n, abs=1e-9)


def test_on_the_first_way_up_the_plays_lag_by_as_much_as_they_have_opened() -> None:
    # All open at 0.4 F until the narrowest is at its width, which is at 1.5 N.
    force_n = np.linspace(0.0, WIDTHS_N[0] / LOOP_OPENING, 20)
    apparent_n = force_n * (1 - LOOP_OPENING * sum(PART))
    assert compensated(apparent_n.tolist()) == pytest.approx(force_n, abs=1e-12)


def test_far_up_and_down_the_branches_are_twice_the_widths_apart() -> None:
    width_n = sum(w * r for w, r in zip(PART, WIDTHS_N, strict=True))
    out = compensated([30.0, 50.0, 30.0])
    assert out[0] - out[2] == pytest.approx(2 * width_n, abs=1e-12)
    assert out[1] == pytest.approx(50.0 + width_n, abs=1e-12)


def test_without_load_nothing_is_hidden_and_the_loop_begins_anew() -> None:
    out = compensated([30.0, 3.0, 0.0, -2.0, 0.0, 0.7])
    assert out[2:5].tolist() == [0.0, -2.0, 0.0]
    assert out[5] == compensated([0.7])[0]


@given(st.lists(st.floats(-1.0, 50.0), min_size=2, max_size=30), st.floats(0.0, 1.0))
def test_more_apparent_force_is_more_force(apparent_n: list[float], more_n: float) -> None:
    assert (
        compensated([*apparent_n, apparent_n[-1] + more_n])[-1]
        >= compensated([*apparent_n, apparent_n[-1]])[-1] - 1e-12
    )


@pytest.mark.parametrize("nothing", [math.nan, math.inf, -math.inf])
def test_what_is_no_force_is_nan_and_changes_nothing_after_it(nothing: float) -> None:
    apparent_n = [0.0, 10.0, 30.0, nothing, 20.0, 5.0]
    out = compensated(apparent_n)
    assert np.isnan(out).tolist() == [False] * 3 + [True] + [False] * 2
    rest = [0, 1, 2, 4, 5]
    assert out[rest].tolist() == compensated([apparent_n[i] for i in rest]).tolist()


def test_forces_of_any_size_are_found() -> None:
    force_n = [1e-300, 1e-9, 1e9, 1e-9, 5.0, 1e300]
    assert compensated(looped(force_n, PART)) == pytest.approx(force_n, rel=1e-12)
