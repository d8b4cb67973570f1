"""Rounding of estimates: its steps, its error, and the same bits always.

Tiles read one newton a count (see tests/builders), but for the curved ones.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.estimation.pipeline.plan import EstimationPlan, make_plan
from service.estimation.quantization import STEPS_PER_SIGMA, Quantization
from service.estimation.records import Estimates
from service.estimation.tare.tare import Tare
from tests.builders.arrays import COUNT_KPA, UTC_NS, array_at, make_servo
from tests.builders.calibrations import make_calibration, make_effects, make_tare, newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import loaded_frames
from tests.service.estimation.feet import SQUARE, draw_wild_frames

SIGMA_OF = {
    "force_n": "force_sigma_n",
    "force_sigma_n": "force_sigma_n",
    "grf_n": "grf_sigma_n",
    "grf_sigma_n": "grf_sigma_n",
    "grf_lower_bound_n": "grf_sigma_n",
    **dict.fromkeys(("cop_x_m", "cop_sigma_x_m", "cop_ground_x_m"), "cop_sigma_x_m"),
    **dict.fromkeys(("cop_y_m", "cop_sigma_y_m", "cop_ground_y_m"), "cop_sigma_y_m"),
}
"""Standard uncertainty that decides on the step of a column."""
LADDERS = [
    ("unwrap", "static"),
    ("static", "denoise"),
    ("static", "skew", "denoise"),
    ("unwrap", "temperature", "gas", "static", "skew", "denoise", "hysteresis", "rubber"),
]
INFO = array_at(SQUARE, servo=make_servo())
Columns = dict[str, np.ndarray]


def plan_with(
    models: Sequence[str] = ("static",),
    noise_counts: float | Sequence[float] = 1.0,
    lag_ms: float = 0.0,
    *,
    bend: float = 0.0,
) -> EstimationPlan:
    curve = (0.0, 1.0, bend, 0.0)
    tiles = [
        newton_tile(serial, coefficients=curve, relative_misfit=0.01, effects=make_effects())
        for serial in INFO.serials
    ]
    noise_kpa = COUNT_KPA * np.array(noise_counts)
    tare = make_tare(4, noise_kpa=noise_kpa, baseline_sigma_kpa=noise_kpa / 20.0)
    return make_plan(INFO, make_calibration(*tiles), tare, models=models, lag_ms=lag_ms)


def list_columns(estimates: Estimates) -> Columns:
    return {f.name: getattr(estimates, f.name) for f in fields(estimates)}


def list_steps(*plans: EstimationPlan) -> dict[str, float]:
    return Quantization.for_plans(plans).collect_flat_column_steps()


def assert_same_bits(one: Columns, other: Columns) -> None:
    assert list(one) == list(other)
    for name, values in one.items():
        assert values.tobytes() == other[name].tobytes(), name


@settings(max_examples=25, deadline=None)
@given(
    models=st.sampled_from(LADDERS),
    noise_counts=st.lists(st.floats(0.2, 3.0), min_size=4, max_size=4),
    lag_ms=st.sampled_from([0.0, 10.0, 100.0]),
    bend=st.sampled_from([0.0, 0.002, -0.002]),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_step_is_a_power_of_two_and_at_most_an_eighth_of_sigma(
    models: tuple[str, ...], noise_counts: list[float], lag_ms: float, bend: float, seed: int
) -> None:
    plan = plan_with(models, noise_counts, lag_ms, bend=bend)
    steps = Quantization.for_plans([plan]).steps
    rng = np.random.default_rng(seed)
    level_n = np.repeat(rng.choice([0.0, 3.0, 20.0, 60.0], (6, 4)), 100, axis=0)
    forces_n = level_n + rng.normal(0.0, 1.0, (600, 4)) * noise_counts
    found = list_columns(estimate(plan, loaded_frames(forces_n)))
    for name, of in SIGMA_OF.items():
        least = np.where(np.isnan(found[of]), np.inf, found[of]).min(axis=0)
        assert np.all(np.frexp(steps[name])[0] == 0.5), name
        assert np.all(steps[name] <= least / STEPS_PER_SIGMA * (1.0 + 1e-12)), name
    assert np.all(
        steps["gauge_kpa"]
        <= plan.load_bearing_params["noise_kpa"] * np.hypot(1.0, 0.05) / STEPS_PER_SIGMA
    )


def test_the_steps_suit_a_foot_at_rest() -> None:
    # Unloaded, with all possible averaging, sigma is the least.
    plan = plan_with(("static", "denoise"), lag_ms=100.0)
    steps = Quantization.for_plans([plan]).steps
    found = estimate(plan, loaded_frames(np.random.default_rng(0).normal(0.0, 1.0, (600, 4))))
    assert (steps["force_n"] > np.nanmin(found.force_sigma_n, axis=0) / STEPS_PER_SIGMA / 3.0).all()
    assert (steps["grf_n"] > np.nanmin(found.grf_sigma_n) / STEPS_PER_SIGMA / 3.0).all()


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.integers(-30, 30))
def test_rounding_moves_values_by_half_a_step_and_only_once(seed: int, scale: int) -> None:
    rounding = Quantization.for_plans([plan_with()])
    rng = np.random.default_rng(seed)
    odd = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1e300, -1e-300])
    columns = {}
    for name, steps in rounding.steps.items():
        shape = (50, len(steps)) if len(steps) > 1 else (50,)
        values = rng.normal(0.0, 2.0**scale, shape)
        columns[name] = np.where(rng.random(shape) < 0.2, rng.choice(odd, shape), values)
    rounded = rounding.round_to_steps(columns)
    assert_same_bits(rounding.round_to_steps(rounded), rounded)
    small = {n: np.where(np.abs(v) < 1e30, v, np.nan) for n, v in rounded.items()}
    in_file = {name: values.astype(np.float32) for name, values in small.items()}
    again = rounding.round_to_steps({name: v.astype(np.float64) for name, v in in_file.items()})
    assert_same_bits({name: values.astype(np.float32) for name, values in again.items()}, in_file)
    for name, values in columns.items():
        finite = np.isfinite(values)
        np.testing.assert_array_equal(rounded[name][~finite], values[~finite])
        moved = rounded[name][finite] - values[finite]
        steps = np.broadcast_to(rounding.steps[name], values.shape)[finite]
        if name == "grf_lower_bound_n":  # rounded down, so that it remains a bound
            assert ((moved <= 0.0) & (moved >= -steps)).all()
        else:
            assert (np.abs(moved) <= 0.5 * steps).all(), name
        assert (np.sign(rounded[name][finite]) * np.sign(values[finite]) >= 0.0).all(), name
        assert not np.signbit(rounded[name][rounded[name] == 0.0]).any(), name


def test_rounding_keeps_missing_values_flags_and_contact() -> None:
    plan = plan_with(LADDERS[-1], lag_ms=20.0)
    exact = list_columns(estimate(plan, draw_wild_frames(200, 4, 0)))
    rounded = Quantization.for_plans([plan]).round_to_steps(exact)
    for name in ("seq", "t_ns", "contact", "estimate_flags"):
        assert rounded[name] is exact[name]
    for name, values in exact.items():
        assert (np.isnan(rounded[name]) == np.isnan(values)).all(), name


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_last_bit_of_another_machine_is_rounded_off(seed: int) -> None:
    plan = plan_with(LADDERS[-1], lag_ms=20.0)
    rounding = Quantization.for_plans([plan])
    rng = np.random.default_rng(seed)
    forces_n = np.repeat(rng.choice([0.0, 9.0, 40.0], (3, 4)), 80, axis=0)
    exact = list_columns(estimate(plan, loaded_frames(forces_n + rng.normal(0.0, 1.0, (240, 4)))))
    for name, steps in rounding.steps.items():
        values = exact[name]
        other = values * (1.0 + rng.choice([-1.0, 0.0, 1.0], values.shape) * 2.0**-50)
        one, two = (rounding.round_to_steps({name: v})[name] for v in (values, other))
        # A value on the edge of a step may be rounded to either side; it is a rare one.
        edge = values / steps + (0.0 if name == "grf_lower_bound_n" else 0.5)
        clear = np.abs(edge - np.rint(edge)) > 1e-9
        np.testing.assert_array_equal(np.where(clear, one, 0.0), np.where(clear, two, 0.0))


# --- steps of plans -------------------------------------------------------------------------------


def test_the_least_noise_of_known_tares_decides_on_the_steps() -> None:
    quiet, loud = plan_with(noise_counts=0.3), plan_with(noise_counts=3.0)
    tare = Tare.make_lost(tiles=4, t_ns=UTC_NS)
    lost = make_plan(INFO, quiet.calibration, tare, models=("static",), lag_ms=0.0)
    assert list_steps(loud, quiet, lost) == list_steps(quiet)
    assert list_steps(quiet)["force_n_0"] < list_steps(loud)["force_n_0"]
    assert list_steps(lost) == {}


def test_a_plan_without_noise_rounds_the_angle_only() -> None:
    plan = newton_plan(INFO, sigma_n=0.0)
    assert list(list_steps(plan)) == ["angle_rad"]
    values = np.random.default_rng(0).normal(size=(9, 4))
    same = Quantization.for_plans([plan]).round_to_steps({"force_n": values})
    np.testing.assert_array_equal(same["force_n"], values)


@pytest.mark.parametrize("sigma_n", [5e-324, 1e-323, 1e-310, 1e-200, 1e-140])
def test_next_to_no_noise_moves_no_bit(sigma_n: float) -> None:
    rounding = Quantization.for_plans([newton_plan(array_at(SQUARE), sigma_n=sigma_n)])
    values = np.random.default_rng(0).normal(0.0, 100.0, size=(9, 4))
    columns = {"gauge_kpa": values, "force_n": values, "grf_lower_bound_n": values[:, 0]}
    assert_same_bits(rounding.round_to_steps(columns), columns)


@pytest.mark.parametrize(
    ("positions", "measured"),
    [(SQUARE, "xy"), (SQUARE[2:], "x"), ([SQUARE[1], SQUARE[3]], "y"), (SQUARE[3:], "")],
)
def test_a_centre_of_pressure_has_a_step_along_measured_axes(
    positions: list[tuple[float, float, float]], measured: str
) -> None:
    steps = list_steps(newton_plan(array_at(positions)))
    assert {name for name in steps if name.startswith("cop") and name.endswith("_m")} == {
        name
        for axis in measured
        for name in (f"cop_{axis}_m", f"cop_sigma_{axis}_m", f"cop_ground_{axis}_m")
    }
    if measured:  # an index counts tiles, also across a row
        assert steps["cop_index_x"] == steps["cop_index_y"] > 0.0


def test_steps_are_stated_by_flat_column_and_of_a_bare_tile_by_its_pressure() -> None:
    steps = list_steps(newton_plan(array_at(SQUARE, references=[3])))
    assert json.loads(json.dumps(steps)) == steps
    assert {"gauge_kpa_3", "force_n_2", "force_sigma_n_0", "grf_lower_bound_n"} <= set(steps)
    assert {"force_n_3", "contact", "estimate_flags"}.isdisjoint(steps)
