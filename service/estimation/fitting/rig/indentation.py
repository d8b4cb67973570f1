"""Indentation recording of one tile, and block averages along its slow strokes.

Readings are averaged in short blocks of a stroke: noise of single readings is an error of the
independent variable, and would flatten the fitted curve. A stroke is a `load` directly followed by
an `unload`; holds, releases and taps are for the models of fast effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from devices.arrays import ArrayRecord, Bools, Floats, Ints, Times
from devices.chips.pressure_chip import PressureChip
from devices.errors import CalibrationError

BLOCKS_PER_STROKE = 60  # many for a cubic, and each averages many readings
BASELINE_NS = 1_000_000_000  # before the first press
BASELINE_READINGS_MIN = 10  # fewer do not determine the noise
REST_NS = 500_000_000  # last part of a rest, when the rubber has recovered most


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
