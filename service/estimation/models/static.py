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
from service.estimation.records import Record, Records, record_type, records


@dataclass(frozen=True)
class StaticForce:
    """Force on tiles; all arrays (n, tiles)."""

    force_n: Floats
    slope_n_per_kpa: Floats
    fit_sigma_n: Floats
    """Standard uncertainty from the calibration: its coefficients, and a new loading's spread."""


LAW = record_type(
    [
        *((name, np.float64) for name in ("high_kpa", "offset_kpa", "scale_kpa", "u_zero")),
        ("coefficients", np.float64, (BASIS,)),
        ("covariance", np.float64, (BASIS, BASIS)),
        *((name, np.float64) for name in ("zero_n", "slope_at_zero", "misfit", "scatter")),
        *((name, np.float64) for name in ("loop_n", "curve_n")),
    ]
)
"""Constants of a tile."""


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
        self._laws = records(
            LAW,
            len(tiles),
            high_kpa=self.high_kpa,
            offset_kpa=offset_kpa,
            scale_kpa=scale_kpa,
            u_zero=u0,
            coefficients=np.stack([c1, c2, c3], axis=1),
            zero_n=zero_n,
            slope_at_zero=self.slope_at_zero_n_per_kpa,
            covariance=[np.array(t.covariance) * t.f_scale_n**2 for t in tiles],
            misfit=[t.relative_misfit for t in tiles],
            scatter=scatter,
            loop_n=[t.loop_misfit_n for t in tiles],
            curve_n=curve_misfit_n,
        )

    def laws(self) -> Records:
        """The constants, tile by tile."""
        return self._laws

    def force(self, gauge_kpa: Floats) -> StaticForce:
        """Force, slope and calibration uncertainty at gauge pressures of shape (n, tiles)."""
        force, slope, sigma = (np.empty(gauge_kpa.shape) for _ in range(3))
        _curve(self._laws, gauge_kpa, force, slope, sigma)
        return StaticForce(force, slope, sigma)


@compiled
def curve(law: Record, gauge_kpa: float) -> tuple[float, float, float]:
    """Force, its slope and its uncertainty from the calibration at a gauge pressure."""
    inside = gauge_kpa if math.isnan(gauge_kpa) else min(max(gauge_kpa, 0.0), law.high_kpa)
    u, u0 = (inside - law.offset_kpa) / law.scale_kpa, law.u_zero
    c1, c2, c3 = law.coefficients[0], law.coefficients[1], law.coefficients[2]
    # The polynomial about u0 rather than about 0: exactly zero at zero pressure.
    d = u - u0
    value = d * (c1 + c2 * (u + u0) + c3 * (u * u + u * u0 + u0 * u0))
    if gauge_kpa < 0.0:
        value += gauge_kpa * law.slope_at_zero
    rise = (c1 + u * (2.0 * c2 + u * (3.0 * c3))) / law.scale_kpa
    basis = (d, u * u - u0 * u0, u * u * u - u0 * u0 * u0)
    variance = 0.0
    for k in range(BASIS):
        for m in range(BASIS):
            variance += law.covariance[k, m] * basis[k] * basis[m]
    size = abs(value)
    variance = max(variance, 0.0)  # rounding may leave a trace below zero
    variance += (law.misfit * value) ** 2 + (law.scatter * rise * inside) ** 2
    variance += (law.loop_n * (1.0 - LOOP_OPENS_N / (size + LOOP_OPENS_N))) ** 2
    variance += (law.curve_n * (1.0 - CURVE_OPENS_N / (size + CURVE_OPENS_N))) ** 2
    return value + law.zero_n, rise, math.sqrt(variance)


@compiled
def _curve(laws: Records, gauge_kpa: Floats, force: Floats, slope: Floats, sigma: Floats) -> None:
    n, tiles = gauge_kpa.shape
    for i in range(n):
        for j in range(tiles):
            force[i, j], slope[i, j], sigma[i, j] = curve(laws[j], gauge_kpa[i, j])


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
