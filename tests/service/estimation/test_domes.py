"""Boyle's law and the domes of the paper's Table I: figures as in the paper and hardware.md 9."""

from __future__ import annotations

import pytest

from service.estimation.domes import (
    ADIABATIC,
    DOMES,
    PAPER_DOME,
    VYTAFLEX_40,
    VYTAFLEX_60,
    Dome,
    compute_ambient_transmission,
    compute_fast_to_slow_saturation_load_ratio,
    compute_saturation_load,
    compute_volume_ratio,
    compute_wall_compliance_per_kpa,
    list_saturation_loads,
    select_likely_covering_dome,
)


def test_a_slow_load_takes_thirteen_percent_of_the_volume_to_115_kpa() -> None:
    assert compute_volume_ratio() == pytest.approx(0.8696, abs=5e-5)


def test_a_fast_load_is_at_full_scale_earlier() -> None:
    assert compute_volume_ratio(exponent=ADIABATIC) == pytest.approx(0.9050, abs=5e-5)
    assert compute_fast_to_slow_saturation_load_ratio() == pytest.approx(0.095 / 0.1304, abs=0.001)


def test_a_polytropic_load_lies_between_slow_and_fast() -> None:
    assert (
        compute_volume_ratio()
        < compute_volume_ratio(exponent=1.2)
        < compute_volume_ratio(exponent=ADIABATIC)
    )


def test_the_wall_gives_way_as_a_thick_sphere() -> None:
    assert compute_wall_compliance_per_kpa(Dome(VYTAFLEX_60, 11.0)) == pytest.approx(
        0.00124, abs=5e-6
    )
    assert compute_wall_compliance_per_kpa(Dome(VYTAFLEX_40, 11.0)) == pytest.approx(
        0.00389, abs=5e-6
    )


def test_a_bubble_sees_11_or_28_percent_of_the_outer_pressure() -> None:
    assert compute_ambient_transmission(Dome(VYTAFLEX_60, 11.0)) == pytest.approx(0.11, abs=0.005)
    assert compute_ambient_transmission(Dome(VYTAFLEX_40, 11.0)) == pytest.approx(0.28, abs=0.005)


def test_table_i_has_three_diameters_of_two_materials() -> None:
    assert [(d.material.modulus_mpa, d.diameter_mm) for d in DOMES] == [
        *((0.69, 10.0), (0.69, 11.0), (0.69, 12.0)),
        *((2.17, 10.0), (2.17, 11.0), (2.17, 12.0)),
    ]


def test_only_the_papers_own_dome_has_the_papers_range() -> None:
    found = compute_saturation_load(PAPER_DOME)
    assert (found.low_n, found.high_n, found.source) == (25.0, 35.0, "paper")
    assert {compute_saturation_load(dome).source for dome in DOMES if dome != PAPER_DOME} == {
        "estimate"
    }


def test_others_scale_with_modulus_and_area() -> None:
    softer = compute_saturation_load(Dome(VYTAFLEX_40, 11.0))
    assert softer.low_n == pytest.approx(25.0 * 0.69 / 2.17)
    larger = compute_saturation_load(Dome(VYTAFLEX_60, 12.0))
    assert larger.high_n == pytest.approx(35.0 * (12 / 11) ** 2)


def test_the_weakest_dome_that_covers_a_load_is_named() -> None:
    names = {
        load_n: found.dome.name
        for load_n in (5, 12, 24, 28)
        if (found := select_likely_covering_dome(load_n))
    }
    assert names == {5: "v40-10", 12: "v60-10", 24: "v60-11", 28: "v60-12"}


def test_a_load_within_the_papers_spread_is_only_perhaps_covered() -> None:
    found = select_likely_covering_dome(32.0)
    assert found is not None
    assert (found.dome.name, found.judge_slow_load(32.0)) == ("v60-11", "perhaps")


def test_a_load_beyond_every_dome_has_none() -> None:
    assert select_likely_covering_dome(50.0) is None
    assert all(found.judge_slow_load(50.0) == "saturates" for found in list_saturation_loads())


def test_no_load_is_refused() -> None:
    with pytest.raises(ValueError, match="no load"):
        select_likely_covering_dome(0.0)
