"""Settled readings of a tile under dead weights.

A step names the weight and its tolerance, `500 g +-0.5 %`; a reading of a kitchen scale or a force
sensor is written the same way. The pressure is that at the end of the step, above the end of the
rest before it, because the rubber creeps for seconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.errors import CalibrationError
from service.estimation.dead_weights import DeadWeight, parse_weight
from service.estimation.fitting.rig.indentation import Indentation, format_origin

STEP_MIN_NS = 2_000_000_000
"""Least duration of a step or rest, for the tile to settle."""
_PART_NS = 1_000_000_000  # first and last part of a step, which are compared
_READINGS_MIN = 10


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
