"""Checks of a recording before its calibration; each error has a reason and a remedy.

Limits are stated here and in docs/method.md. They are wide: they reject wrong curves, not poor
tiles.

Creep lasts seconds, so a tile reads more between strokes than before the first one. It recovers by
itself, by an amount that follows from the loads before. A leaking dome reads less, a slipped tile
stays as it is, and warming continues: creep explains none of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from devices.arrays import Floats
from devices.errors import CalibrationError
from service.estimation.fitting.rig.indentation import (
    Indentation,
    Strokes,
    average_stroke_blocks,
    compute_rest_before_strokes_absolute_kpa,
    find_slow_stroke_rows,
    format_origin,
    measure_last_second_before_first_load,
)

_CREEP_S = np.array([0.3, 1.0, 3.0, 10.0])
"""Time constants of creep that outlast a rest or a stroke."""
_BLOCK_S = 0.5
_ALONE_S = 5.0
"""Least unloaded time for a recovery to show: half of the longest time constant."""
_STEADY_K = 1.0 / 5.35  # of the chip: a count of an MPL115A2, 0.06 kPa
_AHEAD_S = 3.0
"""Largest lead of a gas' temperature before its chip's."""


@dataclass(frozen=True)
class UnloadedRecovery:
    """Unloaded pressures above the first one, before each stroke and in the soak.

    Attributes:
        kpa: (n,).
        residual_kpa: (n,), residual after a fit of creep.
    """

    kpa: Floats
    residual_kpa: Floats


def fit_unloaded_recovery(recording: Indentation) -> UnloadedRecovery | None:
    """Fit creep to a tile's unloaded pressures; None if its steady soak is too short."""
    t_s = (recording.t_ns - recording.t_ns[0]) * 1e-9
    alone_s, alone_kpa = _extract_steady_soak(t_s, recording)
    if not len(alone_s) or np.ptp(alone_s) < _ALONE_S:
        return None
    begins_s = t_s[[stroke.begin for stroke in find_slow_stroke_rows(recording)]]
    at_s = np.append(begins_s, alone_s)
    kpa = np.append(compute_rest_before_strokes_absolute_kpa(recording), alone_kpa)
    known = np.isfinite(kpa)
    at_s, above_kpa = at_s[known], kpa[known] - kpa[known][0]
    crept = _compute_crept_forces(t_s, recording, at_s)
    parts, _ = nnls(crept, above_kpa)
    return UnloadedRecovery(above_kpa, above_kpa - crept @ parts)


