"""What a reference cannot be: a wrong unit of force or of place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.errors import ComparisonError
from service.offline.compare.alignment import ReferenceAlignment
from service.offline.compare.block_covariance import UncertainValue
from service.offline.compare.paired_frames import PairedFrames, pair_frames
from service.offline.compare.plausibility import (
    advise_on_scale,
    check_cop_position,
    check_force_unit,
    check_time_unit,
    describe_implausible_alignment,
)
from service.offline.compare.signals import ForceSignal
from tests.service.offline.compare.sessions import columns, half_sines, reference, same_clock

FOOT_M = np.array([(0.02, 0.015), (0.02, -0.015), (-0.02, 0.015), (-0.02, -0.015)])
FORCE_N = half_sines([10.0, 12.0])


def aligned(
    scale: float = 1.0, sigma: float = 0.0, drift_ppm: tuple[float, float] = (0.0, 0.0)
) -> ReferenceAlignment:
    return replace(
        same_clock(),
        scale=UncertainValue(scale, sigma, 8.0),
        drift_ppm=UncertainValue(*drift_ppm, 8.0),
    )


def under(x_m: np.ndarray) -> PairedFrames:
    cop_m = np.stack([x_m, np.zeros(len(FORCE_N))], axis=1)
    return pair_frames(columns(FORCE_N), reference(FORCE_N, cop_m=cop_m), same_clock())


@pytest.mark.parametrize(("scale", "unit"), [(1000.0, "kN"), (800.0, "kN"), (0.0012, "mN")])
def test_a_scale_of_a_thousand_is_another_unit(scale: float, unit: str) -> None:
    with pytest.raises(ComparisonError, match=f"may be {unit}"):
        check_force_unit(aligned(scale))


def over(seconds: float, step_s: float) -> ForceSignal:
    t_s = np.arange(0.0, seconds, step_s)
    return ForceSignal(t_s, np.sin(t_s))


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us"), (1e9, "ns")])
def test_a_reference_a_thousand_times_as_long_has_another_unit_of_time(
    factor: float, unit: str
) -> None:
    theirs = over(8.0, 0.001)
    longer = ForceSignal(factor * theirs.t_s, theirs.force_n)
    with pytest.raises(ComparisonError, match=f"--units time={unit}"):
        check_time_unit(over(10.0, 0.002), longer)


def test_a_long_recording_around_a_short_session_is_no_wrong_unit() -> None:
    check_time_unit(over(2.0, 0.002), over(2000.0, 0.01))


@pytest.mark.parametrize("scale", [0.5, 1.0, 9.81])
def test_other_scales_are_for_the_user_to_judge(scale: float) -> None:
    check_force_unit(aligned(scale))


@pytest.mark.parametrize(
    ("scale", "says"),
    [(9.9, "in kgf"), (4.4, "in lbf"), (2.5, "its unit or its place"), (0.3, "its unit or its")],
)
def test_a_scale_that_no_foot_has_is_said_with_the_unit_that_it_may_be(
    scale: float, says: str
) -> None:
    (note,) = describe_implausible_alignment(aligned(scale))
    assert says in note
    assert advise_on_scale(aligned(scale)) == []


def test_clocks_that_differ_by_more_than_clocks_do_are_said() -> None:
    (note,) = describe_implausible_alignment(aligned(drift_ppm=(2963.0, 400.0)))
    assert "2963 ppm" in note
    for drift_ppm in ((2963.0, 1500.0), (90.0, 1.0)):
        assert describe_implausible_alignment(aligned(drift_ppm=drift_ppm)) == []


def test_a_gain_that_is_not_one_points_to_the_calibration_of_a_mounted_foot() -> None:
    assert advise_on_scale(aligned(0.99, 0.02)) == []
    (note,) = advise_on_scale(aligned(0.8, 0.02))
    assert "calibrate --reference" in note


TRAVEL = np.linspace(-0.015, 0.015, len(FORCE_N))


def test_a_cop_under_the_foot_needs_no_word_and_one_beside_it_is_said() -> None:
    assert check_cop_position(under(TRAVEL), FOOT_M) == []
    (note,) = check_cop_position(under(TRAVEL + 0.4), FOOT_M)
    assert "outside the foot by more than 4.2 mm in 100 % of its frames" in note


@pytest.mark.parametrize(
    ("off_m", "reference_sigma_m", "is_said"),
    [(0.0, None, False), (0.006, None, True), (0.006, 0.003, False), (0.02, 0.003, True)],
)
def test_the_edge_of_the_foot_has_the_uncertainty_of_a_cop(
    off_m: float, reference_sigma_m: float | None, is_said: bool
) -> None:
    """A foot that stands on the tiles at its end, and a plate that is right to 0.3 mm."""
    row_m = np.array([(-0.02, 0.0), (0.0, 0.0), (0.02, 0.0)])
    noise_m = np.random.default_rng(1).normal(0.0, 0.0003, len(FORCE_N))
    pairs = under(0.02 + off_m + noise_m)
    assert bool(check_cop_position(pairs, row_m, reference_sigma_m)) == is_said


def test_a_cop_in_millimetres_read_as_metres_is_refused() -> None:
    with pytest.raises(ComparisonError, match="may be mm or cm"):
        check_cop_position(under(1e3 * TRAVEL), FOOT_M)


def test_a_centre_of_pressure_under_a_few_newtons_tells_nothing_of_its_unit() -> None:
    # As of a real plate: right under load, and anywhere within some samples of its zero.
    x_m = np.where(FORCE_N > 1.0, 0.01, np.where(np.arange(len(FORCE_N)) % 2, 80.0, -80.0))
    assert check_cop_position(under(x_m), FOOT_M) == []
