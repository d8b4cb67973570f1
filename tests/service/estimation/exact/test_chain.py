"""The full ladder, from counts to GRF and centre of pressure, against fifty digits.

Three domes and a bare tile; 70 frames with a step, a spike, a gap of a minute, a silent tile, a
saturated one, warmth and water.
"""

from __future__ import annotations

import numpy as np
import pytest
from mpmath import mp, mpf

from devices.flags import EstimateFlag, TileFlag
from devices.frames import NOT_READ, FrameBatch
from service.estimation.effects import FlowEffect, Parameter
from service.estimation.pipeline.params import MODEL_NAMES
from service.estimation.pipeline.plan import EstimationPlan, make_plan
from service.estimation.pipeline.smoothing_stage import BOUND_SIGMAS
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP, array_at
from tests.builders.calibrations import make_calibration, make_effects, make_tare, newton_tile
from tests.builders.estimates import estimate
from tests.builders.frames import loaded_frames
from tests.service.estimation.exact import digits
from tests.service.estimation.exact.chain import compute_chain, compute_sigma

PARTS = [DATA_SHEET_CHIP, FORUM_CHIP] * 2
UNLOADED_COUNTS = (380, 287, 369, 302)
POSITIONS_M = [(-0.02, 0.011, -0.15), (0.0, -0.007, -0.15), (0.02, 0.01, -0.15), (0.1, 0.0, -0.1)]
LAG_MS = 10.0
ROWS = 70


@pytest.fixture(scope="module")
def plan() -> EstimationPlan:
    """Plan in which every dome has its own effects, without round numbers."""
    info = array_at(POSITIONS_M, references=[3], chips=PARTS)
    known = make_effects()
    assert known.gas is not None
    assert known.rubber is not None
    assert known.hysteresis is not None
    tiles = []
    for i in range(3):
        curve = (0.0, 13.25 + i, 1.0 / 3.0, 4.7 - 0.3 * i)
        tau_s = known.gas.tau_s.model_copy(update={"value": 0.0047 * (1 + i)})
        covariance = ((4e-3, 1e-3, -2e-3), (1e-3, 2e-3, 0.0), (-2e-3, 0.0, 3e-3))
        rubber = known.rubber.model_copy(update={"coefficients": curve, "covariance": covariance})
        gas = known.gas.model_copy(update={"tau_s": tau_s})
        flow = FlowEffect(
            part=Parameter(value=0.07 + 0.01 * i, sigma=0.01),
            stress_n=Parameter(value=0.11 * (1 + i), sigma=0.01),
            power=Parameter(value=3.3 + i, sigma=0.1),
        )
        loop = known.hysteresis.model_copy(update={"flow": flow})
        tiles.append(
            newton_tile(
                info.serials[i],
                coefficients=curve,
                p_offset_kpa=9.37,
                p_scale_kpa=9.37,
                range_kpa=(0.0, 18.74),
                effects=known.model_copy(update={"gas": gas, "rubber": rubber, "hysteresis": loop}),
            )
        )
    tare = make_tare(
        4,
        baseline_kpa=[100.30127, 99.87654321, 101.7, 98.0 + 1 / 3],
        baseline_sigma_kpa=[0.0071, 0.0073, 0.007, 0.0069],
        noise_kpa=[0.165, 0.171, 0.163, 0.168],
        temperature_raw_counts=[507.3, 506.7, 507.0, 1522 / 3],
    )
    return make_plan(info, make_calibration(*tiles), tare, models=MODEL_NAMES, lag_ms=LAG_MS)