def _extract_steady_soak(t_s: Floats, recording: Indentation) -> tuple[Floats, Floats]:
    """Return instants and pressures of the soak, in blocks, before its temperature changes."""
    rows = (
        (recording.phase == "soak")
        & np.isfinite(recording.kpa)
        & np.isfinite(recording.temperature_raw)
    )
    if not rows.any():
        return np.zeros(0), np.zeros(0)
    _, block = np.unique((t_s[rows] // _BLOCK_S).astype(np.int64), return_inverse=True)
    size = np.bincount(block)
    at_s, kpa, temperature_raw = (
        np.bincount(block, values[rows]) / size
        for values in (t_s, recording.kpa, recording.temperature_raw)
    )
    steady_counts = _STEADY_K * abs(recording.chip.counts_per_kelvin)
    moved = np.abs(temperature_raw - temperature_raw[0]) > steady_counts
    steady = at_s < at_s[np.argmax(moved)] - _AHEAD_S if moved.any() else np.full(len(at_s), True)
    return at_s[steady], kpa[steady]


def _compute_crept_forces(t_s: Floats, recording: Indentation, at_s: Floats) -> Floats:
    """Compute the remaining crept force at instants (n,) for each time constant, (n, times)."""
    pressed = recording.is_under_indenter & np.isfinite(recording.reference_n)
    before = pressed & (np.arange(len(t_s)) < np.argmax(pressed & (recording.phase != "rest")))
    zero_n = float(recording.reference_n[before].mean()) if before.any() else 0.0
    # A reading stands for the time since the one before; times without readings do not count.
    step_s = np.diff(t_s, prepend=t_s[0])
    step_s[step_s > _BLOCK_S] = 0.0
    impulse = (step_s * (np.where(pressed, recording.reference_n, zero_n) - zero_n))[pressed]
    pressed_s = t_s[pressed]
    left = np.zeros((len(at_s), len(_CREEP_S)))
    for row, now_s in zip(left, at_s.tolist(), strict=True):  # all at once need too much memory
        stop = int(np.searchsorted(pressed_s, now_s))
        ago_s = now_s - pressed_s[:stop]
        row[:] = np.exp(-ago_s / _CREEP_S[:, None]) @ impulse[:stop] / _CREEP_S
    return left


LOAD_MIN_N = 1.0  # less is as good as no load on a tile of 30 N
LOAD_MIN_KPA = 3.0
"""Least range for a cubic: a fifth of the chip's range above a seal at 100 kPa, or 24 counts."""
REPEATS_MIN = 2  # one has to be predicted from the others
R2_MIN = 0.9
"""The paper has 0.9999 for the mean of four; four loadings with its scatter of 0.03 have 0.97 to
0.997 on the emulated test rig."""
GAIN_DEVIATION_MAX = 0.3
"""The paper's scatter between loadings is 0.03 of the output, some 0.05 of the force where the
curve is steep: six times that."""
DRIFT_MAX_KPA = 0.4
"""Largest drift from the second repeat on, when creep is complete: some 0.8 N."""
FIRST_DRIFT_MAX_KPA = 1.0
"""Largest drift from the first repeat, before which the dome was unloaded. Larger drifts pass if
they recover as creep does."""
_FLAT_PART = 0.01
"""Change of a saturated signal, at most this part of its range ..."""
_MOVING_PART = 0.15
"""... while the other signal changes by more than this part of its range."""
_FLAT_NOISE = 0.6  # of the noise of a reading: block means scatter by less
_RAIL_READINGS = 5  # fewer may be missing by chance


def reject_no_load_or_single_repeat(blocks: Strokes, where: str) -> None:
    """Reject no load, a load of the wrong sign, too small a range, or a single repeat.

    Raises:
        CalibrationError: one of these.
    """
    if not len(blocks.force_n):
        raise CalibrationError(
            "no reading of this tile while it was pressed",
            where=where,
            expected="pressures and reference forces in its strokes",
            remedy="Check that the spindle stands over this tile, and that it is plugged in where "
            "the scene says",
        )
    most_n, least_n = float(blocks.force_n.max()), float(blocks.force_n.min())
    most_kpa = float(blocks.gauge_kpa.max())
    if most_n < LOAD_MIN_N and least_n < -LOAD_MIN_N:
        raise CalibrationError(
            f"the reference falls to {least_n:.2f} N while the tile is pressed",
            where=where,
            expected="forces that rise with load",
            remedy="Turn the sign of n_per_v in the scene's [reference]",
        )
    if most_n < LOAD_MIN_N or most_kpa < LOAD_MIN_KPA:
        raise CalibrationError(
            f"the indentation never loads the tile: at most {most_n:.2f} N on the reference and "
            f"{most_kpa:.2f} kPa in the tile",
            where=where,
            expected=f"more than {LOAD_MIN_N} N and {LOAD_MIN_KPA} kPa",
            remedy="Check that the spindle stands over this tile and that the dome is sealed",
        )
    repeats = len(np.unique(blocks.repeat))
    if repeats < REPEATS_MIN:
        raise CalibrationError(
            f"{repeats} slow repeat",
            where=where,
            expected="at least two, so that one can be predicted from the others",
            remedy="Press four times, as the paper does, in one file or several",
        )


def reject_saturated_reference(recordings: Sequence[Indentation], blocks: Strokes) -> None:
    """Reject a reference sensor that saturates before the tile.

    Raises:
        CalibrationError: its readings stand still, or are missing, where pressure is highest.
    """
    where = format_origin(recordings[0])
    remedy = "Press less, or turn the amplifier's gain down"
    for each in blocks.split_by_repeat():
        rows = each.select_rows(each.loading)
        if not len(rows.force_n):
            continue
        top_n, full_kpa = float(rows.force_n.max()), float(np.ptp(rows.gauge_kpa))
        flat = rows.gauge_kpa[rows.force_n > top_n - _FLAT_PART / 2 * abs(top_n)]
        if np.ptp(flat) > _MOVING_PART * full_kpa:
            raise CalibrationError(
                f"the reference stands still at {top_n:.2f} N while the tile's pressure goes on "
                f"rising by {np.ptp(flat):.2f} kPa, in repeat {each.repeat[0] + 1}: it is "
                "saturated",
                where=where,
                remedy=remedy,
            )
    for recording in recordings:
        zero = measure_last_second_before_first_load(recording)
        silent = recording.is_under_indenter & np.isin(recording.phase, ("load", "unload"))
        silent &= np.isnan(recording.reference_n) & np.isfinite(recording.kpa)
        if silent.sum() < _RAIL_READINGS or not find_slow_stroke_rows(recording):
            continue
        above_kpa = float(np.median(recording.kpa[silent])) - zero.baseline_kpa
        own = average_stroke_blocks(recording)
        if above_kpa > own.gauge_kpa.max():
            raise CalibrationError(
                f"the reference has no reading above {own.force_n.max():.2f} N, "
                f"while the tile was pressed on to {above_kpa:.2f} kPa: it is saturated",
                where=format_origin(recording),
                remedy=remedy,
            )


class UnsaturatedStrokes(NamedTuple):
    """Blocks of strokes before the chip saturates."""

    blocks: Strokes
    does_saturate: bool
    """True if the chip saturates behind them."""


def select_before_saturation(
    recordings: Sequence[Indentation], blocks: Strokes, noise_kpa: float
) -> UnsaturatedStrokes:
    """Return the blocks before the chip saturates, if it does."""
    wrapped = any(
        bool(np.isinf(recording.kpa[stroke.begin : stroke.end]).any())
        for recording in recordings
        for stroke in find_slow_stroke_rows(recording)
    )
    limit_kpa = np.inf
    full_n = float(blocks.force_n.max())
    for each in blocks.split_by_repeat():
        rows = each.select_rows(each.loading)
        if not len(rows.force_n):
            continue
        top_kpa = float(rows.gauge_kpa.max())
        flat_kpa = top_kpa - max(_FLAT_PART * top_kpa, _FLAT_NOISE * noise_kpa)
        if np.ptp(rows.force_n[rows.gauge_kpa > flat_kpa]) > _MOVING_PART * full_n:
            limit_kpa = min(limit_kpa, flat_kpa)
    if np.isfinite(limit_kpa):
        return UnsaturatedStrokes(blocks.select_rows(blocks.gauge_kpa <= limit_kpa), True)
    return UnsaturatedStrokes(blocks, wrapped)


def check_baseline_drift_between_repeats_kpa(recordings: Sequence[Indentation]) -> float:
    """Check the unloaded pressure's drift; return its largest change from repeat 2 on.

    Raises:
        CalibrationError: it, or the change from the first repeat, is larger than the limit and than
            creep explains.
    """
    drift_kpa = 0.0
    for recording in recordings:
        all_kpa = compute_rest_before_strokes_absolute_kpa(recording)
        known = all_kpa[np.isfinite(all_kpa)]
        if len(known) < 2:
            continue
        later_kpa, whole_kpa = float(np.ptp(known[1:])), float(np.ptp(known))
        for change_kpa, limit_kpa in ((later_kpa, DRIFT_MAX_KPA), (whole_kpa, FIRST_DRIFT_MAX_KPA)):
            if change_kpa > limit_kpa:
                _reject_lasting_drift(recording, all_kpa, change_kpa)
        drift_kpa = max(drift_kpa, later_kpa)
    return drift_kpa


def _reject_lasting_drift(recording: Indentation, all_kpa: Floats, change_kpa: float) -> None:
    """Reject a drift that does not recover as creep does.

    Raises:
        CalibrationError: it does not recover.
    """
    settled = fit_unloaded_recovery(recording)
    left = ""
    if settled is not None:
        left_kpa = float(np.ptp(settled.residual_kpa))
        if left_kpa <= DRIFT_MAX_KPA:
            return
        left = f"; creep would leave {left_kpa:.2f} kPa of what it does then and afterwards"
    listed = ", ".join(f"{kpa:.2f}" for kpa in all_kpa)
    raise CalibrationError(
        f"the unloaded pressure drifts by {change_kpa:.2f} kPa between repeats "
        f"({listed} kPa before each){left}",
        where=format_origin(recording),
        expected=f"at most {DRIFT_MAX_KPA} kPa, {FIRST_DRIFT_MAX_KPA} from the first, or a soak in "
        "which it goes back",
        remedy="Let the tile reach the room's temperature, rest longer between repeats, and leave "
        "it alone for 15 s at the end; if it goes on falling, the dome leaks",
    )


def reject_contradictions(repeat_gains: Floats, where: str) -> None:
    """Reject repeats that contradict one another.

    Args:
        repeat_gains: force of each repeat over the curve's.
        where: file and tile.

    Raises:
        CalibrationError: a repeat is too far from the others.
    """
    off = repeat_gains / np.median(repeat_gains) - 1.0
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) > GAIN_DEVIATION_MAX:
        raise CalibrationError(
            f"repeats contradict one another: repeat {worst + 1} takes {100 * off[worst]:+.0f} % "
            "of the others' force for the same pressure",
            where=where,
            expected=f"within {100 * GAIN_DEVIATION_MAX:.0f} %, six times the paper's scatter",
            remedy="Look for a spindle off the dome's middle or a slipped tile, and press again",
        )


def reject_poor_fit(r2: float, where: str) -> None:
    """Reject a cubic that does not describe the readings.

    Raises:
        CalibrationError: R2 is below `R2_MIN`.
    """
    if not r2 >= R2_MIN:
        raise CalibrationError(
            f"the cubic explains only R2 = {r2:.4f} of the reference force",
            where=where,
            expected=f"at least {R2_MIN}",
            remedy="Plot the recording: tile and reference may not belong together in time, or "
            "the spindle stands over another tile",
        )
