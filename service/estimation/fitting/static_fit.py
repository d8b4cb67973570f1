"""Fit of a tile's static curve: cubic of force over gauge pressure of slow strokes (paper eq. 2).

Pressure is centred and scaled before the fit: a cubic in raw 100 to 115 kPa has a condition number
beyond 1e12. The curve has no constant term, because the tare makes zero pressure zero force.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from devices.arrays import Floats
from devices.errors import CalibrationError
from service.estimation.calibration import (
    LOOP_HALF_WIDTH_FORCE_N,
    BandPoint,
    RigFacts,
    TileCalibration,
    compute_share_of_final_loop_width,
    is_increasing_cubic,
)
from service.estimation.fitting.least_squares import (
    compute_cubic_basis_through_zero,
    compute_curve_through_zero_n,
    compute_mean_curve_half_width_95_n,
    compute_new_loading_half_width_95_n,
)
from service.estimation.fitting.rig.checks import (
    check_baseline_drift_between_repeats_kpa,
    reject_contradictions,
    reject_no_load_or_single_repeat,
    reject_poor_fit,
    reject_saturated_reference,
    select_before_saturation,
)
from service.estimation.fitting.rig.indentation import (
    Indentation,
    Strokes,
    average_stroke_blocks,
    find_slow_stroke_rows,
    format_origin,
    measure_last_second_before_first_load,
)

BAND_STEPS = 10  # of the band in the file
MEAN_STEPS = 30  # of the mean curve, fine enough for a cubic


class _Cubic:
    """Least squares with `compute_cubic_basis_through_zero` over a range that is centred."""

    def __init__(self, high_kpa: float) -> None:
        self.offset_kpa = self.scale_kpa = high_kpa / 2

    def design_matrix(self, gauge_kpa: Floats) -> Floats:
        return compute_cubic_basis_through_zero(gauge_kpa, self.offset_kpa, self.scale_kpa)

    def solve(self, blocks: Strokes) -> Floats:
        solution, *_ = np.linalg.lstsq(
            self.design_matrix(blocks.gauge_kpa), blocks.force_n, rcond=None
        )
        return np.asarray(solution)

    def compute_residual_n(self, blocks: Strokes, coefficients: Floats) -> Floats:
        return np.asarray(blocks.force_n - self.design_matrix(blocks.gauge_kpa) @ coefficients)


def fit_static_curve(*recordings: Indentation) -> TileCalibration:
    """Fit the static curve of one tile to all its slow strokes, in one file or several.

    Raises:
        CalibrationError: the recordings give no valid curve (see `rig.checks`).
    """
    where = ", ".join(format_origin(recording) for recording in recordings)
    zeros = [measure_last_second_before_first_load(recording) for recording in recordings]
    noise_kpa = _compute_rms(np.array([zero.noise_kpa for zero in zeros]))
    blocks = average_stroke_blocks(*recordings)
    reject_saturated_reference(recordings, blocks)
    blocks, by_chip = select_before_saturation(recordings, blocks, noise_kpa)
    reject_no_load_or_single_repeat(blocks, where)
    drift_kpa = check_baseline_drift_between_repeats_kpa(recordings)
    # The mean end of the repeats: beyond it there is little data.
    high_kpa = float(np.mean(_repeat_maxima(blocks, blocks.gauge_kpa)))
    cubic = _Cubic(high_kpa)
    coefficients = cubic.solve(blocks)
    c1, c2, c3 = (float(c) for c in coefficients)
    polynomial = (0.0, c1, c2, c3)
    residual_n = cubic.compute_residual_n(blocks, coefficients)
    gains = _compute_repeat_gains(blocks, blocks.force_n - residual_n)
    reject_contradictions(gains, where)
    if not is_increasing_cubic(polynomial, (-1.0, 1.0)):
        raise CalibrationError(
            "the fitted curve is not monotonic: force would fall while pressure rises",
            where=where,
            remedy="Look at the recording for slips of the spindle or a leaking dome",
        )
    spread_n = blocks.force_n - blocks.force_n.mean()
    r2 = float(1 - (residual_n**2).sum() / (spread_n**2).sum())
    reject_poor_fit(r2, where)
    left_out = _leave_repeats_out(cubic, blocks)
    loop = cubic.solve(blocks.select_rows(blocks.loading)) - cubic.solve(
        blocks.select_rows(~blocks.loading)
    )
    relative_misfit, loop_misfit_n = _fit_misfit(left_out.force_n, left_out.residual_n)
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
        covariance=tuple(map(tuple, left_out.covariance.tolist())),
        relative_misfit=relative_misfit,
        loop_misfit_n=loop_misfit_n,
        r2=r2,
        rmse_n=_compute_rms(residual_n),
        cv_rmse_n=_compute_rms(left_out.residual_n),
        hysteresis_n=float(np.abs(cubic.design_matrix(np.linspace(0, high_kpa, 101)) @ loop).max()),
        repeats=len(gains),
        baseline_kpa=baseline_kpa,
        noise_kpa=noise_kpa,
    )
    temperature_raw = [
        zero.temperature_counts for zero in zeros if zero.temperature_counts is not None
    ]
    temperature_raw_counts = float(np.mean(temperature_raw)) if temperature_raw else None
    chip = recordings[0].chip
    facts = RigFacts(
        recordings=sum(bool(find_slow_stroke_rows(recording)) for recording in recordings),
        end_n=float(np.mean(_repeat_maxima(blocks, blocks.force_n))),
        end_absolute_kpa=baseline_kpa + high_kpa,
        spare_kpa=chip.max_kpa - baseline_kpa - high_kpa,
        ended_by="chip" if by_chip else "load",
        temperature_raw_counts=temperature_raw_counts,
        degc=None if temperature_raw_counts is None else chip.estimate_degc(temperature_raw_counts),
        r2_of_mean=_compute_r2_of_mean(cubic, residual_n, blocks),
        repeat_gains=tuple(gains.tolist()),
        baseline_drift_kpa=drift_kpa,
        band_95=_make_band(tile),
    )
    return tile.model_copy(update={"rig": facts})


@dataclass(frozen=True)
class _LeaveOneOut:
    """Each repeat against the curve of the others."""

    force_n: Floats
    residual_n: Floats
    covariance: Floats
    """Covariance of the coefficients of all repeats, by jackknife."""


def _leave_repeats_out(cubic: _Cubic, blocks: Strokes) -> _LeaveOneOut:
    # Errors within a repeat are correlated, so whole repeats are left out.
    repeats = np.unique(blocks.repeat)
    without = np.stack([cubic.solve(blocks.select_rows(blocks.repeat != r)) for r in repeats])
    parts = blocks.split_by_repeat()
    deviation = without - without.mean(axis=0)
    return _LeaveOneOut(
        force_n=np.concatenate([part.force_n for part in parts]),
        residual_n=np.concatenate(
            [cubic.compute_residual_n(part, c) for part, c in zip(parts, without, strict=True)]
        ),
        covariance=(len(repeats) - 1) / len(repeats) * deviation.T @ deviation,
    )


def _repeat_maxima(blocks: Strokes, values: Floats) -> list[float]:
    """Return the largest value of each repeat."""
    return [float(values[blocks.repeat == r].max()) for r in np.unique(blocks.repeat)]


def _compute_repeat_gains(blocks: Strokes, fitted_n: Floats) -> Floats:
    """Return the force of each repeat over the curve's."""
    parts = [blocks.repeat == r for r in np.unique(blocks.repeat)]
    return np.array(
        [float((blocks.force_n * fitted_n)[r].sum() / (fitted_n**2)[r].sum()) for r in parts]
    )


