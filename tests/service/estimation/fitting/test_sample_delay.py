"""Delays of tiles: their own, and the one shared with the reference."""

from __future__ import annotations

import pytest

from service.estimation.effects import Effects, Parameter
from service.estimation.fitting.dome_model import SAMPLE_DELAY_SIGMA_S
from service.estimation.fitting.effects_fit import DEFAULT_REFERENCE_DELAY, separate_delays

SEEN_S = (1.4e-3, 1.6e-3, 1.5e-3)


def make_delays(*late_s: float) -> list[Effects]:
    return [Effects(late_s=Parameter(value=value, sigma=4e-5)) for value in late_s]


def list_values(effects: list[Effects]) -> list[float]:
    return [each.late_s.value for each in effects if each.late_s is not None]


def test_a_known_delay_of_the_reference_is_subtracted() -> None:
    found = separate_delays(make_delays(*SEEN_S), Parameter(value=1.5e-3, sigma=0.0))
    assert list_values(found) == pytest.approx([-1e-4, 1e-4, 0.0])
    assert [each.late_common_s for each in found] == [0.0] * 3
    assert [each.reference_late_s for each in found] == pytest.approx([1.5e-3] * 3)


@pytest.mark.parametrize("delay", [DEFAULT_REFERENCE_DELAY, Parameter(value=1e-3, sigma=2e-4)])
def test_an_uncertain_delay_keeps_the_differences_and_sums(
    delay: Parameter,
) -> None:
    found = separate_delays(make_delays(*SEEN_S), delay)
    late_s = list_values(found)
    assert late_s[1] - late_s[0] == pytest.approx(2e-4)
    for each, value, was in zip(found, late_s, SEEN_S, strict=True):
        assert value + each.reference_late_s == pytest.approx(was)
        assert each.late_s is not None
        assert each.late_s.sigma == 4e-5


def test_a_shared_delay_is_divided_by_uncertainty() -> None:
    sigma_s = 0.5 * SAMPLE_DELAY_SIGMA_S
    (found,) = separate_delays(make_delays(1e-3), Parameter(value=0.0, sigma=sigma_s))
    # Four fifths are the tile's, whose variance is four times the reference's.
    assert list_values([found]) == pytest.approx([0.8e-3])
    # Both parts of a known sum are equally uncertain.
    common_s = SAMPLE_DELAY_SIGMA_S * sigma_s / (SAMPLE_DELAY_SIGMA_S**2 + sigma_s**2) ** 0.5
    assert found.late_common_s == pytest.approx(common_s)


def test_an_unknown_reference_leaves_the_uncertainty_of_a_conversion() -> None:
    (found,) = separate_delays(make_delays(1.5e-3), Parameter(value=0.0, sigma=1.0))
    assert list_values([found]) == pytest.approx([0.0], abs=1e-8)
    assert found.late_common_s == pytest.approx(SAMPLE_DELAY_SIGMA_S, rel=1e-3)


def test_a_tile_without_fast_loads_has_no_delay() -> None:
    slow = Effects()
    found = separate_delays([*make_delays(1e-3), slow], DEFAULT_REFERENCE_DELAY)
    assert found[1] == slow
    assert separate_delays([slow], DEFAULT_REFERENCE_DELAY) == [slow]
