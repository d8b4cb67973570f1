"""Loadings of a tile in the rig: strokes as one sequence, and settled readings under weights.

Slow strokes are averaged in blocks; holds, releases and taps stay reading by reading. Outliers are
removed.

A step names the weight and its tolerance, `500 g +-0.5 %`; a reading of a kitchen scale or a force
sensor is written the same way. The pressure is that at the end of the step, above the end of the
rest before it, because the rubber creeps for seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from devices.arrays import ArrayRecord, Bools, Floats, Ints
from devices.errors import CalibrationError
from service.estimation.dead_weights import DeadWeight, parse_weight
from service.estimation.fitting.rig.indentation import Indentation, format_origin
from service.estimation.models.denoise import find_outliers

BLOCK_READINGS = 10  # readings: 20 ms of a stroke that lasts seconds
_NOISE_MIN_KPA = 0.03
"""Least noise: rounding to a count."""
_RECORDING_GAP_S = 600.0
"""Time inserted between two recordings, in which the rubber recovers."""


@dataclass(frozen=True)
class LoadingPoints(ArrayRecord):
    """Points of all loadings, m in the order of time.

    Attributes:
        t_s: instants, from 0.
        force_n: reference force above its zero.
        kpa: absolute pressure; NaN without a reading.
        weight: square root of the number of readings averaged, over the noise, in 1/kPa.
        loading: number of the loading, from 0.
        is_fast: True for points of a hold, a release or a tap.
    """

    t_s: Floats
    force_n: Floats
    kpa: Floats
    weight: Floats
    loading: Ints
    is_fast: Bools

    @property
    def n_loadings(self) -> int:
        """Number of loadings."""
        return int(self.loading.max()) + 1


def extract_loading_points(
    recording: Indentation, reference_zero_n: float, noise_kpa: float
) -> LoadingPoints:
    """Reduce a recording to the points of its loadings; pressures stay absolute."""
    rows = recording.is_under_indenter & np.isfinite(recording.reference_n)
    rows &= recording.phase != "soak"
    t_s = (recording.t_ns[rows] - recording.t_ns[rows][0]) * 1e-9
    force_n = recording.reference_n[rows] - reference_zero_n
    phase = recording.phase[rows]
    kpa = np.where(np.isfinite(recording.kpa), recording.kpa, np.nan)[rows]
    # Less the part that the reference explains: the top of a tap is a single reading, too.
    unexplained_kpa = kpa - _compute_slope_kpa_per_n(kpa, force_n) * force_n
    kpa = np.where(
        find_outliers(unexplained_kpa[:, None], np.array([noise_kpa]))[:, 0], np.nan, kpa
    )
    active = phase != "rest"
    before = np.concatenate([["rest"], phase[:-1]])
    # A loading may follow a stroke without a rest.
    begins = active & ((before == "rest") | ((phase == "load") & (before == "unload")))
    loading = np.maximum(np.cumsum(begins) - 1, 0)
    fast = np.isin(phase, ("hold", "release", "tap"))
    # The load before a hold, and all after a fast phase, belong to that loading.
    is_fast = np.zeros(int(loading[-1]) + 1, dtype=bool)
    is_fast[loading[fast]] = True
    fast = is_fast[loading]
    # A block ends when it is full, and at each change between slow and fast.
    run = np.cumsum(np.concatenate([[0], np.diff(fast.astype(np.int8)) != 0]))
    index = np.arange(len(t_s))
    first = np.searchsorted(run, run)
    number = np.where(fast, index, first + (index - first) // BLOCK_READINGS * BLOCK_READINGS)
    # One point for each instant.
    _, block = np.unique(number[np.searchsorted(t_s, t_s)], return_inverse=True)
    size = np.bincount(block)
    good = np.isfinite(kpa)
    counted = np.bincount(block, good)
    with np.errstate(invalid="ignore"):
        mean_kpa = np.bincount(block, np.where(good, kpa, 0.0)) / counted
    last = np.cumsum(size) - 1
    return LoadingPoints(
        t_s=np.bincount(block, t_s) / size,
        force_n=np.bincount(block, force_n) / size,
        kpa=mean_kpa,
        weight=np.sqrt(counted) / max(noise_kpa, _NOISE_MIN_KPA),
        loading=loading[last],
        is_fast=fast[last],
    )


def _compute_slope_kpa_per_n(kpa: Floats, force_n: Floats) -> float:
    """Compute the mean slope of pressure over force; 0 without any load."""
    good = np.isfinite(kpa)
    spread_n = force_n[good] - force_n[good].mean() if good.any() else np.zeros(1)
    square = float((spread_n**2).sum())
    return float((spread_n * kpa[good]).sum()) / square if square > 0.0 else 0.0


def join_loading_points(parts: Sequence[LoadingPoints]) -> LoadingPoints:
    """Join several recordings to one sequence, far enough apart to be independent."""
    begin_s, loadings = 0.0, 0
    shifted = []
    for part in parts:
        shifted.append(replace(part, t_s=part.t_s + begin_s, loading=part.loading + loadings))
        begin_s = float(shifted[-1].t_s[-1]) + _RECORDING_GAP_S
        loadings += part.n_loadings
    return LoadingPoints.concatenate(shifted)


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
