"""A foot whose tiles read one newton a count, so that every expectation can be worked out by hand.

Its chips have b1 = -2 and neither b2 nor c12, so a count is 130/1023 kPa (data sheet eq. 1 and 2),
and its calibration says that 130/1023 kPa are one newton. Unloaded, every tile reads 500 counts,
which is 100.0049 kPa; the chip's 115 kPa are 118 N away, the calibrated range ends at 150 N.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from devices.frames import (
    NO_SERVO_AGE,
    NO_SERVO_COUNTS,
    NOT_READ,
    ArrayInfo,
    FrameBatch,
    ServoInfo,
    TileInfo,
    TileStatus,
)
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.effects import (
    Effects,
    GasEffect,
    HysteresisEffect,
    Parameter,
    RubberEffect,
    TemperatureEffect,
)
from service.estimation.estimate import EstimationState, finish, step
from service.estimation.estimates import Estimates
from service.estimation.plan import EstimationPlan, make_plan
from service.estimation.tare.tare import Tare

COUNT_KPA = 130 / 1023
UNLOADED_COUNTS = 500
UNLOADED_KPA = 787 * 65 / 1023 + 50
NEWTON_CHIP = (1787 * 8, 0xC000, 0, 0)
PERIOD_NS = 2_000_000
UTC_NS = 1_577_836_800_000_000_000


def _info(
    positions_m: Sequence[tuple[float, float, float]],
    *,
    references: Sequence[int] = (),
    servo: ServoInfo | None = None,
    chips: Sequence[tuple[int, int, int, int]] | None = None,
) -> ArrayInfo:
    return ArrayInfo(
        node="bench",
        boot_id="0" * 32,
        tiles=tuple(
            TileInfo(
                serial=f"T{i + 1:02}",
                mux=0x70 + i // 8,
                channel=i % 8,
                coefficient_words=chips[i] if chips else NEWTON_CHIP,
                x_m=x_m,
                y_m=y_m,
                z_m=z_m,
                reference=i in references,
                conversion_ms=1.6,
            )
            for i, (x_m, y_m, z_m) in enumerate(positions_m)
        ),
        servo=servo,
        schedule="simultaneous",
        nominal_rate_hz=1e9 / PERIOD_NS,
        utc_offset_ns=UTC_NS,
        clock_set=True,
        software="test",
        scene="test",
        models=("unwrap", "static"),
    )


def _tile(serial: str, **changes: object) -> TileCalibration:
    entry: dict[str, object] = {
        "serial": serial,
        "p_input": "gauge_kpa",
        "p_offset_kpa": 0.0,
        "p_scale_kpa": COUNT_KPA,
        "f_offset_n": 0.0,
        "f_scale_n": 1.0,
        "zero_mode": "subtract_f0",
        "coefficients": (0.0, 1.0, 0.0, 0.0),
        "range_kpa": (0.0, 150 * COUNT_KPA),
        "monotonic": True,
        "absolute_scale": "measured",
        "covariance": ((0.0,) * 3,) * 3,
        "relative_misfit": 0.0,
        "loop_misfit_n": 0.0,
        "r2": None,
        "rmse_n": None,
        "cv_rmse_n": None,
        "hysteresis_n": None,
        "repeats": 4,
        "baseline_kpa": UNLOADED_KPA,
        "noise_kpa": COUNT_KPA,
    }
    return TileCalibration.model_validate(entry | changes)


def _effects(**changes: object) -> Effects:
    def parameters(*values: float) -> tuple[Parameter, ...]:
        return tuple(Parameter(value=value, sigma=0.01 * value) for value in values)

    known: dict[str, object] = {
        "gas": GasEffect(
            gamma=Parameter(value=1.28, sigma=0.01),
            tau_s=Parameter(value=0.011, sigma=0.0004),
            misfit=0.12,
        ),
        "rubber": RubberEffect(
            part=parameters(0.05, 0.04),
            tau_s=parameters(0.06, 1.1),
            coefficients=(0.0, 1.0, 0.0, 0.0),
            covariance=((0.0,) * 3,) * 3,
            scatter=0.004,
            misfit=0.1,
            curve_misfit_n=0.05,
        ),
        "hysteresis": HysteresisEffect(part=parameters(0.05, 0.04, 0.03)),
        "temperature": TemperatureEffect(
            kpa_per_k=Parameter(value=0.3, sigma=0.003),
            lag_s=Parameter(value=3.3, sigma=0.2),
            wall_per_kpa=Parameter(value=0.0013, sigma=0.0002),
        ),
    }
    return Effects.model_validate(known | changes)


def _calibration(*tiles: TileCalibration) -> Calibration:
    return Calibration(name="by hand", reference="none", date="2020-01-01", tiles=tiles)


def _plan(
    info: ArrayInfo,
    *,
    sigma_n: float = 0.5,
    lag_ms: float = 0.0,
    models: Sequence[str] = ("unwrap", "static"),
    tiles: Sequence[TileCalibration] | None = None,
) -> EstimationPlan:
    n = len(info.tiles)
    tare = Tare(
        baseline_kpa=np.full(n, UNLOADED_KPA),
        baseline_sigma_kpa=np.zeros(n),
        noise_kpa=np.full(n, sigma_n * COUNT_KPA),
        tadc_counts=np.full(n, 480.0),
        t_ns=UTC_NS,
        begin_s=0.0,
        end_s=1.0,
        frames=500,
        source="interval",
    )
    entries = tiles if tiles is not None else [_tile(serial) for serial in info.serials]
    return make_plan(info, _calibration(*entries), tare, models=models, lag_ms=lag_ms)


def _frames(forces_n: Any, **columns: Any) -> FrameBatch:
    forces_n = np.asarray(forces_n, dtype=np.float64)
    n, tiles = forces_n.shape
    silent = np.isnan(forces_n)
    counts = UNLOADED_COUNTS - np.rint(np.where(silent, 0.0, forces_n))
    padc = np.where(silent, NOT_READ, np.mod(counts, 1024)).astype(np.uint16)
    t_mono_ns = PERIOD_NS * np.arange(n, dtype=np.int64) + 10_000_000_000
    batch = FrameBatch(
        seq=np.arange(n, dtype=np.uint64),
        t_mono_ns=t_mono_ns,
        t_ns=t_mono_ns + UTC_NS,
        padc=padc,
        tadc=np.where(silent, NOT_READ, 480).astype(np.uint16),
        sample_offset_us=np.zeros((n, tiles), dtype=np.int32),
        servo_counts=np.full(n, NO_SERVO_COUNTS, dtype=np.int32),
        servo_age_us=np.full(n, NO_SERVO_AGE, dtype=np.int32),
        status=np.where(silent, TileStatus.NO_ANSWER, 0).astype(np.uint8),
        frame_status=np.zeros(n, dtype=np.uint8),
        reference_force_n=np.full(n, np.nan, dtype=np.float32),
    )
    given = {
        name: np.asarray(values).astype(getattr(batch, name).dtype)
        for name, values in columns.items()
    }
    if "t_mono_ns" in given:
        given.setdefault("t_ns", given["t_mono_ns"] + UTC_NS)
    return replace(batch, **given)


def _joined(pieces: Sequence[Estimates]) -> Estimates:
    return Estimates(
        **{f.name: np.concatenate([getattr(p, f.name) for p in pieces]) for f in fields(Estimates)}
    )


def _estimate(plan: EstimationPlan, *batches: FrameBatch) -> Estimates:
    state = EstimationState()
    pieces = []
    for batch in batches:
        estimates, state = step(plan, batch, state)
        pieces.append(estimates)
    last = finish(plan, state)
    return _joined(pieces if last is None else [*pieces, last])


@pytest.fixture(scope="session")
def info_of() -> Callable[..., ArrayInfo]:
    """An array with tiles at these positions."""
    return _info


@pytest.fixture(scope="session")
def tile_of() -> Callable[..., TileCalibration]:
    """A calibration entry of one newton a count, with changes."""
    return _tile


@pytest.fixture(scope="session")
def effects_of() -> Callable[..., Effects]:
    """Everything that a bench can find out about a dome, with changes."""
    return _effects


@pytest.fixture(scope="session")
def calibration_of() -> Callable[..., Calibration]:
    """A calibration of these entries."""
    return _calibration


@pytest.fixture(scope="session")
def plan_of() -> Callable[..., EstimationPlan]:
    """A plan for an array, tared at 500 counts, with `sigma_n` of noise on every tile."""
    return _plan


@pytest.fixture(scope="session")
def frames_of() -> Callable[..., FrameBatch]:
    """Frames under these forces (n, tiles), 2 ms apart; NaN is a tile that does not answer."""
    return _frames


@pytest.fixture(scope="session")
def estimate() -> Callable[..., Estimates]:
    """All estimates of these batches, stepped through one after the other."""
    return _estimate
