"""Recovery of the unloaded pressure between strokes in the rig, by creep of the rubber.

Creep lasts seconds, so a tile reads more between strokes than before the first one. It recovers by
itself, by an amount that follows from the loads before. A leaking dome reads less, a slipped tile
stays as it is, and warming continues: creep explains none of these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from devices.arrays import Floats
from service.estimation.fitting.rig.indentation import (
    Indentation,
    compute_rest_before_strokes_kpa,
    find_slow_stroke_rows,
)

_CREEP_S = np.array([0.3, 1.0, 3.0, 10.0])
"""Time constants of creep that outlast a rest or a stroke."""
_BLOCK_S = 0.5
_ALONE_S = 5.0
"""Least unloaded time for a recovery to show: half of the longest time constant."""
_STEADY_COUNTS = 1.0  # of the chip's temperature: 0.2 K, 0.06 kPa
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
    kpa = np.append(compute_rest_before_strokes_kpa(recording), alone_kpa)
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
    moved = np.abs(temperature_raw - temperature_raw[0]) > _STEADY_COUNTS
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
