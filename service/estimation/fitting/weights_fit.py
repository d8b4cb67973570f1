"""Fit of a tile's curve to a few dead weights, with a 95 % interval for new settled loads.

The curve is a parabola through zero: five weights do not determine the third coefficient of the
paper's cubic, which widens the interval by 1.5 and gains nothing (benchmarks/dead_weights.py).
A step of the recording names the weight and its tolerance, `500 g +-0.5 %`; a reading of a kitchen
scale or a force sensor is written the same way. The pressure is that at the end of the step, above
the end of the rest before it, because the rubber creeps for seconds.

Residuals are relative to the force. Estimates multiply the file's standard uncertainties by 1.96;
here they are widened by Student's t for the degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import stdtrit

from devices.arrays import Floats
from devices.errors import CalibrationError
from service.estimation.calibration import (
    CUBIC_TERMS,
    BandPoint,
    TileCalibration,
    WeightFacts,
    WeightStep,
)
from service.estimation.dead_weights import DeadWeight, check_enough_distinct_weights, parse_weight
from service.estimation.effects import EffectName, Effects
from service.estimation.fitting.least_squares import (
    compute_cubic_basis_through_zero,
    compute_curve_through_zero_n,
)
from service.estimation.fitting.rig.indentation import Indentation, format_origin
from service.estimation.models.static import StaticParams, compute_forces
from service.estimation.records import SIGMAS_95

SMALL_FORCE_N = 2.0
"""Force below which an error is absolute rather than relative."""
RESIDUAL_MAX = 0.3
"""Largest relative residual: six times the paper's scatter between loadings."""
DRIFT_MAX_KPA = 2.0
"""Largest drift of the unloaded pressure from the first to any later rest, that of 15 % creep. The
pressure of each weight is relative to its own rest."""
RANGE_MIN_KPA = 1.0
TERMS = 2
_BAND_STEPS = 10
STEP_MIN_NS = 2_000_000_000
"""Least duration of a step or rest, for the tile to settle."""
_PART_NS = 1_000_000_000  # first and last part of a step, which are compared
_READINGS_MIN = 10
_NOT_SEEN: dict[EffectName, str] = {
    "temperature": "dead weights show no change of temperature",
    "gas": "dead weights show no fast load",
    "rubber": "dead weights show no release",
    "hysteresis": "dead weights show no slow stroke",
}


