"""What a bench recording determines of a tile: parameters that were put in are found.

Recordings are made by the estimator's own forward model, whose parameters are then known.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.estimation.effects import WALL_PER_KPA, Effects
from service.estimation.fitting.dome_model import DomeModel, FittedEffects
from service.estimation.fitting.effects_fit import (
    _convert_centred_cubic_to_c1_c2_c3,
    collect_loadings,
    fit_determined_effects,
)
from service.estimation.fitting.output_error import OutputErrorProblem
from service.estimation.fitting.static_fit import fit_static_curve
from tests.builders.calibrations import make_calibration
from tests.service.estimation.fitting.recordings import (
    CREEP_S,
    FLOW_N,
    FLOW_PART,
    FLOW_POWER,
    GAMMA,
    LOOP,
    PART,
    SCALE_KPA,
    TAU_S,
    flowing,
    found_in,
    recorded,
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def known() -> list[Effects]:
    """What was found in recordings of the same dome."""
    return [found_in(recorded(seed=seed)) for seed in range(4)]


def off_by_sigmas(effects: Effects) -> list[float]:
    """How far every parameter is from what was put in, in its standard uncertainties."""
    assert effects.gas is not None
    assert effects.rubber is not None
    assert effects.hysteresis is not None
    stated = [effects.gas.gamma, effects.gas.tau_s, *effects.rubber.part, *effects.rubber.tau_s]
    truth = (GAMMA, TAU_S, *PART, *CREEP_S, *LOOP)
    return [
        (parameter.value - true) / parameter.sigma
        for parameter, true in zip([*stated, *effects.hysteresis.part], truth, strict=True)
    ]


def test_parameters_that_were_put_in_lie_within_their_intervals(known: list[Effects]) -> None:
    off = np.abs([off_by_sigmas(effects) for effects in known])
    assert off.shape == (4, 9)
    # Of 36 values 34 should be. Measured over 32 recordings: 91 % are, none of the nine is biased.
    assert (off < 1.96).sum() >= 29
    assert off.max() < 4.5


def test_a_branch_that_flows_is_found_beside_plays_and_creep_and_only_where_there_is_one(
    known: list[Effects],
) -> None:
    loops = [effects.hysteresis for effects in known]
    assert [loop.flow for loop in loops if loop is not None] == [None] * len(known)
    loop = found_in(recorded(flowing)).hysteresis
    assert loop is not None
    assert loop.flow is not None
    for parameter, true in ((loop.flow.part, FLOW_PART), (loop.flow.stress_n, FLOW_N)):
        assert abs(parameter.value - true) < 3.0 * parameter.sigma
        assert parameter.sigma < 0.2 * true
    assert abs(loop.flow.power.value - FLOW_POWER) < 3.0 * loop.flow.power.sigma
    assert loop.flow.power.sigma < 0.9  # what is known beforehand is 1


def test_taps_and_releases_tell_the_gas_to_a_few_percent(known: list[Effects]) -> None:
    for effects in known:
        assert effects.gas is not None
        assert effects.gas.gamma.value == pytest.approx(GAMMA, abs=0.05)
        assert effects.gas.tau_s.value == pytest.approx(TAU_S, rel=0.2)
        assert effects.gas.tau_s.sigma < 0.1 * TAU_S
        low, high = effects.gas.tau_s.interval_95
        assert high - low == pytest.approx(2 * 1.96 * effects.gas.tau_s.sigma)


@pytest.mark.parametrize("late_s", [-300e-6, 0.0, 233e-6])
def test_how_late_a_tile_is_sampled_is_found_and_spoils_nothing_else(late_s: float) -> None:
    effects = found_in(recorded(late_s=late_s))
    assert effects.late_s is not None
    assert effects.late_s.sigma < 80e-6
    assert effects.late_s.value == pytest.approx(late_s, abs=4.0 * effects.late_s.sigma)
    assert np.abs(off_by_sigmas(effects)).max() < 4.5


def test_how_loadings_scatter_is_found(known: list[Effects]) -> None:
    scatter = [effects.rubber.scatter for effects in known if effects.rubber is not None]
    assert np.mean(scatter) == pytest.approx(0.02, rel=0.25)


def test_what_is_wrong_is_little_where_the_model_is_right(known: list[Effects]) -> None:
    for effects in known:
        assert effects.gas is not None
        assert effects.rubber is not None
        assert effects.gas.misfit < 0.1
        assert effects.rubber.misfit < 0.2
        assert effects.rubber.curve_misfit_n < 0.1


def test_the_curve_of_forces_that_have_lasted_lies_beneath_creep_and_loop(
    known: list[Effects],
) -> None:
    # Over u = 2 x - 1 with x = gauge / end of the range, which is what was read at most.
    recording = recorded(seed=0)
    tile = fit_static_curve(recording)
    rubber = known[0].rubber
    assert rubber is not None
    for gauge_kpa in (2.0, 6.0, 10.0, 14.0):
        low, u = (2 * p / tile.range_kpa[1] - 1 for p in (0.0, gauge_kpa))
        found_n = np.polyval(rubber.coefficients[::-1], u) - np.polyval(
            rubber.coefficients[::-1], low
        )
        x = gauge_kpa / SCALE_KPA
        assert found_n == pytest.approx(x * (22 + x * (5 + x * 5)), rel=0.03)


def test_the_same_recording_gives_the_same_calibration(known: list[Effects]) -> None:
    recording = recorded(seed=0)
    tile = fit_static_curve(recording)
    one = tile.model_copy(update={"effects": known[0]})
    two = tile.model_copy(update={"effects": fit_determined_effects([recording], tile)})
    assert make_calibration(one).id == make_calibration(two).id


def test_without_holds_releases_and_taps_there_is_no_gas_and_a_reason() -> None:
    effects = found_in(recorded(holds=0, taps=0, strokes=3))
    assert effects.gas is None
    assert effects.refused["gas"] == "no holds, releases or taps in the recording"
    assert effects.rubber is not None
    assert effects.hysteresis is not None


@pytest.mark.parametrize(
    ("soak_s", "reason"),
    [
        (0.0, "the recording has no soak at two temperatures"),
        (8.0, "temperature changes by 0.0 K only, 1.0 K are needed"),
    ],
)
def test_without_a_soak_at_two_temperatures_there_is_neither_temperature_nor_ambient(
    soak_s: float, reason: str
) -> None:
    effects = found_in(recorded(soak_s=soak_s, strokes=2, holds=0, taps=0))
    assert effects.temperature is None
    assert (effects.refused["temperature"], effects.refused["ambient"]) == (reason, reason)
    assert effects.wall_compliance_or_default_per_kpa == WALL_PER_KPA


def test_what_a_loading_is_off_by_if_it_is_held_out_is_what_a_fit_without_it_says() -> None:
    recording = recorded(strokes=3, holds=3, taps=6)
    tile = fit_static_curve(recording)
    points, baseline_kpa = collect_loadings([recording])
    static = DomeModel(
        _convert_centred_cubic_to_c1_c2_c3(tile.coefficients),
        tile.range_kpa[1],
        baseline_kpa,
        WALL_PER_KPA,
    )
    problem, parts = OutputErrorProblem(points, static), FittedEffects(terms=2)
    fit = problem.fit(parts)
    seen = problem.fit(parts, fit.scatter)
    for held in (1, 4, 8):
        weight = np.where(points.loading == held, 0.0, points.weight)
        without = OutputErrorProblem(replace(points, weight=weight), static)
        model = without.fit(parts, fit.scatter).model
        off = problem.compute_pressure_and_gain_residuals(model, fit.scatter)
        rows = np.append(np.flatnonzero(points.loading == held), len(points.t_s) + held)
        assert seen.left_out_squares[held] == pytest.approx(
            float((off[rows] ** 2).sum()), rel=0.05, abs=1.0
        )


def test_readings_that_are_missing_are_left_out() -> None:
    recording = recorded(strokes=2, holds=2, taps=6)
    rng = np.random.default_rng(3)
    holes = rng.random(len(recording.kpa)) < 0.05
    effects = found_in(replace(recording, kpa=np.where(holes, np.nan, recording.kpa)))
    assert np.abs(off_by_sigmas(effects)).max() < 5.0
