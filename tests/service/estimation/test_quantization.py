"""Rounding of estimates: what it leaves alone, how much it changes, and that it is always the same.

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
from tests.builders.frames import cut_up, loaded_frames
from tests.service.estimation.feet import SQUARE, wild_frames

SIGMA_OF = {
    "force_n": "force_sigma_n",
    "force_sigma_n": "force_sigma_n",
    "grf_n": "grf_sigma_n",
    "grf_sigma_n": "grf_sigma_n",
    "grf_lower_bound_n": "grf_sigma_n",
    **dict.fromkeys(("cop_x_m", "cop_sigma_x_m", "cop_ground_x_m"), "cop_sigma_x_m"),
    **dict.fromkeys(("cop_y_m", "cop_sigma_y_m", "cop_ground_y_m"), "cop_sigma_y_m"),
}
"""Whose standard uncertainty decides on the step of a column."""
LADDERS = [
    ("unwrap", "static"),
    ("static", "denoise"),
    ("static", "skew", "denoise"),
    ("unwrap", "temperature", "gas", "static", "skew", "denoise", "hysteresis", "rubber"),
]


def plan_of(
    models: Sequence[str], noise_counts: Sequence[float], lag_ms: float, *, bend: float = 0.0
) -> EstimationPlan:
    tiles = [
        newton_tile(
            f"T{i + 1:02d}",
            coefficients=(0.0, 1.0, bend, 0.0),
            relative_misfit=0.01,
            effects=make_effects(),
        )
        for i in range(4)
    ]
    tare = make_tare(
        4,
        noise_kpa=COUNT_KPA * np.array(noise_counts),
        baseline_sigma_kpa=COUNT_KPA * np.array(noise_counts) / 20.0,
    )
    info = array_at(SQUARE, servo=make_servo())
    return make_plan(info, make_calibration(*tiles), tare, models=models, lag_ms=lag_ms)


def columns_of(estimates: Estimates) -> dict[str, np.ndarray]:
    return {f.name: getattr(estimates, f.name) for f in fields(estimates)}


def same_bits(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
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
def test_a_step_is_a_power_of_two_and_at_most_an_eighth_of_every_sigma_there_is(
    models: tuple[str, ...], noise_counts: list[float], lag_ms: float, bend: float, seed: int
) -> None:
    plan = plan_of(models, noise_counts, lag_ms, bend=bend)
    steps = Quantization.for_plans([plan]).steps
    rng = np.random.default_rng(seed)
    level_n = np.repeat(rng.choice([0.0, 3.0, 20.0, 60.0], (6, 4)), 100, axis=0)
    forces_n = level_n + rng.normal(0.0, 1.0, (600, 4)) * noise_counts
    found = columns_of(estimate(plan, loaded_frames(forces_n)))
    for name, of in SIGMA_OF.items():
        sigma = found[of]
        least = np.where(np.isnan(sigma), np.inf, sigma).min(axis=0)
        assert np.all(np.frexp(steps[name])[0] == 0.5), name
        assert np.all(steps[name] <= least / STEPS_PER_SIGMA * (1.0 + 1e-12)), name
    assert np.all(steps["gauge_kpa"] <= plan.noise_kpa * np.hypot(1.0, 0.05) / STEPS_PER_SIGMA)


def test_no_step_is_finer_than_it_has_to_be_for_a_foot_at_rest() -> None:
    # Unloaded, with all the averaging there can be, sigma is what the step was made for.
    plan = plan_of(("static", "denoise"), [1.0] * 4, 100.0)
    steps = Quantization.for_plans([plan]).steps
    rest_n = np.random.default_rng(0).normal(0.0, 1.0, (600, 4))
    found = estimate(plan, loaded_frames(rest_n))
    assert (steps["force_n"] > np.nanmin(found.force_sigma_n, axis=0) / STEPS_PER_SIGMA / 3.0).all()
    assert (steps["grf_n"] > np.nanmin(found.grf_sigma_n) / STEPS_PER_SIGMA / 3.0).all()


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.integers(-30, 30))
def test_rounding_moves_nothing_by_more_than_half_a_step_and_twice_is_once(
    seed: int, scale: int
) -> None:
    plan = plan_of(("static",), [1.0] * 4, 0.0)
    rounding = Quantization.for_plans([plan])
    rng = np.random.default_rng(seed)
    odd = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1e300, -1e-300])
    columns = {
        name: np.where(
            rng.random((50, len(steps))) < 0.2,
            rng.choice(odd, (50, len(steps))),
            rng.normal(0.0, 2.0**scale, (50, len(steps))),
        )
        for name, steps in rounding.steps.items()
    }
    columns = {n: v if len(rounding.steps[n]) > 1 else v[:, 0] for n, v in columns.items()}
    rounded = rounding.round_to_steps(columns)
    same_bits(rounding.round_to_steps(rounded), rounded)
    in_file = {name: values.astype(np.float32) for name, values in _small(rounded).items()}
    again = rounding.round_to_steps({name: v.astype(np.float64) for name, v in in_file.items()})
    same_bits({name: values.astype(np.float32) for name, values in again.items()}, in_file)
    for name, values in columns.items():
        finite = np.isfinite(values)
        np.testing.assert_array_equal(rounded[name][~finite], values[~finite])
        parts = 1.0 if name == "grf_lower_bound_n" else 0.5
        most = np.broadcast_to(parts * rounding.steps[name], values.shape)[finite]
        before, after = values[finite], rounded[name][finite]
        assert (np.abs(after - before) <= most).all(), name
        assert (np.sign(after) * np.sign(before) >= 0.0).all(), name
        assert not np.signbit(rounded[name][rounded[name] == 0.0]).any(), name


def _small(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """As great as a float32 can be."""
    return {name: np.where(np.abs(v) < 1e30, v, np.nan) for name, v in columns.items()}


def test_a_bound_is_rounded_down_and_remains_one() -> None:
    rounding = Quantization.for_plans([plan_of(("static",), [1.0] * 4, 0.0)])
    bound_n = np.random.default_rng(0).normal(0.0, 20.0, 1000)
    rounded = rounding.round_to_steps({"grf_lower_bound_n": bound_n})["grf_lower_bound_n"]
    assert (rounded <= bound_n).all()


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), cuts=st.sets(st.integers(1, 199), max_size=9))
def test_any_split_gives_the_same_rounded_bits_and_flags_and_contact_are_as_they_were(
    seed: int, cuts: set[int]
) -> None:
    plan = plan_of(LADDERS[-1], [1.0] * 4, 20.0)
    rounding = Quantization.for_plans([plan])
    frames = wild_frames(200, 4, seed)
    exact = columns_of(estimate(plan, frames))
    pieces = columns_of(estimate(plan, *cut_up(frames, sorted(cuts))))
    same_bits(rounding.round_to_steps(exact), rounding.round_to_steps(pieces))
    rounded = rounding.round_to_steps(exact)
    for name in ("seq", "t_ns", "contact", "estimate_flags"):
        assert rounded[name] is exact[name]
    for name, values in exact.items():
        assert (np.isnan(rounded[name]) == np.isnan(values)).all(), name


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_last_bit_that_is_another_on_another_machine_is_rounded_off(seed: int) -> None:
    plan = plan_of(LADDERS[-1], [1.0] * 4, 20.0)
    rounding = Quantization.for_plans([plan])
    rng = np.random.default_rng(seed)
    forces_n = np.repeat(rng.choice([0.0, 9.0, 40.0], (3, 4)), 80, axis=0)
    exact = columns_of(estimate(plan, loaded_frames(forces_n + rng.normal(0.0, 1.0, (240, 4)))))
    for name, steps in rounding.steps.items():
        values = exact[name]
        other = values * (1.0 + rng.choice([-1.0, 0.0, 1.0], values.shape) * 2.0**-50)
        one, two = (rounding.round_to_steps({name: v})[name] for v in (values, other))
        # What lies on the edge itself may fall to either side; it is a rare one.
        edge = values / steps + (0.0 if name == "grf_lower_bound_n" else 0.5)
        clear = np.abs(edge - np.rint(edge)) > 1e-9
        np.testing.assert_array_equal(np.where(clear, one, 0.0), np.where(clear, two, 0.0))


def test_one_step_goes_with_all_tares_of_a_recording() -> None:
    quiet, loud = (plan_of(("static",), [counts] * 4, 0.0) for counts in (0.3, 3.0))
    both = Quantization.for_plans([loud, quiet])
    assert (
        both.collect_flat_column_steps()
        == Quantization.for_plans([quiet]).collect_flat_column_steps()
    )
    assert (
        both.collect_flat_column_steps()["force_n_0"]
        < Quantization.for_plans([loud]).collect_flat_column_steps()["force_n_0"]
    )


def test_a_lost_tare_has_no_say_and_alone_leaves_nothing_to_be_rounded() -> None:
    known = plan_of(("static",), [1.0] * 4, 0.0)
    lost = make_plan(
        known.info,
        known.calibration,
        Tare.make_lost(tiles=4, t_ns=UTC_NS),
        models=("static",),
        lag_ms=0.0,
    )
    assert (
        Quantization.for_plans([known, lost]).collect_flat_column_steps()
        == Quantization.for_plans([known]).collect_flat_column_steps()
    )
    assert Quantization.for_plans([lost]).collect_flat_column_steps() == {}


def test_without_noise_nothing_is_rounded_but_what_the_servo_says() -> None:
    plan = newton_plan(array_at(SQUARE, servo=make_servo()), sigma_n=0.0)
    assert list(Quantization.for_plans([plan]).collect_flat_column_steps()) == ["angle_rad"]
    values = np.random.default_rng(0).normal(size=(9, 4))
    kept = Quantization.for_plans([plan]).round_to_steps({"force_n": values})
    np.testing.assert_array_equal(kept["force_n"], values)


@pytest.mark.parametrize("sigma_n", [5e-324, 1e-323, 1e-310, 1e-200, 1e-140])
def test_with_next_to_no_noise_nothing_is_moved_that_shows(sigma_n: float) -> None:
    rounding = Quantization.for_plans([newton_plan(array_at(SQUARE), sigma_n=sigma_n)])
    values = np.random.default_rng(0).normal(0.0, 100.0, size=(9, 4))
    columns = {"gauge_kpa": values, "force_n": values, "grf_lower_bound_n": values[:, 0]}
    same_bits(rounding.round_to_steps(columns), columns)


@pytest.mark.parametrize(
    ("positions", "measured"),
    [(SQUARE, "xy"), (SQUARE[2:], "x"), ([SQUARE[1], SQUARE[3]], "y"), (SQUARE[3:], "")],
)
def test_the_centre_of_pressure_has_a_step_along_each_measured_axis(
    positions: list[tuple[float, float, float]], measured: str
) -> None:
    steps = Quantization.for_plans([newton_plan(array_at(positions))]).collect_flat_column_steps()
    assert {name for name in steps if name.startswith("cop") and name.endswith("_m")} == {
        name
        for axis in measured
        for name in (f"cop_{axis}_m", f"cop_sigma_{axis}_m", f"cop_ground_{axis}_m")
    }
    if measured:  # an index counts tiles, also across a row
        assert steps["cop_index_x"] == steps["cop_index_y"] > 0.0


def test_a_bare_tile_has_a_pressure_to_be_rounded_and_no_force() -> None:
    info = array_at(SQUARE[:3])
    bare = info.tiles[2].model_copy(update={"reference": True})
    info = info.model_copy(update={"tiles": (*info.tiles[:2], bare)})
    plan = newton_plan(info, tiles=[newton_tile("T01"), newton_tile("T02")])
    steps = Quantization.for_plans([plan]).collect_flat_column_steps()
    assert "gauge_kpa_2" in steps
    assert "force_n_1" in steps
    assert "force_n_2" not in steps


def test_steps_are_said_for_every_flat_column_and_survive_json() -> None:
    steps = Quantization.for_plans(
        [plan_of(("static",), [1.0] * 4, 0.0)]
    ).collect_flat_column_steps()
    assert json.loads(json.dumps(steps)) == steps
    assert {"gauge_kpa_3", "force_sigma_n_0", "grf_lower_bound_n", "cop_index_y"} <= set(steps)
    assert {"contact", "estimate_flags"}.isdisjoint(steps)
