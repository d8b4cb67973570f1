"""Effects of models that a calibration offers and a recording omits, in newtons."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.frames import FrameBatch
from service.estimation.model_sensitivity import EFFECT_MIN_N, OmittedModelEffect
from service.estimation.pipeline.plan import make_plan
from tests.builders.arrays import array_at
from tests.builders.calibrations import make_calibration, make_effects, make_tare, newton_tile
from tests.builders.estimates import estimate
from tests.builders.frames import cut_up, loaded_frames, with_columns

INFO = array_at(((0.0, 0.0, -0.15), (0.1, 0.0, -0.15)))
TARE = make_tare(2)
BARE = ("unwrap", "static")
WHOLE = ("unwrap", "temperature", "gas", "static", "skew", "denoise", "hysteresis", "rubber")


def calibration(**effects: Any) -> Any:
    known = make_effects(**effects)
    return make_calibration(*(newton_tile(serial, effects=known) for serial in INFO.serials))


def make_hops(top_n: float = 40.0, rows: int = 600) -> FrameBatch:
    """Make half sines of 0.1 s, a frame each 2 ms."""
    at = np.arange(rows) % 100
    n = np.where(at < 50, top_n * np.sin(np.pi * np.minimum(at, 50) / 50), 0.0)
    return loaded_frames(np.repeat(n[:, None], 2, axis=1))


def find_omitted(models: tuple[str, ...], *batches: FrameBatch, **effects: Any) -> dict[str, float]:
    omitted = OmittedModelEffect(INFO, calibration(**effects), models)
    for frames in batches:
        omitted.add_frames(TARE, frames, frames.pressure_raw[:, 0] < 498)
    return omitted.compute_notable_mean_grf_effects_by_model_n()


def test_an_omitted_model_has_its_mean_effect_under_load() -> None:
    frames = make_hops()
    known = calibration()
    grf_n = {
        name: estimate(make_plan(INFO, known, TARE, models=models), frames).grf_n
        for name, models in {
            "every": ("unwrap", "temperature", "gas", "static", "hysteresis", "rubber"),
            "gas": ("unwrap", "temperature", "static", "hysteresis", "rubber"),
            "rubber": ("unwrap", "temperature", "gas", "static", "hysteresis"),
        }.items()
    }
    loaded = frames.pressure_raw[:, 0] < 498
    found = find_omitted(BARE, frames)
    for name in ("gas", "rubber"):
        expected_n = np.abs(grf_n[name] - grf_n["every"])[loaded].mean()
        assert found[name] == pytest.approx(expected_n, abs=1e-8)
        assert expected_n > 1.0


def test_the_greatest_effect_is_first() -> None:
    newtons = list(find_omitted(BARE, make_hops()).values())
    assert len(newtons) == 3
    assert newtons == sorted(newtons, reverse=True)


NO_EFFECTS = dict.fromkeys(("gas", "rubber", "hysteresis", "temperature"))


@pytest.mark.parametrize(
    ("models", "top_n", "effects", "omitted"),
    [
        (BARE, 40.0, {}, {"gas", "rubber", "hysteresis"}),
        (WHOLE, 40.0, {}, set()),
        (("unwrap", "gas", "static", "rubber"), 40.0, {}, {"hysteresis"}),
        (BARE, 40.0, {"rubber": None}, {"gas", "hysteresis"}),
        (BARE, 40.0, NO_EFFECTS, set()),
        (BARE, 0.4, {}, set()),
        (BARE, 0.0, {}, set()),
    ],
    ids=["none named", "all named", "two named", "no rubber", "no effects", "0.4 N", "0 N"],
)
def test_only_offered_models_with_an_effect_are_omitted(
    models: tuple[str, ...], top_n: float, effects: dict[str, Any], omitted: set[str]
) -> None:
    assert set(find_omitted(models, make_hops(top_n), **effects)) == omitted


def test_a_slow_load_needs_no_gas() -> None:
    n = 40.0 * np.sin(np.pi * np.arange(5000) / 5000)  # ten seconds
    found = find_omitted(BARE, loaded_frames(np.repeat(n[:, None], 2, axis=1)))
    assert "gas" not in found
    assert {"rubber", "hysteresis"} <= set(found)


@pytest.mark.parametrize(("counts", "is_needed"), [(0, False), (-11, True)])
def test_chips_warmer_by_two_kelvin_need_temperature(counts: int, is_needed: bool) -> None:
    frames = make_hops(rows=6000)
    warmed = with_columns(frames, temperature_raw=480 + counts)
    found = find_omitted(("unwrap", "gas", "static", "hysteresis", "rubber"), warmed)
    assert ("temperature" in found) is is_needed
    # 0.3 kPa/K, 2.06 K, two tiles of 7.85 N/kPa; less at the beginning, as the gas is behind.
    assert not is_needed or EFFECT_MIN_N < found["temperature"] < 15.0


def test_another_tare_starts_without_the_warmth_before_it() -> None:
    frames = with_columns(make_hops(), temperature_raw=469)
    models = ("unwrap", "gas", "static", "hysteresis", "rubber")
    omitted = OmittedModelEffect(INFO, calibration(), models)
    for _ in range(2):
        tare = make_tare(2, temperature_raw_counts=469.0)
        omitted.add_frames(tare, frames, frames.pressure_raw[:, 0] < 498)
    assert omitted.compute_notable_mean_grf_effects_by_model_n() == {}


def test_a_restarted_node_starts_anew() -> None:
    frames = make_hops()
    assert find_omitted(BARE, frames, frames) == pytest.approx(find_omitted(BARE, frames), rel=1e-9)


@settings(max_examples=10)
@given(cuts=st.sets(st.integers(1, 599), max_size=4))
def test_any_batches_give_the_same_effects(cuts: set[int]) -> None:
    assert find_omitted(BARE, *cut_up(make_hops(), cuts)) == find_omitted(BARE, make_hops())
