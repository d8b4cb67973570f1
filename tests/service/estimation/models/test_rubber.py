"""`rubber`: force from what the bubble feels of it while the dome creeps, by closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.models import rubber
from tests.builders.readings import through

PART, TAU_S = (0.05, 0.04), (0.06, 1.1)


def compensated(apparent_n: Any, t_s: Any, *, part: tuple[float, ...] = PART) -> np.ndarray:
    model = rubber.CreepModel(np.array([part]), np.array([TAU_S]))
    t_ns = np.rint(1e9 * np.asarray(t_s, dtype=float)).astype(np.int64)
    seen = np.asarray(apparent_n, dtype=float), t_ns, math.nan, math.nan
    return through(rubber.compensate_creep, model.to_records(), rubber.initial_state(1), *seen)


def crept(t_s: Any) -> Any:
    """How much of a force that came at once appears after so long."""
    return 1 - sum(g * np.exp(-np.asarray(t_s) / tau) for g, tau in zip(PART, TAU_S, strict=True))


@pytest.mark.parametrize("step_s", [0.0001, 0.002, 0.5, 60.0])
def test_a_force_that_came_at_once_is_found_all_the_time_whatever_the_step(step_s: float) -> None:
    t_s = step_s * np.arange(40)
    assert compensated(20.0 * crept(t_s), t_s) == pytest.approx(np.full(40, 20.0), abs=1e-9)


def test_a_force_that_grows_evenly_is_found() -> None:
    # z' = (r t - z)/tau: z = r (t - tau (1 - exp(-t/tau)))
    t_s = np.cumsum([0.0, 0.002, 0.002, 0.3, 0.001, 5.0])
    apparent_n = 3.0 * (
        t_s - sum(g * tau * (1 - np.exp(-t_s / tau)) for g, tau in zip(PART, TAU_S, strict=True))
    )
    assert compensated(apparent_n, t_s) == pytest.approx(3.0 * t_s, abs=1e-9)


def test_a_force_that_has_lasted_is_felt_whole() -> None:
    out = compensated([20.0] * 3000, 0.01 * np.arange(3000))
    assert out[-1] == pytest.approx(20.0, abs=1e-9)


def test_a_minute_without_readings_is_a_minute_of_creep() -> None:
    t_s = np.array([0.0, 60.0, 60.002])
    out = compensated([20.0 * crept(0.0), 20.0, 20.0], t_s)
    assert out == pytest.approx([20.0, 20.0, 20.0], abs=1e-9)


@pytest.mark.parametrize("nothing", [math.nan, math.inf, -math.inf])
def test_what_is_no_force_is_nan_and_changes_nothing_after_it(nothing: float) -> None:
    t_s, apparent_n = 0.002 * np.arange(9), 3.0 * np.arange(9)
    apparent_n[4] = nothing
    rest = np.arange(9) != 4
    out = compensated(apparent_n, t_s)
    assert np.isnan(out).tolist() == (~rest).tolist()
    assert out[rest].tolist() == compensated(apparent_n[rest], t_s[rest]).tolist()


def test_readings_at_one_instant_and_back_in_time_creep_nothing() -> None:
    # apparent = F - sum g F at once
    out = compensated([9.1, 9.1, 18.2], [1.0, 1.0, 0.2])
    assert out == pytest.approx([10.0, 10.0, 20.0], abs=1e-9)


def test_without_creeping_parts_force_is_what_appears() -> None:
    apparent_n = np.sin(np.arange(20.0))
    assert (
        compensated(apparent_n, 0.002 * np.arange(20), part=(0.0, 0.0)).tolist()
        == apparent_n.tolist()
    )


@given(
    apparent_n=st.lists(st.floats(-50.0, 50.0), min_size=1, max_size=60),
    steps_s=st.lists(st.sampled_from([0.0, 1e-9, 1e-6, 0.002, 0.1, 60.0, 1e5]), min_size=60),
)
def test_it_is_stable_for_any_steps(apparent_n: list[float], steps_s: list[float]) -> None:
    # |apparent| >= |F| - sum g (|F| + |z|), and no |z| is above the greatest |F|.
    out = compensated(apparent_n, np.cumsum(steps_s)[: len(apparent_n)])
    assert np.abs(out).max() <= np.abs(apparent_n).max() / (1 - 2 * sum(PART)) + 1e-9
