"""`fit_temperature_effect` on soaks of known parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from devices.chips.mpl115a2 import MPL115A2
from service.estimation.effects import TemperatureEffect
from service.estimation.fitting.rig.indentation import ThermalSoak
from service.estimation.fitting.thermal_soak import LAG_RANGE_S, fit_temperature_effect

CHIP_LAG_S, GAS_LAG_S, KPA_PER_K, BASE_KPA = 1.2, 3.3, 0.297, 100.3
STEP_S = 0.00184
WARM_FROM_S = 12.0


def make_soak(
    *, step_k: float = 4.0, seed: int = 0, seconds: float = 32.0, **how: float
) -> ThermalSoak:
    """The surroundings warm up at once; chip and gas follow, one after the other."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds, STEP_S)
    since = np.maximum(t_s - WARM_FROM_S, 0.0)
    gas_lag_s = how.get("gas_lag_s", GAS_LAG_S)
    a, b = np.exp(-since / CHIP_LAG_S), np.exp(-since / gas_lag_s)
    chip_k = step_k * (1 - a)
    gas_k = step_k * (1 - (gas_lag_s * b - CHIP_LAG_S * a) / (gas_lag_s - CHIP_LAG_S))
    kpa = BASE_KPA + how.get("kpa_per_k", KPA_PER_K) * gas_k + rng.normal(0, 0.165, len(t_s))
    temperature_raw = np.rint(498 - 5.35 * chip_k + rng.normal(0, 0.5, len(t_s)))
    return ThermalSoak(
        chip=MPL115A2, t_s=t_s, kpa=kpa, temperature_raw=temperature_raw, noise_kpa=0.165
    )


def test_known_parameters_are_within_their_intervals() -> None:
    found = [fit_temperature_effect(make_soak(seed=seed)) for seed in range(12)]
    known = [effect for effect in found if isinstance(effect, TemperatureEffect)]
    assert len(known) == 12
    off = np.array(
        [
            [(e.kpa_per_k.value - KPA_PER_K) / e.kpa_per_k.sigma for e in known],
            [(e.lag_s.value - GAS_LAG_S) / e.lag_s.sigma for e in known],
        ]
    )
    assert (np.abs(off) < 1.96).sum() >= 20, "of 24 values 95 % should be"
    assert (np.abs(off) < 4.0).all()
    assert all(e.kpa_per_k.sigma < 0.01 * KPA_PER_K and e.lag_s.sigma < 0.3 for e in known)


def make_lagging_soak(
    *, lag_s: float, both: bool = False, seed: int = 0, step_k: float = 4.0
) -> ThermalSoak:
    """Chip and gas one behind the other by a signed lag; or both behind the surroundings."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, 37.0, STEP_S)
    decay = np.exp(-STEP_S / np.array([CHIP_LAG_S, CHIP_LAG_S + abs(lag_s), abs(lag_s)]))
    around_k = step_k * (t_s >= WARM_FROM_S)
    quick_k = lfilter([1 - decay[0]], [1, -decay[0]], around_k)
    slow_k = (
        lfilter([1 - decay[1]], [1, -decay[1]], around_k)
        if both
        else lfilter([1 - decay[2]], [1, -decay[2]], quick_k)
    )
    chip_k, gas_k = (quick_k, slow_k) if lag_s > 0.0 else (slow_k, quick_k)
    kpa = BASE_KPA + KPA_PER_K * gas_k + rng.normal(0, 0.165, len(t_s))
    temperature_raw = np.rint(498 - 5.35 * chip_k + rng.normal(0, 0.5, len(t_s)))
    return ThermalSoak(
        chip=MPL115A2, t_s=t_s, kpa=kpa, temperature_raw=temperature_raw, noise_kpa=0.165
    )


@pytest.mark.parametrize("lag_s", [-3.0, -2.0, -0.5, 0.5, 2.0])
@pytest.mark.parametrize("both", [False, True])
def test_a_lag_of_either_sign_is_found_with_its_interval(lag_s: float, both: bool) -> None:
    for seed in range(2):
        effect = fit_temperature_effect(make_lagging_soak(lag_s=lag_s, both=both, seed=seed))
        assert isinstance(effect, TemperatureEffect)
        assert effect.lag_s.value * lag_s > 0.0
        low, high = effect.lag_s.interval_95
        assert low < lag_s < high
        assert effect.kpa_per_k.value == pytest.approx(KPA_PER_K, rel=0.03)


def test_a_misfit_of_the_model_makes_a_lag_uncertain() -> None:
    # The model has one behind the other, not both behind the surroundings.
    right, wrong = (
        fit_temperature_effect(make_lagging_soak(lag_s=3.0, both=both)) for both in (False, True)
    )
    assert isinstance(right, TemperatureEffect)
    assert isinstance(wrong, TemperatureEffect)
    assert wrong.lag_s.sigma > 2.0 * right.lag_s.sigma


def test_a_lag_at_the_end_of_its_range_is_uncertain() -> None:
    effect = fit_temperature_effect(make_lagging_soak(lag_s=-25.0))
    assert isinstance(effect, TemperatureEffect)
    assert effect.lag_s.value == LAG_RANGE_S[0]
    assert effect.lag_s.sigma > 1.0


def test_the_wall_compliance_is_the_rise_missing_to_a_rigid_bubble() -> None:
    # 498 counts are 21 to 25 degC by the two published scales; dp/dT = p/T/(1 + c p)
    effect = fit_temperature_effect(
        make_soak(kpa_per_k=BASE_KPA / 298.15 / (1 + 0.00124 * BASE_KPA))
    )
    assert isinstance(effect, TemperatureEffect)
    assert effect.wall_per_kpa.value == pytest.approx(0.00124, abs=0.0003)
    assert 0.0 < effect.wall_per_kpa.sigma < 0.0003


def test_a_bubble_that_rises_more_than_a_rigid_one_has_a_rigid_wall() -> None:
    effect = fit_temperature_effect(make_soak(kpa_per_k=0.4))
    assert isinstance(effect, TemperatureEffect)
    assert effect.wall_per_kpa.value == 0.0


SOAK = make_soak()


@pytest.mark.parametrize(
    ("soak", "reason"),
    [
        (
            ThermalSoak(MPL115A2, np.empty(0), np.empty(0), np.empty(0), 0.165),
            "no soak at two temperatures",
        ),
        (
            replace(SOAK, kpa=np.where(np.abs(SOAK.t_s - 20.0) < 0.3, np.nan, SOAK.kpa)),
            "no soak at two temperatures",
        ),
        (make_soak(step_k=0.0), "1.0 K are needed"),
        (make_soak(step_k=0.5), "1.0 K are needed"),
        (make_soak(kpa_per_k=0.0), "not determined"),
        (make_soak(kpa_per_k=-0.3), "not determined"),
    ],
    ids=["empty", "a hole", "constant", "half a kelvin", "punctured", "falls with warmth"],
)
def test_a_soak_without_an_answer_is_refused_with_a_reason(soak: ThermalSoak, reason: str) -> None:
    found = fit_temperature_effect(soak)
    assert isinstance(found, str)
    assert reason in found


def test_a_fall_of_temperature_is_as_good_as_a_rise() -> None:
    effect = fit_temperature_effect(make_soak(step_k=-4.0))
    assert isinstance(effect, TemperatureEffect)
    assert effect.kpa_per_k.value == pytest.approx(KPA_PER_K, rel=0.03)
