"""`static`: force from gauge pressure by each tile's cubic, with its uncertainty (paper eq. 2).

Above the calibrated range the force stays at the range's end, a lower bound. Below zero pressure
the curve continues along its tangent, so that noise about zero stays unbiased and a cubic's tail
never shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation.calibration import (
    CUBIC_TERMS,
    CURVE_MISFIT_HALF_FORCE_N,
    LOOP_HALF_WIDTH_FORCE_N,
    TileCalibration,
)
from service.estimation.models import LoadBearingTiles, ModelParams
from service.estimation.records import RecordArray


@dataclass(frozen=True)
class StaticForce:
    """Force on tiles; all arrays (n, tiles)."""

    force_n: Floats
    slope_n_per_kpa: Floats
    fit_sigma_n: Floats
    """Standard uncertainty of the calibration: of its coefficients, and of a new loading."""


class StaticParams(ModelParams):
    """Parameters of a tile's curve, as in `TileCalibration`, in newtons."""

    range_low_kpa: float
    range_high_kpa: float
    offset_kpa: float
    scale_kpa: float
    u_zero: float  # the polynomial's variable at zero pressure
    coefficients: Annotated[Floats, (CUBIC_TERMS,)]
    covariance: Annotated[Floats, (CUBIC_TERMS, CUBIC_TERMS)]
    zero_n: float  # force at zero pressure
    slope_at_zero_n_per_kpa: float
    relative_misfit: float
    loading_scatter: float  # of a new loading's gauge pressure, relative
    loop_misfit_n: float
    curve_misfit_n: float

    @classmethod
    def make(cls, tiles: LoadBearingTiles) -> RecordArray[Self]:
        """Make the curves of load-bearing tiles, of settled forces if `rubber` is used."""
        return cls.from_calibrations(tiles.calibrations, use_settled_curve="rubber" in tiles.models)

    @classmethod
    def from_calibrations(
        cls, tiles: Sequence[TileCalibration], *, use_settled_curve: bool = False
    ) -> RecordArray[Self]:
        """Make the curves of tiles, (tiles,).

        Args:
            tiles: calibrations of the tiles.
            use_settled_curve: use the curves of settled forces, which lie beneath creep and loop,
                for the model `rubber`; a tile without it keeps the curve of its slow strokes.
        """
        scatter = curve_misfit_n = np.zeros(len(tiles))
        if use_settled_curve:
            rubbers = [tile.effects.rubber for tile in tiles]
            scatter = np.array([0.0 if r is None else r.scatter for r in rubbers])
            curve_misfit_n = np.array([0.0 if r is None else r.curve_misfit_n for r in rubbers])
            tiles = [_use_settled_curve(tile) for tile in tiles]
        offset_kpa = np.array([t.p_offset_kpa for t in tiles])
        scale_kpa = np.array([t.p_scale_kpa for t in tiles])
        c1, c2, c3 = (np.array([t.coefficients[k] * t.f_scale_n for t in tiles]) for k in (1, 2, 3))
        u0 = -offset_kpa / scale_kpa
        return cls.array(
            len(tiles),
            range_low_kpa=[t.range_kpa[0] for t in tiles],
            range_high_kpa=[t.range_kpa[1] for t in tiles],
            offset_kpa=offset_kpa,
            scale_kpa=scale_kpa,
            u_zero=u0,
            coefficients=np.stack([c1, c2, c3], axis=1),
            zero_n=[
                t.f_offset_n + t.f_scale_n * _horner(t, u) if t.zero_mode == "as_fitted" else 0.0
                for t, u in zip(tiles, u0, strict=True)
            ],
            slope_at_zero_n_per_kpa=(c1 + u0 * (2.0 * c2 + u0 * (3.0 * c3))) / scale_kpa,
            covariance=[np.array(t.covariance) * t.f_scale_n**2 for t in tiles],
            relative_misfit=[t.relative_misfit for t in tiles],
            loading_scatter=scatter,
            loop_misfit_n=[t.loop_misfit_n for t in tiles],
            curve_misfit_n=curve_misfit_n,
        )


def compute_forces(curves: RecordArray[StaticParams], gauge_kpa: Floats) -> StaticForce:
    """Compute force, slope and calibration uncertainty at gauge pressures (n, tiles)."""
    force, slope, sigma = (np.empty(gauge_kpa.shape) for _ in range(3))
    _evaluate_curves(curves, gauge_kpa, force, slope, sigma)
    return StaticForce(force, slope, sigma)


@jit_cached
def compute_capped_force_slope_and_fit_sigma(
    params: StaticParams, gauge_kpa: float
) -> tuple[float, float, float]:
    """Compute force (N), slope (N/kPa) and calibration uncertainty (N) at a gauge pressure."""
    inside = gauge_kpa if math.isnan(gauge_kpa) else min(max(gauge_kpa, 0.0), params.range_high_kpa)
    u, u0 = (inside - params.offset_kpa) / params.scale_kpa, params.u_zero
    c1, c2, c3 = params.coefficients[0], params.coefficients[1], params.coefficients[2]
    # The polynomial about u0 rather than about 0: exactly zero at zero pressure.
    d = u - u0
    value = d * (c1 + c2 * (u + u0) + c3 * (u * u + u * u0 + u0 * u0))
    if gauge_kpa < 0.0:
        value += gauge_kpa * params.slope_at_zero_n_per_kpa
    rise = (c1 + u * (2.0 * c2 + u * (3.0 * c3))) / params.scale_kpa
    basis = (d, u * u - u0 * u0, u * u * u - u0 * u0 * u0)
    variance = 0.0
    for k in range(CUBIC_TERMS):
        for m in range(CUBIC_TERMS):
            variance += params.covariance[k, m] * basis[k] * basis[m]
    size = abs(value)
    variance = max(variance, 0.0)  # rounding may leave a trace below zero
    scatter_n = params.loading_scatter * rise * inside
    variance += (params.relative_misfit * value) ** 2 + scatter_n**2
    variance += (
        params.loop_misfit_n * (1.0 - LOOP_HALF_WIDTH_FORCE_N / (size + LOOP_HALF_WIDTH_FORCE_N))
    ) ** 2
    variance += (
        params.curve_misfit_n
        * (1.0 - CURVE_MISFIT_HALF_FORCE_N / (size + CURVE_MISFIT_HALF_FORCE_N))
    ) ** 2
    return value + params.zero_n, rise, math.sqrt(variance)


@jit_cached
def _evaluate_curves(
    params: RecordArray[StaticParams],
    gauge_kpa: Floats,
    force: Floats,
    slope: Floats,
    sigma: Floats,
) -> None:
    n, tiles = gauge_kpa.shape
    for i in range(n):
        for j in range(tiles):
            force[i, j], slope[i, j], sigma[i, j] = compute_capped_force_slope_and_fit_sigma(
                params[j], gauge_kpa[i, j]
            )


def _use_settled_curve(tile: TileCalibration) -> TileCalibration:
    rubber, loop = tile.effects.rubber, tile.effects.hysteresis
    if rubber is None:
        return tile
    return tile.model_copy(
        update={
            "coefficients": rubber.coefficients,
            "covariance": rubber.covariance,
            "relative_misfit": 0.0,
            "loop_misfit_n": tile.loop_misfit_n if loop is None else 0.0,
        }
    )


def _horner(tile: TileCalibration, u: float) -> float:
    c0, c1, c2, c3 = tile.coefficients
    return c0 + u * (c1 + u * (c2 + u * c3))
