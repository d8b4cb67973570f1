"""`resolved`: what tiles have of their own, and what they share with the reference."""

from __future__ import annotations

import pytest

from service.estimation.effects import Effects, Parameter
from service.estimation.fitting.dome_model import SAMPLE_DELAY_SIGMA_S
from service.estimation.fitting.sample_delay import DEFAULT_REFERENCE_DELAY, separate_delays

SEEN_S = (1.4e-3, 1.6e-3, 1.5e-3)


def seen(*late_s: float) -> list[Effects]:
    return [Effects(late_s=Parameter(value=value, sigma=4e-5)) for value in late_s]


def values_of(effects: list[Effects]) -> list[float]:
    return [each.late_s.value for each in effects if each.late_s is not None]


def test_a_delay_that_is_known_is_taken_off_and_leaves_no_doubt() -> None:
    found = separate_delays(seen(*SEEN_S), Parameter(value=1.5e-3, sigma=0.0))
    assert values_of(found) == pytest.approx([-1e-4, 1e-4, 0.0])
    assert [each.late_common_s for each in found] == [0.0] * 3
    assert [each.reference_late_s for each in found] == pytest.approx([1.5e-3] * 3)


@pytest.mark.parametrize("delay", [DEFAULT_REFERENCE_DELAY, Parameter(value=1e-3, sigma=2e-4)])
def test_however_little_is_known_differences_between_tiles_stay_and_the_bench_is_met(
    delay: Parameter,
) -> None:
    found = separate_delays(seen(*SEEN_S), delay)
    late_s = values_of(found)
    assert late_s[1] - late_s[0] == pytest.approx(2e-4)
    for each, value, was in zip(found, late_s, SEEN_S, strict=True):
        assert value + each.reference_late_s == pytest.approx(was)
        assert each.late_s is not None
        assert each.late_s.sigma == 4e-5


def test_what_tiles_share_is_divided_as_tiles_and_reference_are_uncertain() -> None:
    sigma_s = 0.5 * SAMPLE_DELAY_SIGMA_S
    (found,) = separate_delays(seen(1e-3), Parameter(value=0.0, sigma=sigma_s))
    # Four fifths are the tile's, whose variance is four times the reference's.
    assert values_of([found]) == pytest.approx([0.8e-3])
    # Of two things whose sum is known either is as uncertain as this.
    common_s = SAMPLE_DELAY_SIGMA_S * sigma_s / (SAMPLE_DELAY_SIGMA_S**2 + sigma_s**2) ** 0.5
    assert found.late_common_s == pytest.approx(common_s)


def test_a_reference_of_which_nothing_is_known_leaves_what_a_conversion_permits() -> None:
    (found,) = separate_delays(seen(1.5e-3), Parameter(value=0.0, sigma=1.0))
    assert values_of([found]) == pytest.approx([0.0], abs=1e-8)
    assert found.late_common_s == pytest.approx(SAMPLE_DELAY_SIGMA_S, rel=1e-3)


def test_a_tile_without_fast_loads_has_no_instant_of_its_own() -> None:
    untold = Effects()
    found = separate_delays([*seen(1e-3), untold], DEFAULT_REFERENCE_DELAY)
    assert found[1] == untold
    assert separate_delays([untold], DEFAULT_REFERENCE_DELAY) == [untold]