def make_eventful_frames(seed: int) -> tuple[FrameBatch, list[int]]:
    """Make the recording, and the number of the unbroken run of each frame."""
    rng = np.random.default_rng(seed)
    load = np.zeros((ROWS, 4))
    load[8:, :3] = [60, 45, 70]
    load[30:, :3] += 12 * np.sin(np.arange(ROWS - 30) / 5.0)[:, None]
    load[52:, :3] *= 0.2
    load += rng.normal(0, 1.3, load.shape)
    load[20, 1] -= 14.0
    load[44:46, 2] = 200.0
    load[:, 3] = np.linspace(0, 6, ROWS)
    pressure_raw = np.array(UNLOADED_COUNTS) - np.rint(load).astype(int)
    temperature_raw = 507 - np.arange(ROWS)[:, None] // 9 + rng.integers(0, 2, pressure_raw.shape)
    status = np.zeros(pressure_raw.shape, dtype=int)
    pressure_raw[25, 0], temperature_raw[25, 0], status[25, 0] = (
        NOT_READ,
        NOT_READ,
        TileFlag.NO_ANSWER,
    )
    steps_ns = np.full(ROWS, 1_838_235)
    steps_ns[38] = 60 * 10**9
    frames = loaded_frames(
        np.zeros(pressure_raw.shape),
        pressure_raw=pressure_raw,
        temperature_raw=temperature_raw,
        tile_flags=status,
        t_mono_ns=np.cumsum(steps_ns),
        sample_offset_us=np.tile([0, 431, 862, 1293], (ROWS, 1)),
    )
    return frames, [int(row >= 38) for row in range(ROWS)]


@pytest.mark.slow(parts=8)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_full_ladder_is_within_a_nanonewton(plan: EstimationPlan, seed: int) -> None:
    frames, run = make_eventful_frames(seed)
    e = estimate(plan, *(frames.slice_rows(i, i + 11) for i in range(0, ROWS, 11)))
    exact = compute_chain(plan, frames, run)
    for i in range(4):
        assert digits.apart(e.gauge_kpa[:, i], exact.gauge_kpa[i]) < 1e-10
    one = [mpf(1)]
    for i in range(3):
        assert digits.apart(e.force_n[:, i], exact.stated_n[i]) < 1e-9
        sigma_n = [
            None if f is None or b else compute_sigma(exact.errors[i : i + 1], k, one)
            for k, (f, b) in enumerate(zip(exact.force_n[i], exact.is_bound[i], strict=True))
        ]
        assert digits.apart(e.force_sigma_n[:, i], sigma_n) < 1e-9
    by_frame = list(zip(*exact.force_n, strict=True))
    bound = [any(row) for row in zip(*exact.is_bound, strict=True)]
    grf = [None if None in row or b else sum(row) for row, b in zip(by_frame, bound, strict=True)]
    assert digits.apart(e.grf_n, grf) < 1e-9
    sigma_n = [
        None if f is None else compute_sigma(exact.errors, k, 3 * one) for k, f in enumerate(grf)
    ]
    assert digits.apart(e.grf_sigma_n, sigma_n) < 1e-9
    least = []
    for k, row in enumerate(by_frame):
        known = [i for i, force in enumerate(row) if force is not None]
        total = mp.fsum(row[i] for i in known)
        doubt = compute_sigma([exact.errors[i] for i in known], k, one * len(known))
        least.append(total - mpf(BOUND_SIGMAS) * doubt)
    assert digits.apart(e.grf_lower_bound_n, least) < 1e-9
    assert None in grf
    stated = np.flatnonzero(np.isfinite(e.cop_x_m)).tolist()
    assert len(stated) > 20
    for axis, name in enumerate(("x", "y")):
        places = [mpf(position[axis]) for position in POSITIONS_M[:3]]
        centre = [mp.fdot(by_frame[k], places) / grf[k] for k in stated]
        assert digits.apart(getattr(e, f"cop_{name}_m")[stated], centre) < 1e-11
        sigma_m = [
            compute_sigma(exact.errors, k, [(place - at) / grf[k] for place in places])
            for k, at in zip(stated, centre, strict=True)
        ]
        assert digits.apart(getattr(e, f"cop_sigma_{name}_m")[stated], sigma_m) < 1e-11
    flags = EstimateFlag.OUTLIER_REPLACED, EstimateFlag.GAP, EstimateFlag.SATURATED
    for flag in (*flags, EstimateFlag.TILE_MISSING, EstimateFlag.AFTER_SATURATION):
        assert (e.estimate_flags & flag).any(), flag
