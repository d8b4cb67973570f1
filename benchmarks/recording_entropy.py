"""How few bytes a frame could take: the length of a code that could really be written and read.

Each flat column is predicted, value by value, from what a reader would have by then, and what the
prediction leaves is coded alone, as if independent. Predictors that are tried, the best is taken:
none, the value before, and a linear one, fitted by least squares to the whole column, of the 16
values before, of the same quantity of the tile before, and of the time step. Time stamps are
predicted by their steps. Its coefficients count with 32 bits each.

A residual is told by the class of its size, with 0 to 8 leading bits exact, and the bits below as
they are. Classes are coded adaptively (Krichevsky and Trofimov), so what must be learnt of their
frequencies is counted too. It is a bound from above: a coder that knew more, of the noise or of the
foot, could do with less.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import gammaln

from devices.arrays import Ints
from devices.frames import FRAME_COLUMNS, FrameBatch

TAPS = 16
_COEFFICIENT_BITS = 32
_EXACT_BITS_MAX = 8
TIMES = ("seq", "t_mono_ns", "t_ns", "sample_offset_us", "servo_age_us")
"""When it was, as against what was measured."""


def bytes_per_frame(frames: FrameBatch) -> dict[str, float]:
    """The bound, by quantity."""
    step_ns = np.diff(frames.t_mono_ns, prepend=frames.t_mono_ns[0])
    bits: dict[str, float] = {}
    for name in FRAME_COLUMNS:
        values = getattr(frames, name)
        if np.issubdtype(values.dtype, np.floating):
            values = values.view(np.int32)
        if name == "t_ns":  # the stream's one anchor
            values = (frames.t_ns - frames.t_mono_ns).astype(np.int64)
        if name == "t_mono_ns":
            values = step_ns
        columns = values.reshape(len(frames), -1).astype(np.int64).T
        for tile, column in enumerate(columns):
            beside = [step_ns] if name != "t_mono_ns" else []
            if tile:
                beside.append(columns[tile - 1])
            found = min(code_bits(r) + cost for r, cost in _residuals(column, beside))
            bits[name] = bits.get(name, 0.0) + found
    return {name: total / 8 / len(frames) for name, total in bits.items()}


def code_bits(residuals: Ints) -> float:
    """How many bits these numbers take, each on its own."""
    sign = residuals < 0
    size = np.abs(residuals).astype(np.uint64)
    length = np.frexp(size.astype(np.float64))[1].astype(np.int64)  # of the number in binary
    best = np.inf
    for exact in range(_EXACT_BITS_MAX + 1):
        raw = np.maximum(length - exact, 0)
        kept = (size >> raw.astype(np.uint64)).astype(np.int64)
        classes = 2 * ((raw << exact) + kept) + sign
        counts = np.bincount(classes - classes.min())
        best = min(best, _adaptive_bits(counts) + float(raw.sum()))
    return best


def _adaptive_bits(counts: Ints) -> float:
    """Length of the adaptive code of Krichevsky and Trofimov; the order does not matter to it."""
    kinds, n = len(counts), int(counts.sum())
    if kinds == 1:
        return 0.0
    nats = gammaln(n + kinds / 2) - gammaln(kinds / 2)
    nats -= float(np.sum(gammaln(counts + 0.5) - gammaln(0.5)))
    return float(nats / np.log(2))


def _residuals(values: Ints, beside: list[Ints]) -> Iterator[tuple[Ints, float]]:
    """What predictors leave, and the bits that their coefficients cost."""
    before = np.concatenate([[0], values[:-1]])
    yield values, 0.0
    yield values - before, 0.0
    if len(values) <= 4 * TAPS or values.min() == values.max():
        return
    centre = int(np.rint(values.mean()))
    past = np.zeros((len(values), TAPS))
    for tap in range(TAPS):
        past[tap + 1 :, tap] = values[: -tap - 1] - centre
    known = np.column_stack([past, *(b - b.mean() for b in beside), np.ones(len(values))])
    scale = np.maximum(np.abs(known).max(axis=0), 1.0)
    known /= scale
    weights, *_ = np.linalg.lstsq(known.T @ known, known.T @ (values - centre), rcond=None)
    predicted = np.rint(known @ weights).astype(np.int64) + centre
    yield values - predicted, float(_COEFFICIENT_BITS * known.shape[1])