def _make_band(tile: TileCalibration) -> tuple[BandPoint, ...]:
    gauge_kpa = np.linspace(0.0, tile.range_kpa[1], BAND_STEPS + 1)
    columns = (
        gauge_kpa,
        compute_curve_through_zero_n(tile, gauge_kpa),
        compute_mean_curve_half_width_95_n(tile, gauge_kpa),
        compute_new_loading_half_width_95_n(tile, gauge_kpa),
    )
    return tuple(
        BandPoint(gauge_kpa=p, force_n=f, mean_n=mean, new_loading_n=new)
        for p, f, mean, new in zip(*(column.tolist() for column in columns), strict=True)
    )


def _compute_r2_of_mean(cubic: _Cubic, residual_n: Floats, blocks: Strokes) -> float:
    """Compute R2 of the cubic to the mean over repeats and branches, in equal pressure steps."""
    place_of = blocks.gauge_kpa / (2 * cubic.scale_kpa) * MEAN_STEPS
    step = np.clip(place_of.astype(np.int64), 0, MEAN_STEPS - 1)
    count = np.bincount(step, minlength=MEAN_STEPS)
    full = count > 0
    mean_n = np.bincount(step, blocks.force_n, MEAN_STEPS)[full] / count[full]
    left_n = np.bincount(step, residual_n, MEAN_STEPS)[full] / count[full]
    return float(1 - (left_n**2).sum() / ((mean_n - mean_n.mean()) ** 2).sum())


def _fit_misfit(force_n: Floats, residual_n: Floats) -> tuple[float, float]:
    """Compute gain and loop part of the left-out residuals' scatter (see `TileCalibration`).

    Non-negative least squares of the squared residuals, each relative to the size of its force,
    so that small loads count as much as large ones.
    """
    weight = 1.0 / (force_n**2 + LOOP_HALF_WIDTH_FORCE_N**2)
    parts = np.stack([force_n**2, compute_share_of_final_loop_width(force_n) ** 2], axis=1)
    variances, _ = nnls(parts * weight[:, None], residual_n**2 * weight)
    relative, loop = np.sqrt(variances)
    return float(relative), float(loop)


def _compute_rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))
