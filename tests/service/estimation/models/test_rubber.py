"""`rubber`: the force on a dome while it creeps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.models import rubber
from tests.builders.readings import make_rubber, through

PART, TAU_S = (0.05, 0.04), (0.06, 1.1)


def compensate(apparent_n: Any, t_s: Any) -> np.ndarray:
    model = make_rubber(PART, TAU_S)
    t_ns = np.rint(1e9 * np.asarray(t_s, dtype=float)).astype(np.int64)
    readings = np.asarray(apparent_n, dtype=float), t_ns, math.nan, math.nan
    return through(rubber.compensate_creep, model, rubber.RubberState.array(1), *readings)


@given(
    apparent_n=st.lists(st.floats(-50.0, 50.0), min_size=1, max_size=60),
    steps_s=st.lists(st.sampled_from([0.0, 1e-9, 1e-6, 0.002, 0.1, 60.0, 1e5]), min_size=60),
)
def test_the_compensation_is_stable_for_any_steps(
    apparent_n: list[float], steps_s: list[float]
) -> None:
    # |apparent| >= |F| - sum g (|F| + |z|), and no |z| is above the greatest |F|.
    out = compensate(apparent_n, np.cumsum(steps_s)[: len(apparent_n)])
    assert np.abs(out).max() <= np.abs(apparent_n).max() / (1 - 2 * sum(PART)) + 1e-9
