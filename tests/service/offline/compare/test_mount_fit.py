"""Gains and shear of a mounted foot, from loads whose truth is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from devices.arrays import Floats
from devices.errors import CalibrationError
from service.offline.compare.paired_frames import pair_frames
from service.offline.mount_calibration import MountFit, fit_mount
from tests.service.offline.compare.sessions import HZ, columns, half_sines, reference, same_clock

SERIALS = ("T01", "T02", "T03", "T04")
AXES_RAD = np.array([-0.6, -0.2, 0.2, 0.6])
GAINS = np.array([1.05, 0.9, 1.2, 1.0])
PEAKS_N = [20.0, 24.0, 18.0, 22.0, 26.0, 21.0, 19.0, 23.0]


def rolled(seed: int, *, rolls: bool = True) -> tuple[Floats, Floats]:
    """Tile forces and the segment's angle: stances in which the load goes from tile to tile."""
    total_n = half_sines(PEAKS_N)
    phase = np.arange(len(total_n)) / HZ % 1.0 - 0.5
    turned_rad = np.clip(3.0 * (phase - 0.25), -0.8, 0.8) if rolls else np.zeros(len(total_n))
    place = turned_rad if rolls else np.zeros(len(total_n))
    share = np.exp(-(((place[:, None] - AXES_RAD) / 0.4) ** 2))
    share /= share.sum(axis=1, keepdims=True)
    rng = np.random.default_rng(seed)
    return total_n[:, None] * share + 0.02 * rng.normal(size=(len(total_n), 4)), turned_rad


def fitted(
    force_n: Floats,
    turned_rad: Floats,
    *,
    gains: float | Floats = GAINS,
    true_shear: float = 0.0,
    plate_n: Floats | None = None,
    **asked: Any,
) -> MountFit:
    """What is found where a plate sees tiles with these gains and this shear, or this force."""
    tilted = 1.0 - np.cos(AXES_RAD - turned_rad.reshape(len(force_n), -1))
    if plate_n is None:
        plate_n = ((1.0 + true_shear * tilted) * force_n) @ (np.ones(4) * gains)
        plate_n += 0.1 * np.random.default_rng(99).normal(size=len(plate_n))
    grf_n = force_n.sum(axis=1)
    ours = columns(grf_n, contact=(grf_n > 0.5).astype(np.uint8))
    pairs = pair_frames(ours, reference(plate_n), same_clock(), remove_offset=True)
    n = len(pairs.t_s)
    return fit_mount(pairs, force_n[:n], tilted[:n], SERIALS, **asked)


def test_a_gain_of_the_whole_foot_is_found_within_its_interval_and_mends_the_error() -> None:
    mount = fitted(*rolled(1), gains=1.25)
    low, high = mount.gains[0].interval_95
    assert low < 1.25 < high
    assert high - low < 0.01
    assert len({gain.value for gain in mount.gains}) == 1
    assert mount.mae_after_n == pytest.approx(0.08, abs=0.02)  # what is left is the plate's noise
    assert mount.mae_before_n > 1.0


def test_gains_of_tiles_are_found_where_loads_go_from_tile_to_tile() -> None:
    mount = fitted(*rolled(2), per_tile=True)
    assert [gain.value for gain in mount.gains] == pytest.approx(GAINS, abs=0.01)
    assert max(gain.sigma for gain in mount.gains) < 0.01


@pytest.mark.parametrize("true", [-1.0, 0.6])
def test_a_shear_is_found_where_tiles_are_far_from_upright_at_changing_angles(true: float) -> None:
    mount = fitted(*rolled(3), gains=1.1, true_shear=true, fit_shear=True)
    assert mount.shear is not None
    low, high = mount.shear.interval_95
    assert low < true < high
    assert high - low < 0.2
    assert mount.gains[0].value == pytest.approx(1.1, abs=0.01)


def test_tiles_that_always_bear_their_loads_together_have_no_gains_of_their_own() -> None:
    force_n, turned_rad = rolled(4, rolls=False)
    with pytest.raises(CalibrationError, match="does not determine T01"):
        fitted(force_n, turned_rad, per_tile=True)
    exactly = np.round(force_n.sum(axis=1), 1)[:, None] * np.array([0.1, 0.4, 0.4, 0.1])
    with pytest.raises(CalibrationError, match="does not determine T01, T02, T03, T04;"):
        fitted(exactly, turned_rad, per_tile=True)
    assert fitted(force_n, turned_rad, gains=1.2).gains[0].value == pytest.approx(1.2, abs=0.01)


def test_a_tile_that_was_never_loaded_has_no_gain_and_is_named() -> None:
    force_n, turned_rad = rolled(5)
    force_n[:, 3] = 0.02 * np.random.default_rng(5).normal(size=len(force_n))
    with pytest.raises(CalibrationError, match=r"does not determine T04 \("):
        fitted(force_n, turned_rad, per_tile=True)


def test_tiles_that_are_upright_throughout_tell_no_shear() -> None:
    force_n, _ = rolled(6)
    upright_rad = np.broadcast_to(AXES_RAD, force_n.shape)
    with pytest.raises(CalibrationError, match="does not determine the shear;"):
        fitted(force_n, upright_rad, plate_n=force_n.sum(axis=1), fit_shear=True)


def test_frames_whose_angle_is_not_known_tell_no_shear_and_few_frames_nothing() -> None:
    force_n, turned_rad = rolled(7)
    with pytest.raises(CalibrationError, match="0 frames under load"):
        fitted(force_n, np.full(len(turned_rad), np.nan), fit_shear=True)
    mount = fitted(force_n, turned_rad, gains=1.1)
    assert mount.frame_count > 1000


def test_the_plates_own_gain_is_in_the_doubt_of_ours() -> None:
    sure = fitted(*rolled(8), gains=1.1)
    doubtful = fitted(*rolled(8), gains=1.1, reference_gain_sigma=0.01)
    assert doubtful.gains[0].sigma == pytest.approx(np.hypot(sure.gains[0].sigma, 0.011), rel=0.01)


def test_a_residual_lag_does_not_change_the_gain() -> None:
    force_n, _ = rolled(9)
    late_n = np.roll(force_n, 2, axis=0)  # 4 ms
    mount = fitted(late_n, np.zeros(len(late_n)), plate_n=1.1 * force_n.sum(axis=1))
    assert mount.gains[0].value == pytest.approx(1.1, abs=0.003)
    assert mount.residual_lag_s.value == pytest.approx(0.0044, abs=0.0006)
