"""A tile's static curve: the cubic of force over gauge pressure through slow strokes (paper eq. 2).

Pressure is centred and scaled before the fit: a cubic in raw 100 to 115 kPa has a condition number
beyond 1e12. The curve has no constant term, because the tare makes zero pressure zero force.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from devices.errors import CalibrationError
from devices.mpl115a2 import PRESSURE_MAX_KPA, indicative_degc
from service.estimation.bench_checks import (
    baseline_drift_kpa,
    before_saturation,
    refuse_contradictions,
    refuse_poor_fit,
    refuse_saturated_reference,
    refuse_unloaded,
)
from service.estimation.bench_facts import BandPoint, BenchFacts
from service.estimation.calibration import (
    LOOP_OPENS_N,
    TileCalibration,
    is_monotonic,
    loop_share,
)
from service.estimation.confidence import curve_n, mean_band_n, new_loading_band_n
from service.estimation.indentation import (
    Indentation,
    Strokes,
    place,
    stroke_rows,
    strokes,
    unloaded,
)

Floats = npt.NDArray[np.float64]

BAND_STEPS = 10
MEAN_STEPS = 30


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


def fit_tile(*recordings: Indentation) -> TileCalibration:
    """Fit the static curve of one tile to all its slow strokes, in one file or several.

    Raises:
        CalibrationError: there is no curve that could be believed (see `bench_checks`).
    """
    where = ", ".join(place(recording) for recording in recordings)
    zeros = [unloaded(recording) for recording in recordings]
    noise_kpa = _rms(np.array([zero.noise_kpa for zero in zeros]))
    blocks = strokes(*recordings)
    refuse_saturated_reference(recordings, blocks)
    blocks, by_chip = before_saturation(recordings, blocks, noise_kpa)
    refuse_unloaded(blocks, where)
    drift_kpa = baseline_drift_kpa(recordings)
    repeats = np.unique(blocks.repeat)
    # Every repeat reaches the end of the range on average: beyond it there is nothing to go by.
    high_kpa = float(np.mean([blocks.gauge_kpa[blocks.repeat == r].max() for r in repeats]))
    cubic = _Cubic(high_kpa)
    coefficients = cubic.solve(blocks)
    c1, c2, c3 = (float(c) for c in coefficients)
    polynomial = (0.0, c1, c2, c3)
    fitted_n = blocks.force_n - cubic.residual_n(blocks, coefficients)
    gains = np.array(
        [
            (blocks.force_n * fitted_n)[blocks.repeat == r].sum()
            / (fitted_n**2)[blocks.repeat == r].sum()
            for r in repeats
        ]
    )
    refuse_contradictions(gains, where)
    if not is_monotonic(polynomial, (cubic.u0, 1.0)):
        raise CalibrationError(
            "the fitted curve is not monotonic: force would fall while pressure rises",
            where=where,
            remedy="Look at the recording for slips of the spindle or a leaking dome",
        )
    residual_n = cubic.residual_n(blocks, coefficients)
    spread_n = blocks.force_n - blocks.force_n.mean()
    r2 = float(1 - (residual_n**2).sum() / (spread_n**2).sum())
    refuse_poor_fit(r2, where)
    # Errors within a repeat go together, so uncertainty comes from leaving whole repeats out.
    without = np.stack([cubic.solve(blocks.rows(blocks.repeat != r)) for r in repeats])
    left_out = [blocks.rows(blocks.repeat == r) for r in repeats]
    left_out_n = np.concatenate(
        [cubic.residual_n(part, c) for part, c in zip(left_out, without, strict=True)]
    )
    left_out_force_n = np.concatenate([part.force_n for part in left_out])
    deviation = without - without.mean(axis=0)
    covariance = (len(repeats) - 1) / len(repeats) * deviation.T @ deviation
    loop = cubic.solve(blocks.rows(blocks.loading)) - cubic.solve(blocks.rows(~blocks.loading))
    relative_misfit, loop_misfit_n = _misfit(left_out_force_n, left_out_n)
    baseline_kpa = float(np.mean([zero.baseline_kpa for zero in zeros]))
    tile = TileCalibration(
        serial=recordings[0].serial,
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
        r2=r2,
        rmse_n=_rms(residual_n),
        cv_rmse_n=_rms(left_out_n),
        hysteresis_n=float(np.abs(cubic.design(np.linspace(0, high_kpa, 101)) @ loop).max()),
        repeats=len(repeats),
        baseline_kpa=baseline_kpa,
        noise_kpa=noise_kpa,
    )
    tadc = [zero.tadc_counts for zero in zeros if zero.tadc_counts is not None]
    tadc_counts = float(np.mean(tadc)) if tadc else None
    steps_kpa = np.linspace(0.0, high_kpa, BAND_STEPS + 1)
    bands = (steps_kpa, curve_n(tile, steps_kpa), *_bands_n(tile, steps_kpa))
    facts = BenchFacts(
        recordings=sum(bool(stroke_rows(recording)) for recording in recordings),
        end_n=float(np.mean([blocks.force_n[blocks.repeat == r].max() for r in repeats])),
        end_absolute_kpa=baseline_kpa + high_kpa,
        spare_kpa=PRESSURE_MAX_KPA - baseline_kpa - high_kpa,
        ended_by="chip" if by_chip else "load",
        tadc_counts=tadc_counts,
        degc=None if tadc_counts is None else float(indicative_degc(tadc_counts)),
        r2_of_mean=_r2_of_mean(cubic, coefficients, blocks),
        repeat_gains=tuple(float(gain) for gain in gains),
        baseline_drift_kpa=drift_kpa,
        band_95=tuple(
            BandPoint(gauge_kpa=p, force_n=f, mean_n=m, new_loading_n=n)
            for p, f, m, n in zip(*(values.tolist() for values in bands), strict=True)
        ),
    )
    return tile.model_copy(update={"bench": facts})


def _bands_n(tile: TileCalibration, gauge_kpa: Floats) -> tuple[Floats, Floats]:
    return mean_band_n(tile, gauge_kpa), new_loading_band_n(tile, gauge_kpa)


def _r2_of_mean(cubic: _Cubic, coefficients: Floats, blocks: Strokes) -> float:
    """R2 of the cubic to the mean over repeats and branches, in equal steps of pressure."""
    step = np.minimum(
        (blocks.gauge_kpa / (2 * cubic.scale_kpa) * MEAN_STEPS).astype(np.int64), MEAN_STEPS - 1
    )
    step = np.maximum(step, 0)
    count = np.bincount(step, minlength=MEAN_STEPS)
    full = count > 0
    mean_n = np.bincount(step, blocks.force_n, MEAN_STEPS)[full] / count[full]
    left_n = cubic.residual_n(blocks, coefficients)
    mean_left_n = np.bincount(step, left_n, MEAN_STEPS)[full] / count[full]
    return float(1 - (mean_left_n**2).sum() / ((mean_n - mean_n.mean()) ** 2).sum())


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


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))
