"""Effects of a dome: intervals, limits and their file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from pydantic import ValidationError

from service.estimation.effects import (
    WALL_PER_KPA,
    Effects,
    FlowEffect,
    GasEffect,
    HysteresisEffect,
    Parameter,
    RubberEffect,
    TemperatureEffect,
)
from tests.builders.calibrations import make_effects


def p(value: float) -> Parameter:
    return Parameter(value=value, sigma=0.1)


def gas(*, gamma: float = 1.28, tau_s: float = 0.011) -> GasEffect:
    return GasEffect(gamma=p(gamma), tau_s=p(tau_s), misfit=0.0)


def rubber(part: tuple[float, ...], tau_s: tuple[float, ...]) -> RubberEffect:
    return RubberEffect(
        part=tuple(map(p, part)),
        tau_s=tuple(map(p, tau_s)),
        coefficients=(0.0, 1.0, 0.0, 0.0),
        covariance=((0.0,) * 3,) * 3,
        scatter=0.0,
        misfit=0.0,
        curve_misfit_n=0.0,
    )


def temperature(*, kpa_per_k: float = 0.3, lag_s: float = 3.0) -> TemperatureEffect:
    return TemperatureEffect(kpa_per_k=p(kpa_per_k), lag_s=p(lag_s), wall_per_kpa=p(0.002))


def test_the_95_percent_interval_is_1_96_sigma() -> None:
    assert Parameter(value=5.0, sigma=0.5).interval_95 == pytest.approx((4.02, 5.98))


def test_the_wall_compliance_is_of_the_soak_or_of_the_material() -> None:
    assert Effects(temperature=temperature()).wall_compliance_or_default_per_kpa == 0.002
    assert Effects().wall_compliance_or_default_per_kpa == WALL_PER_KPA == 0.00124


@pytest.mark.parametrize(
    "make",
    [
        lambda: gas(gamma=0.99),
        lambda: gas(gamma=1.67),
        lambda: gas(tau_s=0.0),
        lambda: rubber((0.5, 0.5), (1.0, 2.0)),
        lambda: rubber((-0.01,), (1.0,)),
        lambda: rubber((0.1, 0.1), (1.0, 0.0)),
        lambda: rubber((0.1, 0.1), (1.0,)),
        lambda: HysteresisEffect(part=(p(0.4), p(0.4), p(0.2))),
        lambda: HysteresisEffect(part=(p(-0.1),)),
        lambda: FlowEffect(part=p(-0.01), stress_n=p(0.2), power=p(4.0)),
        lambda: FlowEffect(part=p(0.5), stress_n=p(0.2), power=p(4.0)),
        lambda: FlowEffect(part=p(0.1), stress_n=p(0.0), power=p(4.0)),
        lambda: FlowEffect(part=p(0.1), stress_n=p(0.1), power=p(1.0)),
        lambda: temperature(kpa_per_k=0.0),
        lambda: make_effects(late_s=p(60.1)),
        lambda: make_effects(late_s=p(-1e12)),
        lambda: Parameter(value=float("nan"), sigma=0.0),
        lambda: Parameter(value=1.0, sigma=float("inf")),
        lambda: Parameter(value=1.0, sigma=-1.0),
    ],
)
def test_an_effect_that_cannot_be_compensated_is_refused(make: Callable[[], Any]) -> None:
    with pytest.raises(ValidationError):
        make()


def test_the_limits_themselves_are_accepted() -> None:
    assert gas(gamma=1.0).gamma.value == 1.0
    assert gas(gamma=5 / 3).gamma.value == 5 / 3
    assert rubber((0.0, 0.99), (1e-9, 1e9)).part[1].value == 0.99
    assert HysteresisEffect(part=(p(0.0), p(0.0), p(0.999))).part[2].value == 0.999
    assert FlowEffect(part=p(0.4), stress_n=p(0.01), power=p(4.0)).part.value == 0.4
    assert make_effects(late_s=p(-60.0)).late_s is not None
