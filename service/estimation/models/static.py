"""`static`: force from gauge pressure by each tile's cubic, with its uncertainty (paper eq. 2).

Above the calibrated range force stays at the range's end, a lower bound; below zero pressure the
curve goes on along its tangent, so that noise about zero stays unbiased and a cubic's tail never
shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.compiled import compiled
from service.estimation.calibration import BASIS, CURVE_OPENS_N, LOOP_OPENS_N, TileCalibration


@dataclass(frozen=True)
class StaticForce:
    """Force on tiles; all arrays (n, tiles)."""

    force_n: Floats
    slope_n_per_kpa: Floats
    fit_sigma_n: Floats
    """Standard uncertainty from the calibration: its coefficients, and a new loading's spread."""


class StaticCurves:
    """The curves of an array's tiles, as arrays over tiles.

    Args:
        tiles: their calibrations.
        lasting: take the curves of forces that have lasted, which lie beneath creep and loop, for
            the model `rubber`; a tile that does not have it keeps its own, which slow strokes gave.
    """

    def __init__(self, tiles: Sequence[TileCalibration], *, lasting: bool = False) -> None:
        scatter = curve_misfit_n = np.zeros(len(tiles))
        if lasting:
            rubbers = [tile.effects.rubber for tile in tiles]
            scatter = np.array([0.0 if r is None else r.scatter for r in rubbers])
            curve_misfit_n = np.array([0.0 if r is None else r.curve_misfit_n for r in rubbers])
            tiles = [_lasting(tile) for tile in tiles]
        offset_kpa = np.array([t.p_offset_kpa for t in tiles])
        scale_kpa = np.array([t.p_scale_kpa for t in tiles])
        c1, c2, c3 = (np.array([t.coefficients[k] * t.f_scale_n for t in tiles]) for k in (1, 2, 3))
        u0 = -offset_kpa / scale_kpa
        zero_n = [
            t.f_offset_n + t.f_scale_n * _horner(t, u) if t.zero_mode == "as_fitted" else 0.0
            for t, u in zip(tiles, u0, strict=True)
        ]
        self.low_kpa = np.array([t.range_kpa[0] for t in tiles])
        self.high_kpa = np.array([t.range_kpa[1] for t in tiles])
        self.slope_at_zero_n_per_kpa = (c1 + u0 * (2.0 * c2 + u0 * (3.0 * c3))) / scale_kpa
        self._constants = (
            self.high_kpa,
            offset_kpa,
            scale_kpa,
            u0,
            np.stack([c1, c2, c3]),
            np.array(zero_n),
            self.slope_at_zero_n_per_kpa,
            np.array([np.array(t.covariance) * t.f_scale_n**2 for t in tiles]),
            np.array([t.relative_misfit for t in tiles]),
            scatter,
            np.array([t.loop_misfit_n for t in tiles]),
            curve_misfit_n,
        )

    def force(self, gauge_kpa: Floats) -> StaticForce:
        """Force, slope and calibration uncertainty at gauge pressures of shape (n, tiles)."""
        return StaticForce(*_curve(np.ascontiguousarray(gauge_kpa), *self._constants))


@compiled
def _curve(
    gauge_kpa: Floats,
    high_kpa: Floats,
    offset_kpa: Floats,
    scale_kpa: Floats,
    u_zero: Floats,
    coefficients: Floats,
    zero_n: Floats,
    slope_at_zero: Floats,
    covariance: Floats,
    misfit: Floats,
    scatter: Floats,
    loop_n: Floats,
    curve_n: Floats,
) -> tuple[Floats, Floats, Floats]:
    n, tiles = gauge_kpa.shape
    force, slope, sigma = np.empty((n, tiles)), np.empty((n, tiles)), np.empty((n, tiles))
    basis = np.empty(BASIS)
    for i in range(n):
        for j in range(tiles):
            gauge = gauge_kpa[i, j]
            inside = gauge if math.isnan(gauge) else min(max(gauge, 0.0), high_kpa[j])
            u, u0 = (inside - offset_kpa[j]) / scale_kpa[j], u_zero[j]
            c1, c2, c3 = coefficients[0, j], coefficients[1, j], coefficients[2, j]
            # The polynomial about u0 rather than about 0: exactly zero at zero pressure.
            d = u - u0
            value = d * (c1 + c2 * (u + u0) + c3 * (u * u + u * u0 + u0 * u0))
            if gauge < 0.0:
                value += gauge * slope_at_zero[j]
            rise = (c1 + u * (2.0 * c2 + u * (3.0 * c3))) / scale_kpa[j]
            basis[0], basis[1], basis[2] = d, u * u - u0 * u0, u * u * u - u0 * u0 * u0
            variance = 0.0
            for k in range(BASIS):
                for m in range(BASIS):
                    variance += covariance[j, k, m] * basis[k] * basis[m]
            size = abs(value)
            variance = max(variance, 0.0)  # rounding may leave a trace below zero
            variance += (misfit[j] * value) ** 2 + (scatter[j] * rise * inside) ** 2
            variance += (loop_n[j] * (1.0 - LOOP_OPENS_N / (size + LOOP_OPENS_N))) ** 2
            variance += (curve_n[j] * (1.0 - CURVE_OPENS_N / (size + CURVE_OPENS_N))) ** 2
            force[i, j], slope[i, j] = value + zero_n[j], rise
            sigma[i, j] = math.sqrt(variance)
    return force, slope, sigma


def _lasting(tile: TileCalibration) -> TileCalibration:
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
