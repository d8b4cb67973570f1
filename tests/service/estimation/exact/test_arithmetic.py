"""The static estimate against the same equations at fifty digits.

The reference is written from the data sheet (eq. 1 and 2), the calibration's definition and the
design, not from the estimator; it takes the same float64 inputs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mpmath import mp, mpf

from devices.flags import EstimateFlag
from devices.frames import NOT_READ, FrameBatch
from service.estimation.calibration import TileCalibration, make_paper_shape_preset
from service.estimation.pipeline.plan import EstimationPlan, make_plan
from service.estimation.pipeline.smoothing_stage import BOUND_SIGMAS
from service.estimation.records import Estimates
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP, array_at
from tests.builders.calibrations import make_calibration, make_tare, newton_tile
from tests.builders.estimates import estimate, with_params
from tests.builders.frames import loaded_frames
from tests.service.estimation.exact import sample_stage
from tests.service.estimation.exact.digits import Exact, apart

STEEPEST_CHIP = (0x7FFF, 0x8000, 0x8000, 0x7FFC)
"""The greatest a0 and c12 and the least b1 and b2 of the registers."""
FLATTEST_CHIP = (0x0001, 0xFFFF, 0xFFFF, 0x0004)
"""The smallest of each: hardly any pressure in its counts."""
POSITIONS_M = [
    (-0.0209315, 0.011, -0.148532),
    (-0.00699746, -0.007, -0.149837),
    (0.00699746, 0.009, -0.149837),
    (0.0209315, -0.013, -0.148532),
]
TILES = [
    make_paper_shape_preset().tiles[0].model_copy(update={"serial": "T01"}),
    newton_tile(
        "T02",
        coefficients=(0.0, 13.25, 1.0 / 3.0, 4.7),
        p_offset_kpa=9.37,
        p_scale_kpa=9.37,
        f_offset_n=1.5,
        range_kpa=(0.0, 18.74),
        covariance=((4e-3, 1e-3, -2e-3), (1e-3, 2e-3, 0.0), (-2e-3, 0.0, 3e-3)),
        relative_misfit=0.017,
        loop_misfit_n=0.21,
    ),
    newton_tile(
        "T03",
        coefficients=(0.1309, 0.5702, 0.02354, 0.13),
        p_offset_kpa=1.7,
        p_scale_kpa=15.0 / 1.1,
        f_offset_n=-0.3,
        f_scale_n=41.45,
        zero_mode="as_fitted",
        range_kpa=(0.0, 30.0),
        covariance=((1e-6,) * 3,) * 3,
    ),
    newton_tile(
        "T04",
        coefficients=(1e6, 1.0, 100.0, 1e4),
        p_offset_kpa=-100.0,
        p_scale_kpa=900.0,
        f_scale_n=3.0,
        range_kpa=(0.0, 20.0),
    ),
]
"""The paper's preset, a fit as the rig makes it, one as fitted, and a hard one."""


def compute_tile(plan: EstimationPlan, i: int, gauge_kpa: Exact) -> tuple[Exact, Exact]:
    """Compute a tile's force and sigma."""
    entry: TileCalibration = plan.calibration.get_tile_or_wildcard(plan.info.tiles[i].serial)
    force, slope, variance = sample_stage.static(entry, gauge_kpa)
    variance += (mpf(entry.relative_misfit) * force) ** 2
    variance += (mpf(entry.loop_misfit_n) * abs(force) / (abs(force) + 1)) ** 2
    for kpa in (plan.tare.noise_kpa[i], plan.tare.baseline_sigma_kpa[i]):
        variance += (slope * mpf(float(kpa))) ** 2
    if entry.zero_mode == "as_fitted":
        u0 = -mpf(entry.p_offset_kpa) / mpf(entry.p_scale_kpa)
        constant = sum(mpf(c) * u0**k for k, c in enumerate(entry.coefficients))
        force += mpf(entry.f_offset_n) + mpf(entry.f_scale_n) * constant
    if gauge_kpa > mpf(entry.range_kpa[1]):
        return force - mpf(BOUND_SIGMAS) * mp.sqrt(variance), None
    return force, mp.sqrt(variance)