def fit_curve_to_dead_weights(recordings: Sequence[Indentation]) -> TileCalibration:
    """Fit the curve of one tile to all its dead weights, in one recording or several.

    Raises:
        CalibrationError: there are too few weights, or they show no curve.
    """
    where = ", ".join(format_origin(recording) for recording in recordings)
    per_file = [measure_holds(recording) for recording in recordings]
    steps = [step for found in per_file for step in found]
    check_enough_distinct_weights([step.weight.force_n for step in steps], where)
    drift_kpa = max(
        max(abs(step.baseline_kpa - found[0].baseline_kpa) for step in found)
        for found in per_file
        if found
    )
    if drift_kpa > DRIFT_MAX_KPA:
        raise CalibrationError(
            f"the unloaded pressure drifts by {drift_kpa:.2f} kPa between rests",
            where=where,
            expected=f"at most {DRIFT_MAX_KPA:g} kPa",
            remedy="Let the tile reach the room's temperature and rest longer between weights; "
            "if it goes on falling, the dome leaks",
        )
    force_n = np.array([step.weight.force_n for step in steps])
    gauge_kpa = np.array([step.gauge_kpa for step in steps])
    high_kpa = float(gauge_kpa.max())
    _reject_no_rise(force_n, gauge_kpa, steps, where)
    basis = compute_cubic_basis_through_zero(gauge_kpa, 0.0, high_kpa)[:, :TERMS]
    weight = 1.0 / np.hypot(force_n, SMALL_FORCE_N)
    design = basis * weight[:, None]
    (c1, c2), *_ = np.linalg.lstsq(design, force_n * weight, rcond=None)
    residual_n = basis @ np.array([c1, c2]) - force_n
    _reject_contradictions(residual_n, force_n, steps, where)
    freedom = len(steps) - TERMS
    variance = float(((residual_n * weight) ** 2).sum() / freedom)
    widened = float(stdtrit(freedom, 0.975)) / SIGMAS_95
    scatter = widened * float(np.sqrt(variance))
    if not min(c1, c1 + 2.0 * c2) > 0.0:
        raise CalibrationError(
            "the fitted curve is not monotonic: force would fall while pressure rises",
            where=where,
            remedy="Check what each weight is, and put them on the middle of the dome",
        )
    covariance = np.zeros((CUBIC_TERMS, CUBIC_TERMS))
    covariance[:TERMS, :TERMS] = scatter**2 * np.linalg.inv(design.T @ design)
    slope = (c1 + 2.0 * c2 * gauge_kpa / high_kpa) / high_kpa
    settle = slope * np.array([step.settle_kpa for step in steps]) / force_n
    # The weights share one scale: its error does not average out.
    scale = max(step.weight.relative_sigma for step in steps)
    spread_n = force_n - force_n.mean()
    tile = TileCalibration(
        serial=recordings[0].serial,
        p_input="gauge_kpa",
        p_offset_kpa=0.0,
        p_scale_kpa=high_kpa,
        f_offset_n=0.0,
        f_scale_n=1.0,
        zero_mode="subtract_f0",
        coefficients=(0.0, float(c1), float(c2), 0.0),
        range_kpa=(0.0, high_kpa),
        monotonic=True,
        absolute_scale="measured",
        covariance=tuple(map(tuple, covariance.tolist())),
        relative_misfit=float(np.sqrt(scatter**2 + (settle**2).mean() + scale**2)),
        loop_misfit_n=scatter * SMALL_FORCE_N,
        r2=float(1.0 - (residual_n**2).sum() / (spread_n**2).sum()),
        rmse_n=float(np.sqrt((residual_n**2).mean())),
        cv_rmse_n=_compute_left_out_rms_n(design, force_n, weight, basis),
        hysteresis_n=None,
        repeats=len(steps),
        baseline_kpa=float(np.mean([step.baseline_kpa for step in steps])),
        noise_kpa=float(np.sqrt(np.mean([step.noise_kpa**2 for step in steps]))),
        effects=Effects(refused=_NOT_SEEN),
    )
    return tile.model_copy(
        update={
            "weights": WeightFacts(
                steps=tuple(
                    WeightStep(
                        weight=step.text,
                        force_n=step.weight.force_n,
                        gauge_kpa=step.gauge_kpa,
                        noise_kpa=step.noise_kpa,
                        settle_kpa=step.settle_kpa,
                        residual_n=residual,
                    )
                    for step, residual in zip(steps, residual_n.tolist(), strict=True)
                ),
                baseline_drift_kpa=drift_kpa,
                scale_sigma=scale,
                band_95=_make_band(tile),
            )
        }
    )


def _make_band(tile: TileCalibration) -> tuple[BandPoint, ...]:
    """Return the curve with the half widths that an estimate of a settled load states."""
    gauge_kpa = np.linspace(0.0, tile.range_kpa[1], _BAND_STEPS + 1)
    found = compute_forces(StaticParams.from_calibrations([tile]), gauge_kpa[:, None])
    basis = compute_cubic_basis_through_zero(gauge_kpa, tile.p_offset_kpa, tile.p_scale_kpa)
    mean_n = SIGMAS_95 * np.sqrt(
        np.maximum(((basis @ np.array(tile.covariance)) * basis).sum(1), 0.0)
    )
    columns = (
        gauge_kpa,
        compute_curve_through_zero_n(tile, gauge_kpa),
        mean_n,
        SIGMAS_95 * found.fit_sigma_n[:, 0],
    )
    return tuple(
        BandPoint(gauge_kpa=p, force_n=f, mean_n=mean, new_loading_n=new)
        for p, f, mean, new in zip(*(column.tolist() for column in columns), strict=True)
    )


def _compute_left_out_rms_n(
    design: Floats, force_n: Floats, weight: Floats, basis: Floats
) -> float:
    """Return the RMS error of the curve at weights that it was not fitted to."""
    errors = []
    for i in range(len(force_n)):
        others = np.arange(len(force_n)) != i
        found, *_ = np.linalg.lstsq(design[others], (force_n * weight)[others], rcond=None)
        errors.append(float(basis[i] @ found - force_n[i]))
    return float(np.sqrt(np.mean(np.square(errors))))


def _reject_no_rise(
    force_n: Floats, gauge_kpa: Floats, steps: Sequence[WeightHold], where: str
) -> None:
    if not gauge_kpa.max() >= RANGE_MIN_KPA:
        raise CalibrationError(
            f"the tile reads {gauge_kpa.max():.2f} kPa at most under {force_n.max():.1f} N",
            where=where,
            expected=f"{RANGE_MIN_KPA:g} kPa or more",
            remedy="Check that the weights stand on this tile's dome, and that it is sealed",
        )
    order = np.argsort(force_n)
    for lighter, heavier in pairwise(order.tolist()):
        is_apart = force_n[heavier] > 1.2 * force_n[lighter]
        if is_apart and not gauge_kpa[heavier] > gauge_kpa[lighter]:
            raise CalibrationError(
                f"the tile reads {gauge_kpa[heavier]:.2f} kPa under {steps[heavier].text} and "
                f"{gauge_kpa[lighter]:.2f} kPa under {steps[lighter].text}",
                where=where,
                expected="a pressure that rises with the weight",
                remedy="Check what each weight is; if both are right, the tile's range ends there: "
                "leave the heavier one out",
            )


