"""The flags of an estimate, and the effects of a faulty tile and of a tare."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from devices.flags import EstimateFlag, TileFlag
from service.estimation.pipeline.params import MODEL_NAMES
from service.estimation.pipeline.plan import make_plan
from service.estimation.tare.tare import Tare
from tests.builders.arrays import COUNT_KPA, array_at, make_servo
from tests.builders.calibrations import make_effects, newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import loaded_frames
from tests.service.estimation.feet import COP, SQUARE, estimate_load, repeat_load

HALF_HOUR_NS = 1_800_000_000_000
GRF = ("grf_n", "grf_sigma_n", "grf_lower_bound_n")
INFO = array_at(SQUARE)


def find(flag: EstimateFlag, estimate_flags: np.ndarray) -> list[int]:
    """Find the frames with a flag."""
    return np.flatnonzero(estimate_flags & flag).tolist()


# --- faults ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", [flag for flag in TileFlag if flag & TileFlag.UNUSABLE])
def test_a_faulty_tile_is_missing_and_its_neighbours_are_not(fault: TileFlag) -> None:
    tile_flags = np.zeros((12, 4))
    tile_flags[11, 1] = fault | TileFlag.RETRIED
    e = estimate_load([7, 8, 9, 10], tile_flags=tile_flags)
    assert e.force_n[11] == pytest.approx([7, np.nan, 9, 10], nan_ok=True)
    assert e.gauge_kpa[11] / COUNT_KPA == pytest.approx([7, np.nan, 9, 10], nan_ok=True)
    assert np.isnan([getattr(e, name)[11] for name in (*GRF[:2], *COP)]).all()
    # Of three tiles the noise is 0.5 N each.
    assert e.grf_lower_bound_n[11] == pytest.approx(26 - 2.33 * 0.5 * np.sqrt(3))
    assert e.contact[11] == 1
    assert e.estimate_flags[11] == EstimateFlag.TILE_MISSING | EstimateFlag.COP_MASKED
    assert e.grf_n[10] == pytest.approx(34)


# --- flags of forces ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("forces_n", "flags"),
    [
        ([9, 9, 9, 9], EstimateFlag(0)),
        ([0, 0, 0, 0], EstimateFlag.COP_MASKED),
        # The calibration ends at 150 N; 115 kPa is Pcomp 1023: 1787 - 2 pressure_raw at 382 counts,
        # which are 118 N.
        ([150, 9, 9, 9], EstimateFlag.OVER_RATED),
        ([151, 9, 9, 9], EstimateFlag.SATURATED | EstimateFlag.COP_MASKED),
        ([119, 115, 115, 115], EstimateFlag.OVER_RATED),
        ([118, 115, 115, 115], EstimateFlag(0)),
        # Five sigma of 0.5 N below the calibration.
        ([-3, 30, 30, 30], EstimateFlag.EXTRAPOLATED),
        ([-2, 30, 30, 30], EstimateFlag(0)),
    ],
)
def test_a_load_has_its_flags(forces_n: list[float], flags: EstimateFlag) -> None:
    e = estimate_load(forces_n)
    assert EstimateFlag(int(e.estimate_flags[-1])) == flags
    if not flags & EstimateFlag.SATURATED:
        assert e.force_n[-1] == pytest.approx(forces_n)
        assert e.grf_n[-1] == pytest.approx(sum(forces_n))


@pytest.mark.parametrize("forces_n", [[151, 9, 9, 9], [400, 400, 400, 400]])
def test_saturated_forces_and_their_sum_are_lower_bounds(forces_n: list[float]) -> None:
    e = estimate_load(forces_n)
    saturated = [force > 150 for force in forces_n]
    least_n = np.minimum(forces_n, 150.0)
    assert e.force_n[-1] == pytest.approx(least_n - np.where(saturated, 2.33 * 0.5, 0.0))
    assert np.isnan(e.force_sigma_n[-1]).tolist() == saturated
    assert np.isnan([e.grf_n[-1], e.grf_sigma_n[-1]]).all()
    assert e.grf_lower_bound_n[-1] == pytest.approx(least_n.sum() - 2.33 * 0.5 * 2)
    assert e.contact[-1] == 1


def test_an_assumed_scale_flags_every_frame() -> None:
    tiles = [newton_tile(serial, absolute_scale="assumed") for serial in INFO.serials]
    flags = estimate_load([9] * 4, newton_plan(INFO, tiles=tiles)).estimate_flags
    assert find(EstimateFlag.ASSUMED_SCALE, flags) == list(range(12))
    assert flags[-1] == EstimateFlag.ASSUMED_SCALE


# --- gaps -----------------------------------------------------------------------------------------

LATE_NS = np.cumsum([2, 2, 3, 2, 3, *[2] * 7]) * 1_000_000
LATE_NS[4:] += 1


@pytest.mark.parametrize(
    ("columns", "after_gap"),
    [
        ({"seq": [0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12]}, [6]),
        ({"t_mono_ns": LATE_NS}, [4]),
        ({"seq": np.arange(12) + 77_777}, []),
    ],
    ids=["a missing number", "more than half a period late", "a stream of later numbers"],
)
def test_a_gap_flags_the_frame_after_it(columns: dict[str, Any], after_gap: list[int]) -> None:
    flags = estimate_load([9] * 4, **columns).estimate_flags
    assert find(EstimateFlag.GAP, flags) == after_gap


def test_a_gap_between_two_batches_is_flagged_and_ends_contact() -> None:
    # 8 ms of load on each side of a minute are no contact
    first = loaded_frames(np.concatenate([repeat_load([0] * 4, 6), repeat_load([9] * 4, 5)]))
    later = replace(
        first.slice_rows(6, 11),
        seq=first.seq[6:11] + np.uint64(30_000),
        t_mono_ns=first.t_mono_ns[6:11] + 60_000_000_000,
    )
    for lag_ms in (0, 100):
        e = estimate(newton_plan(INFO, lag_ms=lag_ms), first, later)
        assert find(EstimateFlag.GAP, e.estimate_flags) == [11]
        unknown = 0 if lag_ms else 5
        assert e.contact.tolist() == [255] * unknown + [0] * (16 - unknown)


# --- tares ----------------------------------------------------------------------------------------


def test_a_tare_is_old_after_half_an_hour() -> None:
    plan = newton_plan(INFO)
    t_ns = plan.tare.t_ns + HALF_HOUR_NS + np.arange(-11, 1) * 2_000_000
    assert estimate_load([9] * 4, plan, t_ns=t_ns).estimate_flags[-1] == 0
    flags = estimate_load([9] * 4, plan, t_ns=t_ns + 1).estimate_flags
    assert find(EstimateFlag.TARE_OLD, flags) == [11]


def test_a_tare_at_another_temperature_is_flagged_as_an_old_one() -> None:
    # Tared at 480 counts; a change of four is allowed, and of five not.
    plan = newton_plan(array_at(SQUARE, references=[3]))
    counts = np.full((12, 4), 480)
    counts[3:5, 1], counts[5:7, 2] = [476, 475], [484, 485]
    counts[7, 3] = 300  # of a tile that bears no load it does not matter
    flags = estimate_load([9] * 4, plan, temperature_raw=counts).estimate_flags
    assert find(EstimateFlag.TARE_OLD, flags) == [4, 6]
    tiles = [newton_tile(serial, effects=make_effects()) for serial in plan.info.serials]
    corrected = newton_plan(plan.info, models=("unwrap", "temperature", "static"), tiles=tiles)
    tare = replace(plan.tare, temperature_raw_counts=np.full(4, np.nan))
    unknown = make_plan(plan.info, plan.calibration, tare, models=plan.models)
    for other in (corrected, unknown):
        flags = estimate_load([9] * 4, other, temperature_raw=counts).estimate_flags
        assert find(EstimateFlag.TARE_OLD, flags) == []


@pytest.mark.parametrize("lag_ms", [0.0, 10.0])
def test_a_lost_tare_leaves_the_angle_and_missing_tiles(lag_ms: float) -> None:
    info = array_at(SQUARE, servo=make_servo())
    models = [name for name in MODEL_NAMES if name != "ambient"]
    tiles = [newton_tile(serial, effects=make_effects()) for serial in info.serials]
    # Gas of which the squeeze is not known hides the COP for a while, creep that of a light load.
    known = [name for name in models if name != "gas"]
    plan = newton_plan(info, models=known, tiles=tiles, lag_ms=lag_ms)
    tare = Tare.make_lost(tiles=4, t_ns=0)
    lost = make_plan(info, plan.calibration, tare, models=models, lag_ms=lag_ms)
    tile_flags = np.zeros((12, 4))
    tile_flags[11, 1] = TileFlag.NO_ANSWER
    whole, e = (estimate_load([60] * 4, each, tile_flags=tile_flags) for each in (plan, lost))
    for name in ("gauge_kpa", "force_n", "force_sigma_n", *GRF, *COP):
        assert np.isnan(getattr(e, name)).all(), name
        assert np.isfinite(getattr(whole, name)).any(), name
    assert (e.contact == 255).all()
    expected = EstimateFlag.TARE_LOST | EstimateFlag.COP_MASKED
    assert e.estimate_flags.tolist() == [expected] * 11 + [expected | EstimateFlag.TILE_MISSING]
    assert e.angle_rad.tobytes() == whole.angle_rad.tobytes()