def assert_exact(plan: EstimationPlan, frames: FrameBatch) -> Estimates:
    """Compare the estimates of frames with the reference: 1e-9 N, 1e-10 kPa and 1e-11 m."""
    e = estimate(plan, frames)
    for row in range(len(frames)):
        gauge_kpa: list[Exact] = []
        forces: list[tuple[Exact, Exact]] = []
        for i, tile in enumerate(plan.info.tiles):
            counts = int(frames.pressure_raw[row, i]), int(frames.temperature_raw[row, i])
            kpa = sample_stage.pressure_kpa(tile.registers, *counts)
            is_faulty = int(frames.tile_flags[row, i]) & (1 | 2 | 8 | 32) or NOT_READ in counts
            is_missing = is_faulty or kpa is None
            gauge_kpa.append(None if is_missing else kpa - mpf(plan.tare.baseline_kpa[i]))
            is_pulled = is_missing or gauge_kpa[i] < -10  # no foot pulls like that
            forces.append((None, None) if is_pulled else compute_tile(plan, i, gauge_kpa[i]))
        force_n, sigma_n = (list(column) for column in zip(*forces, strict=True))
        grf_n = None if None in force_n or None in sigma_n else mp.fsum(force_n)
        assert apart(e.gauge_kpa[row], gauge_kpa) < 1e-10
        assert apart(e.force_n[row], force_n) < 1e-9
        assert apart(e.force_sigma_n[row], sigma_n) < 1e-9
        assert apart(e.grf_n[row], [grf_n]) < 1e-9
        for axis, cop_m in enumerate((e.cop_x_m[row], e.cop_y_m[row])):
            if np.isfinite(cop_m):
                moment = mp.fsum(
                    f * mpf(p[axis]) for f, p in zip(force_n, POSITIONS_M, strict=True)
                )
                assert apart(cop_m, [moment / grf_n]) < 1e-11
    return e


def plan_with(*chips: tuple[int, int, int, int]) -> EstimationPlan:
    """Make a plan with these chips, tared as a real session is: baselines are no round numbers."""
    tare = make_tare(
        4,
        baseline_kpa=[100.30127, 99.87654321, 101.7, 98.0 + 1 / 3],
        baseline_sigma_kpa=[0.0071, 0.0073, 0.007, 0.0069],
        noise_kpa=[0.165, 0.171, 0.163, 0.168],
        temperature_raw_counts=np.nan,  # unknown, so that any temperature is valid
    )
    info = array_at(POSITIONS_M, chips=chips)
    plan = make_plan(info, make_calibration(*TILES), tare, models=("unwrap", "static"))
    return with_params(plan, foot={"cop_sigma_max_m": 1.0})


def frames_of(pressure_raw: Any, temperature_raw: Any, tile_flags: Any = 0) -> FrameBatch:
    return loaded_frames(
        np.zeros((len(pressure_raw), 4)),
        pressure_raw=pressure_raw,
        temperature_raw=temperature_raw,
        tile_flags=tile_flags,
    )


CHIPS = {
    "real": (DATA_SHEET_CHIP, FORUM_CHIP, DATA_SHEET_CHIP, FORUM_CHIP),
    "extreme": (STEEPEST_CHIP, FLATTEST_CHIP, FLATTEST_CHIP, STEEPEST_CHIP),
}


@pytest.mark.parametrize("chips", CHIPS)
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_counts_are_exact(chips: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    edges = [0, 1, 2, 511, 512, 513, 987, 1006, 1021, 1022, 1023]
    shape = (5, 4)
    pressure_raw, temperature_raw = (
        np.where(rng.random(shape) < 0.3, rng.choice(edges, shape), rng.integers(0, 1024, shape))
        for _ in range(2)
    )
    pressure_raw[rng.random(shape) < 0.02] = NOT_READ
    flags = rng.choice([0] * 20 + [1, 2, 4, 8, 16, 32], shape)
    assert_exact(plan_with(*CHIPS[chips]), frames_of(pressure_raw, temperature_raw, flags))


def test_forces_of_any_size_and_sign_and_their_centre_are_exact() -> None:
    # The first rows are zero load, a count of load or suction, and sums across zero.
    rng = np.random.default_rng(7)
    small = [[0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [3, -3, 40, -40], [-3, 3, 1, -1]]
    counts = np.concatenate([small, rng.integers(-3, 4, (20, 4)), rng.integers(0, 135, (60, 4))])
    frames = frames_of(np.array([380, 287, 369, 302]) - counts, 507)
    e = assert_exact(plan_with(*CHIPS["real"]), frames)
    assert np.isfinite(e.cop_x_m).sum() > 30
    assert (e.estimate_flags & EstimateFlag.SATURATED).any()
