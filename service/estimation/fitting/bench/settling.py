"""Whether an unloaded pressure that has changed on the bench goes back as rubber does.

Rubber that creeps for seconds is not done when the next stroke begins: unloaded, the tile reads
more than before anything had pressed. That goes back by itself, and how much of it is left at any
time follows from the loads before. What leaks reads less, what has slipped stays as it is, and what
warms up goes on: no creep explains these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from devices.arrays import Floats
from service.estimation.fitting.bench.indentation import Indentation, rests, stroke_rows

_CREEP_S = np.array([0.3, 1.0, 3.0, 10.0])
"""Times of the creep that a rest or a stroke leaves something of."""
_BLOCK_S = 0.5
_ALONE_S = 5.0
"""Half of the longest time: so long nothing has to press for what goes back to be seen."""
_STEADY_COUNTS = 1.0  # of the chip's temperature: 0.2 K, 0.06 kPa
_AHEAD_S = 3.0
"""How long before its chip a gas may be warm."""


@dataclass(frozen=True)
class Settling:
    """Unloaded pressures above the first one: before each stroke, then while nothing pressed.

    Attributes:
        kpa: (n,).
        left_kpa: (n,), what creep does not explain of them.
    """

    kpa: Floats
    left_kpa: Floats


def settling(recording: Indentation) -> Settling | None:
    """How a tile's unloaded pressure settles; None if it is not left alone long enough to tell."""
    t_s = (recording.t_ns - recording.t_ns[0]) * 1e-9
    alone_s, alone_kpa = _alone(t_s, recording)
    if not len(alone_s) or np.ptp(alone_s) < _ALONE_S:
        return None
    begins_s = t_s[[begin for begin, _, _ in stroke_rows(recording)]]
    at_s = np.append(begins_s, alone_s)
    kpa = np.append(rests(recording), alone_kpa)
    known = np.isfinite(kpa)
    at_s, above_kpa = at_s[known], kpa[known] - kpa[known][0]
    crept = _crept(t_s, recording, at_s)
    parts, _ = nnls(crept, above_kpa)
    return Settling(above_kpa, above_kpa - crept @ parts)


def _alone(t_s: Floats, recording: Indentation) -> tuple[Floats, Floats]:
    """Instants and pressures of the soak, in blocks, before its temperature changes."""
    rows = (recording.phase == "soak") & np.isfinite(recording.kpa) & np.isfinite(recording.tadc)
    if not rows.any():
        return np.zeros(0), np.zeros(0)
    _, block = np.unique((t_s[rows] // _BLOCK_S).astype(np.int64), return_inverse=True)
    size = np.bincount(block)
    at_s, kpa, tadc = (
        np.bincount(block, values[rows]) / size for values in (t_s, recording.kpa, recording.tadc)
    )
    moved = np.abs(tadc - tadc[0]) > _STEADY_COUNTS
    steady = at_s < at_s[np.argmax(moved)] - _AHEAD_S if moved.any() else np.full(len(at_s), True)
    return at_s[steady], kpa[steady]


def _crept(t_s: Floats, recording: Indentation, at_s: Floats) -> Floats:
    """Force that is still felt at instants (n,) by rubber of each time, (n, times)."""
    pressed = recording.under_spindle & np.isfinite(recording.reference_n)
    before = pressed & (np.arange(len(t_s)) < np.argmax(pressed & (recording.phase != "rest")))
    zero_n = float(recording.reference_n[before].mean()) if before.any() else 0.0
    # A reading stands for the time to the one before it; none for a time in which nothing is read.
    step_s = np.diff(t_s, prepend=t_s[0])
    step_s[step_s > _BLOCK_S] = 0.0
    impulse = (step_s * (np.where(pressed, recording.reference_n, zero_n) - zero_n))[pressed]
    pressed_s = t_s[pressed]
    left = np.zeros((len(at_s), len(_CREEP_S)))
    for row, now_s in zip(left, at_s.tolist(), strict=True):  # of all at once, too much for memory
        stop = int(np.searchsorted(pressed_s, now_s))
        ago_s = now_s - pressed_s[:stop]
        row[:] = np.exp(-ago_s / _CREEP_S[:, None]) @ impulse[:stop] / _CREEP_S
    return left
