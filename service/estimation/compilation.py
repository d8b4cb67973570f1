"""Compilation of the models before the first frames are estimated.

On a new machine it takes some ten seconds, in which a compiling server would not answer. So another
process compiles, and until then frames have no estimates (`is_compiling`). Later it takes half a
second, because the machine code is cached.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from devices.frames import (
    NO_SERVO_AGE,
    NO_SERVO_COUNTS,
    ArrayInfo,
    FrameBatch,
    TileInfo,
    allocate_columns,
)
from devices.jit import NotCompiledError, forbid_compilation
from service.estimation.calibration import Calibration, make_paper_shape_preset
from service.estimation.effects import (
    Effects,
    FlowEffect,
    GasEffect,
    HysteresisEffect,
    Parameter,
    RubberEffect,
    TemperatureEffect,
)
from service.estimation.estimate import ModelEstimator
from service.estimation.models.hysteresis import WIDTHS_N
from service.estimation.pipeline.params import MODEL_NAMES
from service.estimation.pipeline.plan import make_plan
from service.estimation.tare.tare import Tare

_REGISTERS = (0x3ECE, 0xB3F9, 0xC517, 0x33C8)
_FRAMES = 8


COMPILING_NOTE = "The models are being compiled, once on this machine: until then pressures only."
_under_way: set[object] = set()


def is_compiling() -> bool:
    """Return whether the models are being compiled, so that an estimate would wait."""
    return bool(_under_way)


@contextmanager
def mark_compiling() -> Iterator[None]:
    """Mark the models as being compiled while the block runs."""
    each = object()
    _under_way.add(each)
    try:
        yield
    finally:
        _under_way.discard(each)


def load_cached_code() -> bool:
    """Load machine code of another process; return whether it is complete."""
    try:
        with forbid_compilation():
            compile_models()
    except NotCompiledError:
        return False
    return True


def compile_models() -> None:
    """Compile the models: estimate a few synthetic frames, with all models and with one."""
    info = ArrayInfo(
        node="warm-up",
        stream_id="0" * 32,
        tiles=tuple(_tile(channel) for channel in range(3)),
        servo=None,
        schedule="simultaneous",
        nominal_rate_hz=500.0,
        utc_offset_ns=0,
        clock_set=False,
        software="warm-up",
        scene="warm-up",
        models=MODEL_NAMES,
    )
    kpa, nothing = np.full(3, 97.0), np.zeros(3)
    tare = Tare(kpa, nothing + 0.01, nothing + 0.1, nothing + 507.0, 0, 0.0, 1.0, 100, "lead")
    # Fault detection tracks thermal drift only without the model `temperature`.
    for models in (MODEL_NAMES, ("static",)):
        plan = make_plan(info, _calibration(), tare, models=models, lag_ms=4.0)
        estimator = ModelEstimator(plan)
        estimator.process_frames(_frames())
        estimator.finish()


def _tile(channel: int) -> TileInfo:
    return TileInfo(
        serial=f"W{channel}",
        mux=0x70,
        channel=channel,
        chip="mpl115a2",
        address=0x60,
        registers=_REGISTERS,
        x_m=0.0,
        y_m=0.0,
        z_m=-0.15,
        reference=channel == 2,
        conversion_ms=1.6,
    )


def _calibration() -> Calibration:
    tenth = Parameter(value=0.1, sigma=0.01)
    curve = make_paper_shape_preset().tiles[0]
    effects = Effects(
        gas=GasEffect(gamma=Parameter(value=1.3, sigma=0.01), tau_s=tenth, misfit=0.1),
        rubber=RubberEffect(
            part=(tenth, tenth),
            tau_s=(tenth, tenth),
            coefficients=curve.coefficients,
            covariance=curve.covariance,
            scatter=0.03,
            misfit=0.1,
            curve_misfit_n=0.1,
        ),
        hysteresis=HysteresisEffect(
            part=(tenth,) * len(WIDTHS_N),
            flow=FlowEffect(part=tenth, stress_n=tenth, power=Parameter(value=4.0, sigma=1.0)),
        ),
        temperature=TemperatureEffect(kpa_per_k=tenth, lag_s=tenth, wall_per_kpa=tenth),
    )
    tiles = tuple(
        curve.model_copy(update={"serial": serial, "effects": effects}) for serial in ("W0", "W1")
    )
    return Calibration(name="warm-up", reference="none", date="2020-01-01", tiles=tiles)


def _frames() -> FrameBatch:
    columns = allocate_columns(_FRAMES, 3, np.dtype(np.uint16))
    columns["seq"][:] = np.arange(_FRAMES)
    columns["t_mono_ns"][:] = columns["t_ns"][:] = 2_000_000 * np.arange(_FRAMES)
    columns["pressure_raw"][:], columns["temperature_raw"][:] = 400, 507
    columns["servo_counts"][:], columns["servo_age_us"][:] = NO_SERVO_COUNTS, NO_SERVO_AGE
    columns["reference_force_n"][:] = np.nan
    return FrameBatch(**columns)
