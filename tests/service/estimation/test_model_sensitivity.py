"""What a recording asks for: models that are offered and not named, with their newtons."""

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


def hops(top_n: float = 40.0, rows: int = 600) -> FrameBatch:
    """Half sines of 0.1 s, a frame each 2 ms."""
    at = np.arange(rows) % 100
    n = np.where(at < 50, top_n * np.sin(np.pi * np.minimum(at, 50) / 50), 0.0)
    return loaded_frames(np.repeat(n[:, None], 2, axis=1))


def asked(models: tuple[str, ...], *batches: FrameBatch, **effects: Any) -> dict[str, float]:
    asking = OmittedModelEffect(INFO, calibration(**effects), models)
    for frames in batches:
        asking.add_frames(TARE, frames, frames.pressure_raw[:, 0] < 498)
    return asking.compute_notable_mean_grf_effects_by_model_n()


def test_it_expects_what_the_model_would_change_under_load() -> None:
    frames = hops()
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
    found = asked(BARE, frames)
    for name in ("gas", "rubber"):
        expected_n = np.abs(grf_n[name] - grf_n["every"])[loaded].mean()
        assert found[name] == pytest.approx(expected_n, abs=1e-8)
        assert expected_n > 1.0


def test_the_greatest_comes_first() -> None:
    newtons = list(asked(BARE, hops()).values())
    assert len(newtons) == 3
    assert newtons == sorted(newtons, reverse=True)


def test_who_names_all_that_is_offered_is_asked_for_nothing() -> None:
    assert asked(WHOLE, hops()) == {}


def test_a_model_that_is_named_is_not_asked_for() -> None:
    assert set(asked(("unwrap", "gas", "static", "rubber"), hops())) == {"hysteresis"}


def test_what_the_calibration_does_not_offer_is_not_asked_for() -> None:
    assert "rubber" not in asked(BARE, hops(), rubber=None)
    assert asked(BARE, hops(), gas=None, rubber=None, hysteresis=None, temperature=None) == {}


def test_a_foot_that_bears_next_to_nothing_asks_for_nothing() -> None:
    assert asked(BARE, hops(top_n=0.4)) == {}
    assert asked(BARE, hops(top_n=0.0)) == {}


def test_a_slow_load_does_not_ask_for_gas() -> None:
    n = 40.0 * np.sin(np.pi * np.arange(5000) / 5000)  # ten seconds
    found = asked(BARE, loaded_frames(np.repeat(n[:, None], 2, axis=1)))
    assert "gas" not in found
    assert {"rubber", "hysteresis"} <= set(found)


@pytest.mark.parametrize(("counts", "asks"), [(0, False), (-11, True)])
def test_chips_that_have_warmed_by_two_kelvin_ask_for_temperature(counts: int, asks: bool) -> None:
    frames = hops(rows=6000)
    warmed = with_columns(frames, temperature_raw=480 + counts)
    found = asked(("unwrap", "gas", "static", "hysteresis", "rubber"), warmed)
    assert ("temperature" in found) is asks
    # 0.3 kPa/K, 2.06 K, two tiles of 7.85 N/kPa; less at the beginning, as the gas is behind.
    assert not asks or EFFECT_MIN_N < found["temperature"] < 15.0


def test_another_tare_begins_anew_without_the_warmth_of_before() -> None:
    frames = with_columns(hops(), temperature_raw=469)
    asking = OmittedModelEffect(
        INFO, calibration(), ("unwrap", "gas", "static", "hysteresis", "rubber")
    )
    for tare in (
        make_tare(2, temperature_raw_counts=469.0),
        make_tare(2, temperature_raw_counts=469.0),
    ):
        asking.add_frames(tare, frames, frames.pressure_raw[:, 0] < 498)
    assert asking.compute_notable_mean_grf_effects_by_model_n() == {}


def test_a_node_that_was_switched_on_again_begins_anew() -> None:
    frames = hops()
    assert asked(BARE, frames, frames) == pytest.approx(asked(BARE, frames), rel=1e-9)


@settings(max_examples=10)
@given(cuts=st.sets(st.integers(1, 599), max_size=4))
def test_cut_anywhere_it_asks_for_the_same_newtons(cuts: set[int]) -> None:
    assert asked(BARE, *cut_up(hops(), cuts)) == asked(BARE, hops())
