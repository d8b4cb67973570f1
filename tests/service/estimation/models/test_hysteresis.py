"""`hysteresis`: compensation of the rubber's loop."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from service.estimation.models import hysteresis
from service.estimation.models.hysteresis import LOOP_OPENING, WIDTHS_N
from tests.builders.readings import through

PART = (0.05, 0.04, 0.03)


def compensate(apparent_n: list[float], part: tuple[float, ...] = PART) -> np.ndarray:
    model = hysteresis.HysteresisParams.array(1, play_weights=[part])
    readings = np.array(apparent_n, dtype=float), math.nan
    kernel = hysteresis.compensate_hysteresis
    return through(kernel, model, hysteresis.HysteresisState.array(1), *readings)


@given(
    force_n=st.lists(st.floats(-5.0, 60.0), min_size=1, max_size=40),
    part=st.sampled_from([PART, (0.3, 0.3, 0.3), (0.0, 0.0, 0.0), (0.0, 0.0, 0.98)]),
)
@example(force_n=[1e-300, 1e-9, 1e9, 1e-9, 5.0, 1e300], part=PART)
def test_forces_are_recovered_from_their_loop(
    force_n: list[float], part: tuple[float, ...]
) -> None:
    plays, apparent_n = [0.0] * len(part), []
    for force in force_n:
        for m, width in enumerate(WIDTHS_N):
            half = min(width, LOOP_OPENING * force) if force > 0.0 else 0.0
            plays[m] = min(max(plays[m], force - half), force + half)
        lag_n = sum(w * (play - force) for w, play in zip(part, plays, strict=True))
        apparent_n.append(force + lag_n)
    assert compensate(apparent_n, part) == pytest.approx(force_n, abs=1e-11, rel=1e-12)


@given(st.lists(st.floats(-1.0, 50.0), min_size=2, max_size=30), st.floats(0.0, 1.0))
def test_more_apparent_force_is_more_force(apparent_n: list[float], more_n: float) -> None:
    last_n = compensate([*apparent_n, apparent_n[-1]])[-1]
    assert compensate([*apparent_n, apparent_n[-1] + more_n])[-1] >= last_n - 1e-12