def _reject_contradictions(
    residual_n: Floats, force_n: Floats, steps: Sequence[WeightHold], where: str
) -> None:
    off = residual_n / np.hypot(force_n, SMALL_FORCE_N)
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) > RESIDUAL_MAX:
        as_n = force_n[worst] + residual_n[worst]
        raise CalibrationError(
            f"the weight of {steps[worst].text} reads like {as_n:.2f} N, and is "
            f"{force_n[worst]:.2f} N",
            where=where,
            expected=f"within {100 * RESIDUAL_MAX:.0f} % of the curve of all weights",
            remedy="Check what was on the tile, and whether it stood on the middle of the dome",
        )


@dataclass(frozen=True)
class WeightHold:
    """Weight on a tile, with the tile's pressure in kPa above the rest before.

    Attributes:
        text: text of the weight.
        weight: force.
        gauge_kpa: mean over the last second.
        noise_kpa: standard deviation of a reading in that second.
        settle_kpa: mean of the last second less that of the first.
        baseline_kpa: absolute pressure of the rest before.
    """

    text: str
    weight: DeadWeight
    gauge_kpa: float
    noise_kpa: float
    settle_kpa: float
    baseline_kpa: float


def has_weights(recording: Indentation) -> bool:
    """Return whether any step of the tile is a weight."""
    return any(parse_weight(str(phase)) for phase in np.unique(_label_steps(recording)))


def measure_holds(recording: Indentation) -> list[WeightHold]:
    """Return every weight on the tile with its reading, in order of time.

    Raises:
        CalibrationError: a step is too short or has no readings, has no rest before it, or the chip
            was saturated.
    """
    steps = _label_steps(recording)
    begins = np.flatnonzero(np.append(True, steps[1:] != steps[:-1]))
    ends = np.append(begins[1:], len(steps))
    found: list[WeightHold] = []
    baseline_kpa: float | None = None
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        text = str(steps[begin])
        if text == "rest":
            baseline_kpa, _, _ = _measure_settled(recording, begin, end, text)
        elif (weight := parse_weight(text)) is not None:
            if baseline_kpa is None:
                raise CalibrationError(
                    f"there is no rest before the weight of {text}",
                    where=format_origin(recording),
                    expected="a rest of 2 s or more with nothing on the tile",
                    remedy="Record once more, and begin with an empty tile",
                )
            end_kpa, noise_kpa, settle_kpa = _measure_settled(recording, begin, end, text)
            found.append(
                WeightHold(
                    text, weight, end_kpa - baseline_kpa, noise_kpa, settle_kpa, baseline_kpa
                )
            )
    return found


def _label_steps(recording: Indentation) -> np.ndarray:
    """Return the step of every reading; empty where the indenter is elsewhere."""
    return np.where(recording.is_under_indenter, recording.phase, "")


def _measure_settled(
    recording: Indentation, begin: int, end: int, text: str
) -> tuple[float, float, float]:
    """Return mean and noise of the last second of a step, and its change since the first."""
    t_ns, kpa = recording.t_ns[begin:end], recording.kpa[begin:end]
    where, step = format_origin(recording), "rest" if text == "rest" else f"weight of {text}"
    if np.isinf(kpa).any():
        raise CalibrationError(
            f"the chip was at its end under the {step}",
            where=where,
            remedy="Leave this weight out: the tile's range ends below it",
        )
    known = np.isfinite(kpa)
    first = kpa[known & (t_ns < t_ns[0] + _PART_NS)]
    last = kpa[known & (t_ns > t_ns[-1] - _PART_NS)]
    if t_ns[-1] - t_ns[0] < 0.9 * STEP_MIN_NS or min(len(first), len(last)) < _READINGS_MIN:
        raise CalibrationError(
            f"the {step} lasted {1e-9 * (t_ns[-1] - t_ns[0]):.1f} s with {known.sum()} readings",
            where=where,
            expected=f"{1e-9 * STEP_MIN_NS:g} s or more of readings",
            remedy="Remove the markers of this step on the session's page, or record once more",
        )
    return float(last.mean()), float(last.std(ddof=1)), float(last.mean() - first.mean())
