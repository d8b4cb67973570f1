"""The full ladder: the same bits in any split, no warning, no infinity, and symmetries.

Tiles read one newton a count (see tests/builders); the last tile of an array is bare.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.flags import EstimateFlag, TileFlag
from devices.frames import NOT_READ, FrameBatch
from service.estimation.effects import Parameter
from service.estimation.pipeline.params import MODEL_NAMES
from service.estimation.pipeline.plan import EstimationPlan
from service.estimation.records import Estimates
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP, array_at, make_servo
from tests.builders.calibrations import make_effects, newton_tile
from tests.builders.estimates import estimate, newton_plan, with_params
from tests.builders.frames import LAYOUTS, assert_same_bits, cut_up, loaded_frames, with_columns
from tests.service.estimation.feet import SQUARE, draw_wild_frames

CHIPS = [DATA_SHEET_CHIP, FORUM_CHIP] * 3
BARE = (0.05, 0.05, -0.1)
EXTREME_CHIPS = [
    (0x7FFF, 0x8000, 0x8000, 0x7FFC),
    (0x0001, 0xFFFF, 0xFFFF, 0x0004),
    (0x8000, 0x7FFF, 0x7FFF, 0x8000),
    (0x7FFF, 0x8000, 0x7FFF, 0x8000),
    (0, 0, 0, 0),
]


def make_full_plan(
    positions_m: Sequence[tuple[float, float, float]] = SQUARE,
    *,
    models: Sequence[str] = MODEL_NAMES,
    lag_ms: float = 10.0,
    sigma_n: float = 1.0,
    **array: Any,
) -> EstimationPlan:
    """Make a plan of all models over these tiles, each with its own effects, and a bare one."""
    places = [*positions_m, BARE]
    info = array_at(places, references=[len(positions_m)], **array)
    known = make_effects()
    assert known.gas is not None
    assert known.rubber is not None
    tiles = []
    for i, serial in enumerate(info.serials[:-1]):
        curve = (0.0, 1.0 + 0.1 * i, 1e-3, 1e-5)
        tau_s = known.gas.tau_s.model_copy(update={"value": 0.005 + 0.006 * i})
        own: dict[str, Any] = {
            "gas": known.gas.model_copy(update={"tau_s": tau_s}),
            "rubber": known.rubber.model_copy(update={"coefficients": curve}),
            "late_s": Parameter(value=0.0, sigma=1e-4),
            "late_common_s": 2e-4,
        }
        effects = known.model_copy(update=own)
        tiles.append(newton_tile(serial, coefficients=curve, relative_misfit=0.01, effects=effects))
    return newton_plan(info, models=models, lag_ms=lag_ms, tiles=tiles, sigma_n=sigma_n)


def draw_walk(rows: int, tiles: int, seed: int) -> np.ndarray:
    """Draw forces (rows, tiles + 1) of steps with noise and spikes."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) + rng.uniform(0, 60)
    load = np.maximum(0.0, np.sin(t / rng.uniform(8, 40)))[:, None] * rng.uniform(5, 60, tiles)
    forces_n = np.concatenate([load, np.zeros((rows, 1))], axis=1)
    forces_n = forces_n + rng.normal(0, 1.0, forces_n.shape)
    spiked = rng.random(forces_n.shape) < 0.02
    return forces_n + np.where(spiked, -12.0, 0.0)


