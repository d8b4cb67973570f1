"""Indentation recording of one tile: block averages of its slow strokes, points of its loadings.

Readings are averaged in short blocks of a stroke: noise of single readings is an error of the
independent variable, and would flatten the fitted curve. A stroke is a `load` directly followed by
an `unload`; holds, releases and taps are for the models of fast effects, and stay reading by
reading, without outliers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from devices.arrays import ArrayRecord, Bools, Floats, Ints, Times
from devices.chips.pressure_chip import PressureChip
from devices.errors import CalibrationError
from service.estimation.models.denoise import find_outliers

BLOCKS_PER_STROKE = 60  # many for a cubic, and each averages many readings
BASELINE_NS = 1_000_000_000  # before the first press
BASELINE_READINGS_MIN = 10  # fewer do not determine the noise
REST_NS = 500_000_000  # last part of a rest, when the rubber has recovered most
BLOCK_READINGS = 10  # readings: 20 ms of a stroke that lasts seconds
_NOISE_MIN_KPA = 0.03
"""Least noise: rounding to a count."""
_RECORDING_GAP_S = 600.0
"""Time inserted between two recordings, in which the rubber recovers."""


@dataclass(frozen=True)
class Indentation:
    """One tile's part of a rig recording; arrays of n readings in the order of time.

    Attributes:
        serial: of the tile.
        chip: kind of its chip.
        where: file, for messages.
        t_ns: instants of the readings.
        kpa: absolute pressure; NaN where the tile was not readable, infinite where its chip's
            count had run past its end.
        reference_n: force of the reference sensor; NaN where the spindle was elsewhere.
        phase: phase of the indenter: "rest", "load", "unload", ...
        is_under_indenter: True while the indenter is over this tile.
    """

    serial: str
    chip: PressureChip
    where: str
    t_ns: Times
    kpa: Floats
    reference_n: Floats
    phase: npt.NDArray[np.str_]
    is_under_indenter: Bools
    temperature_raw: Floats
    """Raw temperature in counts; NaN where unknown."""


@dataclass(frozen=True)
class Strokes(ArrayRecord):
    """Block averages of all slow strokes of a tile, m blocks.

    Attributes:
        gauge_kpa: (m,), pressure above the tile's baseline.
        force_n: (m,), reference force above its own zero.
        repeat: (m,), number of the stroke, from 0.
        loading: (m,), True on the way in.
    """

    gauge_kpa: Floats
    force_n: Floats
    repeat: Ints
    loading: Bools

    def split_by_repeat(self) -> list[Strokes]:
        """Split the blocks by repeat."""
        return [self.select_rows(self.repeat == repeat) for repeat in np.unique(self.repeat)]


@dataclass(frozen=True)
class UnloadedState:
    """State of tile and reference just before the first loading."""

    baseline_kpa: float
    noise_kpa: float
    reference_zero_n: float
    temperature_counts: float | None = None
    """Mean raw temperature; None where unknown."""


@dataclass(frozen=True)
class ThermalSoak:
    """Thermal soak of an unloaded tile; arrays of n readings.

    Attributes:
        chip: kind of the tile's chip.
        t_s: instants.
        kpa: absolute pressures, NaN where there is none.
        temperature_raw: raw temperature in counts, NaN where there is none.
        noise_kpa: standard deviation of a reading.
    """

    chip: PressureChip
    t_s: Floats
    kpa: Floats
    temperature_raw: Floats
    noise_kpa: float


def measure_last_second_before_first_load(recording: Indentation) -> UnloadedState:
    """Measure baseline, noise and reference zero in the last second before the first loading.

    Raises:
        CalibrationError: the tile is never loaded, or has too few readings before.
    """
    where = format_origin(recording)
    pressed = recording.is_under_indenter & (recording.phase != "rest")
    if not pressed.any():
        raise CalibrationError(
            "the recording never presses this tile",
            where=where,
            expected="phases load and unload with pressed_tile naming it",
        )
    first = int(np.argmax(pressed))
    before = np.arange(len(pressed)) < first
    before &= recording.t_ns >= recording.t_ns[first] - BASELINE_NS
    kpa = recording.kpa[before & np.isfinite(recording.kpa)]
    if len(kpa) < BASELINE_READINGS_MIN:
        raise CalibrationError(
            f"only {len(kpa)} readings before the tile is first pressed",
            where=where,
            expected=f"at least {BASELINE_READINGS_MIN} unloaded readings for the baseline",
        )
    reference_n = recording.reference_n[before & recording.is_under_indenter]
    reference_n = reference_n[np.isfinite(reference_n)]
    temperature_raw = recording.temperature_raw[before & np.isfinite(recording.temperature_raw)]
    return UnloadedState(
        baseline_kpa=float(kpa.mean()),
        noise_kpa=float(kpa.std(ddof=1)),
        reference_zero_n=float(reference_n.mean()) if len(reference_n) else 0.0,
        temperature_counts=float(temperature_raw.mean()) if len(temperature_raw) else None,
    )


def average_stroke_blocks(*recordings: Indentation) -> Strokes:
    """Average every slow stroke of a tile in blocks, in one file or several.

    Each file has its own baseline and its own zero of the reference. A file may have no stroke if
    another one has.

    Raises:
        CalibrationError: no slow stroke, or as for `measure_last_second_before_first_load`.
    """
    blocks: list[_Block] = []
    count = 0
    for recording in recordings:
        zero = measure_last_second_before_first_load(recording)
        for begin, turn, end in find_slow_stroke_rows(recording):
            for rows, loading in (
                (np.arange(begin, turn), True),
                (np.arange(turn, end), False),
            ):
                blocks += _average_blocks(recording, zero, rows, count, loading)
            count += 1
    if not blocks:
        raise CalibrationError(
            "no slow stroke of this tile in the recording",
            where=", ".join(format_origin(recording) for recording in recordings),
            expected="phase load followed by phase unload, with reference_force_n",
        )
    gauge, force, repeat, loads = zip(*blocks, strict=True)
    return Strokes(np.array(gauge), np.array(force), np.array(repeat), np.array(loads))


_Block = tuple[float, float, int, bool]


class StrokeRows(NamedTuple):
    """Rows of a slow stroke in its recording."""

    begin: int
    turn: int
    """First row of the unloading."""
    end: int
    """Row behind the last."""


def find_slow_stroke_rows(recording: Indentation) -> list[StrokeRows]:
    """Return the rows of each slow stroke: phase load followed by phase unload."""
    label = np.where(recording.is_under_indenter, recording.phase, "")
    begins = np.flatnonzero(np.append(True, label[1:] != label[:-1]))
    ends = np.append(begins[1:], len(label))
    return [
        StrokeRows(int(begins[i]), int(begins[i + 1]), int(ends[i + 1]))
        for i in range(len(begins) - 1)
        if (label[begins[i]], label[begins[i + 1]]) == ("load", "unload")
    ]


def _average_blocks(
    recording: Indentation,
    zero: UnloadedState,
    rows: Ints,
    repeat: int,
    loading: bool,
) -> list[_Block]:
    # The stroke ends where the chip saturates: noise would select readings beyond.
    past = np.flatnonzero(np.isinf(recording.kpa[rows]))
    if len(past):
        rows = rows[: past[0]] if loading else rows[past[-1] + 1 :]
    rows = rows[np.isfinite(recording.kpa[rows]) & np.isfinite(recording.reference_n[rows])]
    return [
        (
            float(recording.kpa[block].mean() - zero.baseline_kpa),
            float(recording.reference_n[block].mean() - zero.reference_zero_n),
            repeat,
            loading,
        )
        for block in np.array_split(rows, BLOCKS_PER_STROKE)
        if len(block)
    ]


def compute_rest_before_strokes_absolute_kpa(recording: Indentation) -> Floats:
    """Compute the mean pressure in the last half second of rest before each slow stroke, or NaN."""
    found = []
    for stroke in find_slow_stroke_rows(recording):
        begin = stroke.begin
        rest = np.arange(begin) >= _find_last_run(recording.phase[:begin] == "rest")
        rest &= recording.t_ns[:begin] >= recording.t_ns[begin] - REST_NS
        kpa = recording.kpa[:begin][rest]
        kpa = kpa[np.isfinite(kpa)]
        found.append(float(kpa.mean()) if len(kpa) >= BASELINE_READINGS_MIN else np.nan)
    return np.array(found)


def _find_last_run(rows: Bools) -> int:
    """Return the start of the run of True that reaches the end."""
    off = np.flatnonzero(~rows)
    return int(off[-1]) + 1 if len(off) else 0


def select_loaded(recordings: Sequence[Indentation]) -> list[Indentation]:
    """Return the recordings that load the tile; the others are only a soak."""
    return [recording for recording in recordings if recording.is_under_indenter.any()]


def extract_soak_or_empty(recording: Indentation, noise_kpa: float) -> ThermalSoak:
    """Return the thermal soak of a recording, without any load."""
    rows = recording.phase == "soak"
    return ThermalSoak(
        chip=recording.chip,
        t_s=(recording.t_ns[rows] - recording.t_ns[0]) * 1e-9,
        kpa=recording.kpa[rows],
        temperature_raw=recording.temperature_raw[rows],
        noise_kpa=noise_kpa,
    )


def format_origin(recording: Indentation) -> str:
    """Return file and tile, for messages."""
    return f"{recording.where}, tile {recording.serial}"


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
