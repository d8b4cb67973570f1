"""A curve from dead weights: its needs, and its interval."""

from __future__ import annotations

import numpy as np
import pytest

from devices.chips.mpl115a2 import MPL115A2
from devices.errors import CalibrationError, UsageError
from service.estimation.calibration import TileCalibration
from service.estimation.dead_weights import (
    STANDARD_GRAVITY_M_S2,
    check_and_label_weights,
    parse_weight,
)
from service.estimation.fitting.rig.indentation import Indentation
from service.estimation.fitting.weights_fit import fit_curve_to_dead_weights

RATE_HZ = 50
BASELINE_KPA = 100.0
FIVE = {"200 g": 1.0, "500 g": 1.0, "1 kg": 1.0, "1500 g": 1.0, "2 kg": 1.0}
"""Each with the gain of its loading."""


def compute_gauge_kpa(force_n: float) -> float:
    """Compute the pressure of a stiffening dome above its baseline."""
    return 20.0 * float(np.log1p(force_n / 25.0))


def record(*steps: tuple[str, float], seconds: float = 4.0) -> Indentation:
    """Record steps, each with a text and an absolute pressure."""
    rng = np.random.default_rng(5)
    each = round(seconds * RATE_HZ)
    kpa = np.concatenate([np.full(each, level_kpa) for _, level_kpa in steps])
    return Indentation(
        chip=MPL115A2,
        serial="T01",
        where="by hand",
        t_ns=np.arange(len(kpa), dtype=np.int64) * (1_000_000_000 // RATE_HZ),
        kpa=kpa + 0.05 * rng.standard_normal(len(kpa)),
        reference_n=np.full(len(kpa), np.nan),
        phase=np.repeat([text for text, _ in steps], each),
        is_under_indenter=np.ones(len(kpa), dtype=np.bool_),
        temperature_raw=np.full(len(kpa), np.nan),
    )


def record_weights(weights: dict[str, float], repeats: int = 1) -> Indentation:
    """Record every weight after a rest, with the gain of its loading."""
    steps = []
    for text, gain in list(weights.items()) * repeats:
        weight = parse_weight(text)
        assert weight is not None
        steps += [
            ("rest", BASELINE_KPA),
            (text, BASELINE_KPA + compute_gauge_kpa(gain * weight.force_n)),
        ]
    return record(*steps)


def read_half_width_n(tile: TileCalibration) -> float:
    assert tile.weights is not None
    return tile.weights.band_95[-1].new_loading_n


@pytest.mark.parametrize(
    ("text", "force_n", "percent"),
    [
        ("500 g +-0 %", 0.5 * STANDARD_GRAVITY_M_S2, 0.15),
        ("0.5kg ±0%", 0.5 * STANDARD_GRAVITY_M_S2, 0.15),
        ("4.9 N +-0 %", 4.9, 0.0),
        ("4.9 N", 4.9, 1.0 / np.sqrt(3.0)),
        ("0,5\u00a0Kg +-0,0\u202f%", 0.5 * STANDARD_GRAVITY_M_S2, 0.15),
        ("0,125 KG +-0 %", 0.125 * STANDARD_GRAVITY_M_S2, 0.15),
        ("4,9 n +-0 %", 4.9, 0.0),
    ],
)
def test_a_weight_is_a_force_with_its_uncertainty(
    text: str, force_n: float, percent: float
) -> None:
    weight = parse_weight(text)
    assert weight is not None
    assert weight.force_n == pytest.approx(force_n)
    assert 100.0 * weight.relative_sigma == pytest.approx(percent)


@pytest.mark.parametrize(
    "text",
    ["500", "g", "0 g", "500 lb", "rest", "-5 N", "1e3 g", "9999 kg", "1,500 g", "12,500 kg"],
)
def test_another_text_is_no_weight(text: str) -> None:
    assert parse_weight(text) is None


@pytest.mark.parametrize(
    "texts",
    [
        ("0,2 kg", "0,5 kg", "1 kg", "1,5 kg", "2 kg"),
        ("0,2 kg, 0,5 kg, 1 kg, 1,5 kg, 2 kg",),
        ("0.2kg,0.5kg,1kg,1.5kg,2kg",),
        ("0,2\u00a0Kg; 0,5\u00a0Kg; 1\u00a0Kg; 1,5\u00a0Kg; 2\u00a0Kg;",),
    ],
)
def test_a_comma_between_digits_is_decimal_and_another_one_separates(texts: list[str]) -> None:
    labels = check_and_label_weights(texts, 1.0)
    assert [*labels] == [f"{kg} kg +-1 %" for kg in ("0.2", "0.5", "1", "1.5", "2")]


@pytest.mark.parametrize("text", ["1,500 g", "200,500 g", "0.2 kg 0.5 kg"])
def test_a_text_that_may_be_another_number_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="decimal comma"):
        check_and_label_weights([text], 1.0)


def test_five_weights_give_the_curve_of_a_tile() -> None:
    tile = fit_curve_to_dead_weights([record_weights(FIVE)])
    assert tile.absolute_scale == "measured"
    assert tile.weights is not None
    assert [step.weight for step in tile.weights.steps] == list(FIVE)
    for point in tile.weights.band_95:
        true_n = 25.0 * (np.exp(point.gauge_kpa / 20.0) - 1.0)
        assert abs(point.force_n - true_n) < max(0.02 * true_n, 0.05)


def test_different_loadings_and_fewer_weights_widen_the_interval() -> None:
    apart = dict(zip(FIVE, (1.04, 0.97, 1.02, 0.95, 1.03), strict=True))
    alike_n, apart_n = (
        read_half_width_n(fit_curve_to_dead_weights([record_weights(each)]))
        for each in (FIVE, apart)
    )
    assert apart_n > 2.0 * alike_n
    assert (
        read_half_width_n(fit_curve_to_dead_weights([record_weights(apart, repeats=3)]))
        < 0.8 * apart_n
    )


def test_a_tolerance_of_all_weights_does_not_average_out() -> None:
    loose = {f"{text} +-5 %": gain for text, gain in FIVE.items()}
    tile = fit_curve_to_dead_weights([record_weights(loose, repeats=4)])
    assert read_half_width_n(tile) > 1.96 * 0.05 / np.sqrt(3.0) * 2.0 * STANDARD_GRAVITY_M_S2


DRIFTING = [
    step for i, text in enumerate(FIVE) for step in (("rest", 100.0 + i), (text, 101.0 + 3 * i))
]


@pytest.mark.parametrize(
    ("recording", "match"),
    [
        (record_weights(dict(list(FIVE.items())[:4])), "4 weights on the tile"),
        (
            record_weights({"200 g": 1.0, "1 kg": 1.0, "2 kg": 1.0}, repeats=3),
            "3 of them different",
        ),
        (record_weights(FIVE | {"200 g": 2.2}), "reads like"),
        (record_weights(FIVE | {"2 kg": 0.3}), "a pressure that rises with the weight"),
        (record_weights(dict.fromkeys(FIVE, 0.001)), "kPa at most under"),
        (record(("1 kg", 105.0), ("rest", 100.0)), "no rest before the weight of 1 kg"),
        (record(("rest", 100.0), ("1 kg", 105.0), seconds=1.0), "the rest lasted 1.0 s"),
        (record(("rest", 100.0), ("1 kg", np.inf)), "chip was at its end"),
        (record(*DRIFTING), "drifts by 4.0"),
    ],
)
def test_weights_that_show_no_curve_are_refused(recording: Indentation, match: str) -> None:
    with pytest.raises(CalibrationError, match=match):
        fit_curve_to_dead_weights([recording])
