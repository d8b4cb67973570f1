"""Boyle's law and the domes of the paper's Table I: figures as in the paper and hardware.md 9."""

from __future__ import annotations

import numpy as np
import pytest

from devices.emulation.parts import draw_dome
from service.estimation.domes import (
    ADIABATIC,
    DOMES,
    PAPER_DOME,
    VYTAFLEX_40,
    VYTAFLEX_60,
    Dome,
    Material,
    compute_ambient_transmission,
    compute_fast_to_slow_saturation_load_ratio,
    compute_saturation_load,
    compute_volume_ratio,
    compute_wall_compliance_per_kpa,
    list_saturation_loads,
    select_weakest_covering_dome,
)


def test_a_fast_load_reaches_full_scale_before_a_slow_one() -> None:
    # A slow load takes 13 % of the volume to 115 kPa.
    slow, between, fast = (
        compute_volume_ratio(exponent=exponent) for exponent in (1.0, 1.2, ADIABATIC)
    )
    assert [slow, fast] == pytest.approx([0.8696, 0.9050], abs=5e-5)
    assert slow < between < fast
    assert compute_volume_ratio() == slow
    assert compute_fast_to_slow_saturation_load_ratio() == pytest.approx(0.095 / 0.1304, abs=0.001)


@pytest.mark.parametrize(
    ("material", "per_kpa", "transmitted"),
    [(VYTAFLEX_60, 0.00124, 0.11), (VYTAFLEX_40, 0.00389, 0.28)],
)
def test_a_wall_yields_as_a_thick_sphere_and_transmits_ambient_pressure(
    material: Material, per_kpa: float, transmitted: float
) -> None:
    dome = Dome(material, 11.0)
    assert compute_wall_compliance_per_kpa(dome) == pytest.approx(per_kpa, abs=5e-6)
    assert compute_ambient_transmission(dome) == pytest.approx(transmitted, abs=0.005)


def test_table_i_has_three_diameters_of_two_materials() -> None:
    assert [(d.material.modulus_mpa, d.diameter_mm) for d in DOMES] == [
        *((0.69, 10.0), (0.69, 11.0), (0.69, 12.0)),
        *((2.17, 10.0), (2.17, 11.0), (2.17, 12.0)),
    ]


def test_a_dome_bears_more_to_the_end_of_a_wider_chip() -> None:
    found = compute_saturation_load(PAPER_DOME, 125.0)
    assert found.source == "estimate"
    # A fifth of the volume is gone instead of 13 %; the paper's cubic at 25 / 15 of its full scale.
    assert found.low_n == pytest.approx(25.0 * 0.2 / 0.1304, rel=1e-3)
    assert found.high_n == pytest.approx(35.0 * 2.235, rel=1e-3)
    assert select_weakest_covering_dome(45.0, 125.0) == compute_saturation_load(
        Dome(VYTAFLEX_60, 12.0), 125.0
    )
    for serial in ("T01", "T02", "T03", "T04"):  # emulated ones are stiffer than the lower bound
        emulated_n = draw_dome(serial, 0).compute_static_force_n(np.array([125.0]))
        assert emulated_n > found.low_n


def test_only_the_papers_dome_has_the_papers_range() -> None:
    found = compute_saturation_load(PAPER_DOME)
    assert (found.low_n, found.high_n, found.source) == (25.0, 35.0, "paper")
    assert {compute_saturation_load(dome).source for dome in DOMES if dome != PAPER_DOME} == {
        "estimate"
    }


def test_other_domes_scale_with_modulus_and_area() -> None:
    softer = compute_saturation_load(Dome(VYTAFLEX_40, 11.0))
    assert softer.low_n == pytest.approx(25.0 * 0.69 / 2.17)
    larger = compute_saturation_load(Dome(VYTAFLEX_60, 12.0))
    assert larger.high_n == pytest.approx(35.0 * (12 / 11) ** 2)


def test_the_weakest_dome_that_covers_a_load_is_named() -> None:
    names = {
        load_n: found.dome.name
        for load_n in (5, 12, 24, 28)
        if (found := select_weakest_covering_dome(load_n))
    }
    assert names == {5: "v40-10", 12: "v60-10", 24: "v60-11", 28: "v60-12"}


def test_a_load_within_the_papers_spread_is_perhaps_covered() -> None:
    found = select_weakest_covering_dome(32.0)
    assert found is not None
    assert (found.dome.name, found.judge_slow_load(32.0)) == ("v60-11", "perhaps")


def test_a_load_beyond_every_dome_has_none() -> None:
    assert select_weakest_covering_dome(50.0) is None
    assert all(found.judge_slow_load(50.0) == "saturates" for found in list_saturation_loads())


def test_no_load_is_refused() -> None:
    with pytest.raises(ValueError, match="no load"):
        select_weakest_covering_dome(0.0)
