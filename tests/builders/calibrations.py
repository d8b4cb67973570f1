"""Calibrations and tares by hand: tiles of one newton a count, so that forces can be worked out.

Unloaded, every tile reads 500 counts, which is 100.0049 kPa; the chip's 115 kPa are 118 N away, the
calibrated range ends at 150 N. See `tests.builders.arrays` for the chip.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.effects import (
    Effects,
    GasEffect,
    HysteresisEffect,
    Parameter,
    RubberEffect,
    TemperatureEffect,
)
from service.estimation.tare.tare import Tare
from tests.builders.arrays import COUNT_KPA, UNLOADED_KPA, UTC_NS


def newton_tile(serial: str = "T01", **changes: Any) -> TileCalibration:
    """One newton a count, known exactly."""
    entry: dict[str, Any] = {
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


def make_effects(**changes: Any) -> Effects:
    """Everything that a bench can find out about a dome, each parameter known to about 1 %."""

    def parameters(*values: float) -> tuple[Parameter, ...]:
        return tuple(Parameter(value=value, sigma=0.01 * value) for value in values)

    known: dict[str, Any] = {
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


def make_calibration(*tiles: str | TileCalibration, name: str = "by hand") -> Calibration:
    """A calibration of these entries; a serial stands for one newton a count."""
    entries = tuple(newton_tile(t) if isinstance(t, str) else t for t in tiles)
    return Calibration(name=name, reference="none", date="2020-01-01", tiles=entries)


def make_tare(tiles: int = 2, **changes: Any) -> Tare:
    """A second without load: every tile at 500 counts, with half a count of noise.

    `baseline_kpa`, `baseline_sigma_kpa`, `noise_kpa` and `temperature_raw_counts` may be one value
    for all.
    """
    content: dict[str, Any] = {
        "baseline_kpa": UNLOADED_KPA,
        "baseline_sigma_kpa": 0.0,
        "noise_kpa": 0.5 * COUNT_KPA,
        "temperature_raw_counts": 480.0,
        "t_ns": UTC_NS,
        "begin_s": 0.0,
        "end_s": 1.0,
        "frames": 500,
        "source": "interval",
    }
    content |= changes
    for per_tile in ("baseline_kpa", "baseline_sigma_kpa", "noise_kpa", "temperature_raw_counts"):
        content[per_tile] = np.array(np.broadcast_to(content[per_tile], tiles), dtype=np.float64)
    return Tare(**content)