def add_trouble(frames: FrameBatch, seed: int) -> FrameBatch:
    """Add gaps, silent, stale and saturated tiles, warmth, and frames and tiles at one instant."""
    rng = np.random.default_rng(seed + 1)
    shape = frames.pressure_raw.shape
    steps_ns = rng.choice(
        [2_000_000] * 60 + [0, 1, 2_000_007, 900_000, 8_000_000, 60 * 10**9], shape[0]
    )
    silent = rng.random(shape) < 0.02
    saturated = rng.random(shape) < 0.02
    flags = np.where(rng.random(shape) < 0.02, 2 ** rng.integers(0, 6, shape), 0)
    warm = 480 - np.minimum(np.arange(shape[0]) // 20, 30)[:, None] + rng.integers(0, 2, shape)
    unread = silent | (rng.random(shape) < 0.2)
    return with_columns(
        frames,
        seq=np.cumsum(rng.choice([1] * 60 + [2, 900], shape[0])),
        t_mono_ns=np.cumsum(steps_ns),
        pressure_raw=np.where(silent, NOT_READ, np.where(saturated, 1010, frames.pressure_raw)),
        temperature_raw=np.where(unread, NOT_READ, warm),
        tile_flags=np.where(silent, TileFlag.NO_ANSWER, flags),
        sample_offset_us=rng.choice([0, 0, 400, 700, 1100], shape),
        servo_counts=np.cumsum(rng.integers(-3, 9, shape[0])),
        servo_age_us=rng.integers(0, 2000, shape[0]),
    )


# --- any split ------------------------------------------------------------------------------------


@pytest.mark.parametrize("lag_ms", [0, 1, 5, 10, 100])
@settings(max_examples=50, deadline=None)
@given(
    rows=st.integers(1, 90),
    tiles=st.integers(1, 4),
    seed=st.integers(0, 2**32 - 1),
    left_out=st.one_of(
        st.just(set(MODEL_NAMES) - {"static"}),
        st.just(set(MODEL_NAMES) - {"unwrap", "static"}),
        st.sets(st.sampled_from([name for name in MODEL_NAMES if name != "static"])),
    ),
    wild=st.booleans(),
    cuts=st.one_of(st.just(range(90)), st.lists(st.integers(0, 90))),
    how=st.sampled_from(list(LAYOUTS)),
)
def test_any_split_in_any_memory_order_gives_the_same_bits(
    lag_ms: float,
    rows: int,
    tiles: int,
    seed: int,
    left_out: set[str],
    wild: bool,
    cuts: Collection[int],
    how: str,
) -> None:
    models = [name for name in MODEL_NAMES if seed % 2 or name not in left_out]
    chips = CHIPS[: tiles + 1] if seed % 3 else None
    plan = make_full_plan(
        SQUARE[:tiles], lag_ms=lag_ms, models=models, servo=make_servo(), chips=chips
    )
    if wild:
        frames = draw_wild_frames(rows, tiles + 1, seed)
    else:
        frames = add_trouble(loaded_frames(draw_walk(rows, tiles, seed)), seed)
    whole, split = estimate(plan, frames), estimate(plan, *cut_up(frames, cuts, how))
    assert_same_bits(whole, split)
    assert split.seq.tolist() == frames.seq.tolist()
    assert split.t_ns.tolist() == frames.t_ns.tolist()


@pytest.mark.parametrize("lag_ms", [0, 1, 10, 100])
@pytest.mark.parametrize("size", [1, 7, 300])
def test_windows_reach_as_far_back_in_short_batches(lag_ms: float, size: int) -> None:
    # Long quiet stretches, so that windows grow to all of the 250 ms and 128 samples.
    plan = make_full_plan(lag_ms=lag_ms)
    rng = np.random.default_rng(1)
    forces_n = np.repeat([0.0, 20.0, 35.0], 200)[:, None] + rng.normal(0, 1, (600, 5))
    t_mono_ns = np.cumsum(np.repeat([2_000_000, 1_000_000, 2_900_000], 200))
    frames = loaded_frames(forces_n, t_mono_ns=t_mono_ns)
    whole = estimate(plan, frames)
    assert np.std(whole.force_n[150:190, 0]) < 0.8, "it averages"
    assert_same_bits(whole, estimate(plan, *cut_up(frames, range(0, 600, size))))


# --- any frames -----------------------------------------------------------------------------------


@pytest.mark.parametrize("lag_ms", [0, 10])
@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1))
def test_any_frames_give_finite_estimates_without_a_warning(lag_ms: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (40, 5)
    chips = [
        CHIPS[:5],
        [EXTREME_CHIPS[k] for k in rng.integers(0, 5, 5)],
        [tuple(words) for words in rng.integers(0, 65_536, (5, 4)).tolist()],
        None,
    ][seed % 4]
    plan = make_full_plan(lag_ms=lag_ms, servo=make_servo(), chips=chips)
    pressure_raw = rng.choice(
        [rng.integers(0, 1024, shape), 0 * np.ones(shape), 1023 * np.ones(shape)]
    )
    pressure_raw = np.where(
        rng.random(shape) < 0.5,
        pressure_raw,
        rng.choice([0, 1, 480, 500, 1010, 1023, 40_000], shape),
    )
    steps_ns = rng.choice([2_000_000] * 9 + [0, 1, 5_000_000, 60 * 10**9, 3600 * 10**9], 40)
    frames = loaded_frames(
        np.zeros(shape),
        pressure_raw=np.where(rng.random(shape) < 0.05, NOT_READ, pressure_raw),
        temperature_raw=rng.choice([0, 480, 511, 512, 640, 1023, 40_000, NOT_READ], shape),
        tile_flags=np.where(rng.random(shape) < 0.1, rng.integers(0, 256, shape), 0),
        t_mono_ns=np.cumsum(steps_ns),
        sample_offset_us=np.where(
            rng.random(shape) < 0.2, rng.integers(-(2**31), 2**31, shape), 500
        ),
        frame_flags=np.where(rng.random(40) < 0.3, rng.integers(0, 256, 40), 0),
        servo_counts=rng.integers(-(2**31), 2**31, 40),
        servo_age_us=rng.integers(-1, 2**31, 40),
        reference_force_n=rng.choice([np.nan, np.inf, -np.inf], 40),
    )
    e = estimate(plan, frames)
    assert len(e) == 40
    for f in fields(Estimates):
        assert not np.isinf(getattr(e, f.name).astype(np.float64)).any(), f.name
    lost = np.isnan(e.grf_n)
    why = EstimateFlag.TILE_MISSING | EstimateFlag.SATURATED
    assert np.array_equal(lost, (e.estimate_flags & why) != 0)
    assert set(e.contact[lost].tolist()) <= {1, 255}
    assert (e.grf_lower_bound_n[lost & (e.contact == 1)] > 0.0).all()


def test_forces_before_the_first_ambient_pressure_are_missing() -> None:
    forces_n = np.full((30, 5), 20.0)
    forces_n[:, 4] = np.nan
    forces_n[20, 4] = 0.0
    e = estimate(make_full_plan(), loaded_frames(forces_n))
    assert np.isnan(e.grf_n).tolist() == [True] * 20 + [False] * 10
    missing = (e.estimate_flags & EstimateFlag.TILE_MISSING) != 0
    assert missing.tolist() == [True] * 20 + [False] * 10


# --- symmetries -----------------------------------------------------------------------------------


@settings(max_examples=10)
@given(order=st.permutations(range(4)), seed=st.integers(0, 1000))
def test_the_order_of_the_tiles_does_not_matter(order: list[int], seed: int) -> None:
    plan = make_full_plan()
    columns = [*order, 4]
    frames = add_trouble(loaded_frames(draw_walk(80, 4, seed)), seed)
    other = replace(
        frames,
        **{
            name: getattr(frames, name)[:, columns]
            for name in ("pressure_raw", "temperature_raw", "tile_flags", "sample_offset_us")
        },
    )
    tiles = tuple(plan.info.tiles[i] for i in columns)
    other_info = plan.info.model_copy(update={"tiles": tiles})
    other_plan = newton_plan(
        other_info, models=MODEL_NAMES, lag_ms=10, tiles=plan.calibration.tiles, sigma_n=1.0
    )
    one, two = estimate(plan, frames), estimate(other_plan, other)
    for name in ("gauge_kpa", "force_n"):
        assert getattr(one, name)[:, columns].tobytes() == getattr(two, name).tobytes()
    # It has a sum over the other tiles, which rounds by their order.
    expected = one.force_sigma_n[:, columns]
    np.testing.assert_allclose(two.force_sigma_n, expected, rtol=1e-12, equal_nan=True)
    assert two.grf_n == pytest.approx(one.grf_n, abs=1e-9, nan_ok=True)
    assert two.cop_x_m == pytest.approx(one.cop_x_m, abs=1e-9, nan_ok=True)
    assert two.cop_y_m == pytest.approx(one.cop_y_m, abs=1e-9, nan_ok=True)


@settings(max_examples=10)
@given(
    scale=st.floats(0.3, 1.0),
    x_m=st.floats(-0.5, 0.5),
    y_m=st.floats(-0.5, 0.5),
    seed=st.integers(0, 1000),
)
def test_the_centre_moves_and_grows_with_the_tiles(
    scale: float, x_m: float, y_m: float, seed: int
) -> None:
    moved = [(scale * x + x_m, scale * y + y_m, z) for x, y, z in SQUARE]
    frames = loaded_frames(draw_walk(80, 4, seed))
    one = estimate(with_params(make_full_plan(), foot={"cop_sigma_max_m": 1.0}), frames)
    two = estimate(with_params(make_full_plan(moved), foot={"cop_sigma_max_m": 1.0}), frames)
    assert two.grf_n.tobytes() == one.grf_n.tobytes()
    assert two.cop_x_m == pytest.approx(scale * one.cop_x_m + x_m, abs=1e-9, nan_ok=True)
    assert two.cop_y_m == pytest.approx(scale * one.cop_y_m + y_m, abs=1e-9, nan_ok=True)
    assert two.cop_sigma_x_m == pytest.approx(scale * one.cop_sigma_x_m, abs=1e-9, nan_ok=True)
