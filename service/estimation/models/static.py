"""`static`: force from gauge pressure by each tile's cubic, with its uncertainty (paper eq. 2).

Above the calibrated range force stays at the range's end, a lower bound; below zero pressure the
curve goes on along its tangent, so that noise about zero stays unbiased and a cubic's tail never
shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.errors import CalibrationError
from service.estimation.calibration import BASIS, TileCalibration, curve_share, loop_share
from service.estimation.effects import RubberEffect

Floats = npt.NDArray[np.float64]


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
            the model `rubber`; all tiles have it then.
    """

    def __init__(self, tiles: Sequence[TileCalibration], *, lasting: bool = False) -> None:
        self._scatter = self._curve_n = np.zeros(len(tiles))
        if lasting:
            self._scatter = np.array([_rubber(t).scatter for t in tiles])
            self._curve_n = np.array([_rubber(t).curve_misfit_n for t in tiles])
            tiles = [
                t.model_copy(
                    update={
                        "coefficients": _rubber(t).coefficients,
                        "covariance": _rubber(t).covariance,
                        "relative_misfit": 0.0,
                        "loop_misfit_n": 0.0,
                    }
                )
                for t in tiles
            ]
        self._offset_kpa = np.array([t.p_offset_kpa for t in tiles])
        self._scale_kpa = np.array([t.p_scale_kpa for t in tiles])
        self._c1, self._c2, self._c3 = (
            np.array([t.coefficients[k] * t.f_scale_n for t in tiles]) for k in (1, 2, 3)
        )
        self._misfit = np.array([t.relative_misfit for t in tiles])
        self._loop_n = np.array([t.loop_misfit_n for t in tiles])
        self._covariance = np.array([t.covariance for t in tiles]) * np.array(
            [[[t.f_scale_n**2]] for t in tiles]
        )
        self.low_kpa = np.array([t.range_kpa[0] for t in tiles])
        self.high_kpa = np.array([t.range_kpa[1] for t in tiles])
        self._u0 = -self._offset_kpa / self._scale_kpa
        self._zero_n = np.array(
            [
                t.f_offset_n + t.f_scale_n * _horner(t, u0) if t.zero_mode == "as_fitted" else 0.0
                for t, u0 in zip(tiles, self._u0, strict=True)
            ]
        )
        self.slope_at_zero_n_per_kpa = self._slope(self._u0)

    def force(self, gauge_kpa: Floats) -> StaticForce:
        """Force, slope and calibration uncertainty at gauge pressures of shape (n, tiles)."""
        inside_kpa = np.minimum(np.maximum(gauge_kpa, 0.0), self.high_kpa)
        u = (inside_kpa - self._offset_kpa) / self._scale_kpa
        # The polynomial about u0 rather than about 0: exactly zero at zero pressure.
        d = u - self._u0
        curve_n = d * (
            self._c1
            + self._c2 * (u + self._u0)
            + self._c3 * (u * u + u * self._u0 + self._u0 * self._u0)
        )
        below_kpa = np.minimum(gauge_kpa, 0.0)
        from_zero_n = curve_n + below_kpa * self.slope_at_zero_n_per_kpa
        slope_n_per_kpa = self._slope(u)
        fit_variance = (
            self._coefficient_variance(u)
            + (self._misfit * from_zero_n) ** 2
            + (self._curve_n * curve_share(from_zero_n)) ** 2
            + (self._scatter * slope_n_per_kpa * inside_kpa) ** 2
            + (self._loop_n * loop_share(from_zero_n)) ** 2
        )
        return StaticForce(
            force_n=from_zero_n + self._zero_n,
            slope_n_per_kpa=slope_n_per_kpa,
            fit_sigma_n=np.sqrt(fit_variance),
        )

    def _slope(self, u: Floats) -> Floats:
        slope = self._c1 + u * (2.0 * self._c2 + u * (3.0 * self._c3))
        return np.asarray(slope / self._scale_kpa)

    def _coefficient_variance(self, u: Floats) -> Floats:
        # Term by term: a matrix product would give other bits for one row than for many.
        d1 = u - self._u0
        basis = (d1, u * u - self._u0 * self._u0, u * u * u - self._u0 * self._u0 * self._u0)
        variance = np.zeros_like(u)
        for i in range(BASIS):
            for j in range(BASIS):
                variance = variance + self._covariance[:, i, j] * basis[i] * basis[j]
        return np.maximum(variance, 0.0)  # rounding may leave a trace below zero


def _rubber(tile: TileCalibration) -> RubberEffect:
    if tile.effects.rubber is None:
        raise CalibrationError(f"tile {tile.serial} has no curve of forces that have lasted")
    return tile.effects.rubber


def _horner(tile: TileCalibration, u: float) -> float:
    c0, c1, c2, c3 = tile.coefficients
    return c0 + u * (c1 + u * (c2 + u * c3))
