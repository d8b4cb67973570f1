"""A tile's static curve: the cubic of force over gauge pressure through slow strokes (paper eq. 2).

Pressure is centred and scaled before the fit: a cubic in raw 100 to 115 kPa has a condition number
beyond 1e12. The curve has no constant term, because the tare makes zero pressure zero force.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from devices.errors import CalibrationError
from service.estimation.calibration import (
    LOOP_OPENS_N,
    TileCalibration,
    is_monotonic,
    loop_share,
)
from service.estimation.indentation import Indentation, Strokes, place, strokes, unloaded

Floats = npt.NDArray[np.float64]

LOADED_N = 1.0
LOADED_KPA = 1.0


class _Cubic:
    """Least squares with the basis u^k - u0^k, which is zero at zero pressure by construction."""

    def __init__(self, high_kpa: float) -> None:
        self.offset_kpa = self.scale_kpa = high_kpa / 2
        self.u0 = -1.0

    def design(self, gauge_kpa: Floats) -> Floats:
        u = (gauge_kpa - self.offset_kpa) / self.scale_kpa
        return np.stack([u**k - self.u0**k for k in (1, 2, 3)], axis=1)

    def solve(self, blocks: Strokes) -> Floats:
        solution, *_ = np.linalg.lstsq(self.design(blocks.gauge_kpa), blocks.force_n, rcond=None)
        return np.asarray(solution)

    def residual_n(self, blocks: Strokes, coefficients: Floats) -> Floats:
        return np.asarray(blocks.force_n - self.design(blocks.gauge_kpa) @ coefficients)


def fit_tile(recording: Indentation) -> TileCalibration:
    """Fit the static curve of one tile.

    Raises:
        CalibrationError: no slow strokes, fewer than two repeats, the tile is never loaded, or the
            curve is not monotonic.
    """
    blocks = strokes(recording)
    repeats = np.unique(blocks.repeat)
    _refuse_unloaded(blocks, len(repeats), place(recording))
    # Every repeat reaches the end of the range on average: beyond it there is nothing to go by.
    high_kpa = float(np.mean([blocks.gauge_kpa[blocks.repeat == r].max() for r in repeats]))
    cubic = _Cubic(high_kpa)
    coefficients = cubic.solve(blocks)
    c1, c2, c3 = (float(c) for c in coefficients)
    polynomial = (0.0, c1, c2, c3)
    if not is_monotonic(polynomial, (cubic.u0, 1.0)):
        raise CalibrationError(
            "the fitted curve is not monotonic: force would fall while pressure rises",
            where=place(recording),
            remedy="Look at the recording for slips of the spindle or a leaking dome",
        )
    # Errors within a repeat go together, so uncertainty comes from leaving whole repeats out.
    without = np.stack([cubic.solve(blocks.rows(blocks.repeat != r)) for r in repeats])
    left_out = [blocks.rows(blocks.repeat == r) for r in repeats]
    left_out_n = np.concatenate(
        [cubic.residual_n(part, c) for part, c in zip(left_out, without, strict=True)]
    )
    left_out_force_n = np.concatenate([part.force_n for part in left_out])
    deviation = without - without.mean(axis=0)
    covariance = (len(repeats) - 1) / len(repeats) * deviation.T @ deviation
    residual_n = cubic.residual_n(blocks, coefficients)
    spread_n = blocks.force_n - blocks.force_n.mean()
    loop = cubic.solve(blocks.rows(blocks.loading)) - cubic.solve(blocks.rows(~blocks.loading))
    relative_misfit, loop_misfit_n = _misfit(left_out_force_n, left_out_n)
    zero = unloaded(recording)
    return TileCalibration(
        serial=recording.serial,
        p_input="gauge_kpa",
        p_offset_kpa=cubic.offset_kpa,
        p_scale_kpa=cubic.scale_kpa,
        f_offset_n=0.0,
        f_scale_n=1.0,
        zero_mode="subtract_f0",
        coefficients=polynomial,
        range_kpa=(0.0, high_kpa),
        monotonic=True,
        absolute_scale="measured",
        covariance=tuple(tuple(float(c) for c in row) for row in covariance),
        relative_misfit=relative_misfit,
        loop_misfit_n=loop_misfit_n,
        r2=float(1 - (residual_n**2).sum() / (spread_n**2).sum()),
        rmse_n=_rms(residual_n),
        cv_rmse_n=_rms(left_out_n),
        hysteresis_n=float(np.abs(cubic.design(np.linspace(0, high_kpa, 101)) @ loop).max()),
        repeats=len(repeats),
        baseline_kpa=zero.baseline_kpa,
        noise_kpa=zero.noise_kpa,
    )


def _misfit(force_n: Floats, residual_n: Floats) -> tuple[float, float]:
    """Gain and loop part of the scatter of left-out residuals (see `TileCalibration`).

    Non-negative least squares of the squared residuals, each relative to the size of its force,
    so that small loads count as much as large ones.
    """
    weight = 1.0 / (force_n**2 + LOOP_OPENS_N**2)
    parts = np.stack([force_n**2, loop_share(force_n) ** 2], axis=1)
    variances, _ = nnls(parts * weight[:, None], residual_n**2 * weight)
    relative, loop = np.sqrt(variances)
    return float(relative), float(loop)


def _refuse_unloaded(blocks: Strokes, repeats: int, where: str) -> None:
    most_n, most_kpa = blocks.force_n.max(), blocks.gauge_kpa.max()
    if most_n < LOADED_N or most_kpa < LOADED_KPA:
        raise CalibrationError(
            f"the indentation never loads the tile: at most {most_n:.2f} N on the reference and "
            f"{most_kpa:.2f} kPa in the tile",
            where=where,
            expected=f"more than {LOADED_N} N and {LOADED_KPA} kPa",
            remedy="Check that the spindle stands over this tile and that the dome is sealed",
        )
    if repeats < 2:
        raise CalibrationError(
            f"{repeats} slow repeat",
            where=where,
            expected="at least two, so that one can be predicted from the others",
        )


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))
