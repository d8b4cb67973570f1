"""`denoise`: noise averaged away over as long as nothing happens.

Around every sample a line and a parabola are fitted to windows that grow, up to the look-ahead on
one side and `PAST_NS` on the other. Each side grows by itself, until what it brings does not agree
with all shorter windows: beside a contact the window goes on growing on the side away from it. The
value with the least noise is taken (Lepski's method; Goldenshluger and Nemirovski 1997). Two
windows, one within the other, agree if their values differ by no more than what the longer one
averages away would explain. A window never crosses a gap.
"""

from __future__ import annotations

import math

import numpy as np

from devices.arrays import Floats, Ints, Times
from devices.compiled import compiled, inlined
from service.estimation.records import Records

PAST_NS = 250_000_000  # how far the longest window reaches back
REACHES = np.array([1, 2, 4, 8, 16, 32, 64, 128])
"""How far the windows reach to either side, in samples."""
AVERAGED_MAX = 2 * int(REACHES[-1]) + 2
"""Readings in the longest window, and one."""
AGREE = 2.25
"""How far the values of two windows may be apart, in standard uncertainties of their difference:
chance makes it more in one of forty. A compromise between noise in quiet stance and lag at an
impact."""
SAME = 1e-6
"""Of a variance: a longer window that averages less than that away is the same but for rounding."""
SINGULAR = 1e-5
"""A determinant so small, relative to its first term, says that samples lie too close together for
such a curve, as at two instants a parabola; for windows of equal steps it is a hundred times more.
"""


Rows = tuple[int, int, int, int]
"""That a window reaches: of a line the first and the last, and of a parabola."""
ANYWHERE: Rows = (0, 1 << 62, 0, 1 << 62)
"""Windows may reach all rows."""
Columns = tuple[Floats, Floats, Times, Ints]
"""Values (n, columns), NaN where there is none; standard deviations of single ones, and instants of
the samples, both likewise; and (n,) the number of the unbroken run that a frame belongs to."""
Scratch = tuple[Floats, Floats, Floats]
"""Room that `averaged` works in, from `scratch_of_windows`: of all windows so far the values, their
variances, and 1 for a parabola."""
KEPT_MAX = 4 * len(REACHES) + 1
Moments = tuple[float, float, float, float, float, float, float, float]
"""Of samples: how many, sums of the first four powers of their times, of their values, and of these
times time and its square. Eight numbers that stay in registers."""


@compiled
def scratch_of_windows() -> Scratch:
    """Room that `averaged` works in."""
    return np.empty(KEPT_MAX), np.empty(KEPT_MAX), np.empty(KEPT_MAX)


@inlined
def in_sight(
    frame_t_ns: Times, i: int, first: int, end: int, rows: tuple[int, int], look_ns: int
) -> tuple[int, int]:
    """Oldest and newest row that windows of row `i` may reach.

    Args:
        frame_t_ns: instants of all rows.
        i: row.
        first: first row that is there.
        end: row after the last that is there.
        rows: what this gave for the row before, or any row twice.
        look_ns: look-ahead; all frames within it are there, or will never come.
    """
    oldest, newest = rows
    while oldest > first and frame_t_ns[oldest - 1] >= frame_t_ns[i] - PAST_NS:
        oldest -= 1
    while frame_t_ns[oldest] < frame_t_ns[i] - PAST_NS:
        oldest += 1
    newest = max(newest, i)
    while newest + 1 < end and frame_t_ns[newest + 1] <= frame_t_ns[i] + look_ns:
        newest += 1
    return oldest, newest


@compiled
def averaged(
    columns: Columns,
    i: int,
    j: int,
    at_ns: int,
    rows: tuple[int, int],
    noise_left: Floats,
    within: Rows,
    scratch: Scratch,
) -> tuple[tuple[float, float, float, float], Rows]:
    """Averaged value of row `i`, column `j`, where there is one.

    Args:
        columns: what is averaged.
        i: row.
        j: column.
        at_ns: instant that is asked for.
        rows: oldest and newest that windows may reach, from `in_sight`.
        noise_left: (`AVERAGED_MAX` + 1,), how much more of the noise's variance is left of an
            average of so many readings than of white noise.
        within: rows that windows may reach: `ANYWHERE`, or what those of the sum of tiles reached.
        scratch: from `scratch_of_windows`.

    Returns:
        The value, and its squared standard uncertainty in units of that of a single one: what is
        left of the noise, and what curvature within the window adds. And how far it is from that of
        a window of half the length, with the variance that noise gives that, in the same units: for
        `shared_bend`. And the rows that the windows reached, as `within`.
    """
    values, sigmas, t_ns, run = columns
    oldest, newest = rows
    sigma = sigmas[i, j]
    # Times relative to the instant asked for, in milliseconds.
    kept_values, kept_variances, kept_bent = scratch
    line_low, line_high, bent_low, bent_high = within
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    moments = _added(nothing, (t_ns[i, j] - at_ns) * 1e-6, values[i, j])
    best = shorter = shortest = values[i, j]
    variance = shorter_variance = shortest_variance = 1.0
    kept_values[0], kept_variances[0], kept_bent[0] = best, variance, 1.0
    stored = 1
    low = high = straight_low = straight_high = i
    open_low = open_high = straight = True
    for reach in REACHES:
        before, before_variance = best, variance
        for ahead in (False, True):
            if not (open_high if ahead else open_low):
                continue
            way, edge = (1, high) if ahead else (-1, low)
            reached = min(newest, i + reach, bent_high), max(oldest, i - reach, bent_low)
            end = reached[0] if ahead else reached[1]
            trial, at = moments, edge
            while at != end and run[at + way] == run[i]:
                at += way
                if not math.isnan(values[at, j]):
                    trial = _added(trial, (t_ns[at, j] - at_ns) * 1e-6, values[at, j])
            if at == edge:
                continue
            accepted, remains = math.nan, 0.0
            agrees = True
            if ahead:
                is_beyond = low < line_low or at > line_high
            else:
                is_beyond = at < line_low or high > line_high
            for bent in (True, False):
                if not bent and (not straight or is_beyond):
                    break
                value, of_noise = _parabola(trial) if bent else _line(trial)
                if math.isnan(value):
                    continue
                of_noise *= _left(noise_left, of_noise)
                if not _agree(scratch, stored, value, of_noise, bent, (AGREE * sigma) ** 2):
                    agrees = not bent
                    straight = False
                    break
                kept_values[stored], kept_variances[stored] = value, of_noise
                kept_bent[stored] = 1.0 if bent else 0.0
                stored += 1
                accepted, remains = value, of_noise
            if not agrees:
                if ahead:
                    open_high = False
                else:
                    open_low = False
                continue
            moments = trial
            if ahead:
                high = at
            else:
                low = at
            if straight:
                straight_low, straight_high = low, high
            if not math.isnan(accepted) and remains < (1.0 - SAME) * variance:
                best, variance = accepted, remains
        if variance < before_variance:
            shortest, shortest_variance = shorter, shorter_variance
            shorter, shorter_variance = before, before_variance
        if not open_low and not open_high:
            break
    # A window of half the length gives the same but for noise; if not, neither curve is a
    # good description of what happens here.
    bend, of_bend = best - shortest, shortest_variance - variance
    if sigma > 0.0:
        variance += max(0.0, (bend / sigma) ** 2 - of_bend)
    return (best, variance, bend, of_bend), (straight_low, straight_high, low, high)


@inlined
def share_bend(tiles: Records) -> None:
    """What of the tiles' bends is more than noise in their sum, signed, into `smoothed_n`.

    Tiles bear the same load: what a window smooths away of it, it does in all of them, to the same
    side. One tile does not show that above its noise; their sum may.

    Args:
        tiles: records with `bend_n`, how far averages are from those of shorter windows, NaN: there
            is none; `of_bend_n`, the standard deviation that noise gives that; and `smoothed_n`.
    """
    total, variance = 0.0, 0.0
    for j in range(len(tiles)):
        if not math.isnan(tiles[j].bend_n):
            total += tiles[j].bend_n
            variance += tiles[j].of_bend_n * tiles[j].of_bend_n
    part = 0.0
    if total * total > AGREE * AGREE * variance:
        part = math.sqrt(1.0 - variance / (total * total))
    for j in range(len(tiles)):
        known = not math.isnan(tiles[j].bend_n)
        tiles[j].smoothed_n = part * tiles[j].bend_n if known else 0.0


@inlined
def _agree(
    kept: Scratch, stored: int, value: float, of_noise: float, bent: bool, most: float
) -> bool:
    """Does a window's value agree with the first `stored` of shorter ones?

    A shorter line is not a part of a longer parabola: their noise is taken for independent.
    """
    values, variances, were_bent = kept
    apart = 0
    for m in range(stored):  # all of them, several at a time: to stop at one would cost more
        difference, variance = value - values[m], variances[m]
        within = max(variance - of_noise, SAME * variance)
        of_difference = variance + of_noise if bent and were_bent[m] == 0.0 else within
        apart += difference * difference > most * of_difference
    return apart == 0


@compiled
def _left(by_readings: Floats, of_noise: float) -> float:
    """Of a curve's value, which is as uncertain as a mean of so many readings."""
    readings = min(1.0 / of_noise, len(by_readings) - 1.5)
    whole = int(readings)
    below: float = by_readings[whole]
    above: float = by_readings[whole + 1]
    return below + (readings - whole) * (above - below)


@inlined
def _added(m: Moments, time: float, value: float) -> Moments:
    square = time * time
    return (
        m[0] + 1.0,
        m[1] + time,
        m[2] + square,
        m[3] + square * time,
        m[4] + square * square,
        m[5] + value,
        m[6] + time * value,
        m[7] + square * value,
    )


@compiled
def _line(m: Moments) -> tuple[float, float]:
    """Value of the fitted line at time 0, and its variance in units of a sample's."""
    det = m[0] * m[2] - m[1] * m[1]
    if m[0] < 3.0 or det <= SINGULAR * m[0] * m[2]:
        return math.nan, 0.0
    return (m[2] * m[5] - m[1] * m[6]) / det, m[2] / det


@compiled
def _parabola(m: Moments) -> tuple[float, float]:
    """Likewise of the fitted parabola, by the cofactors of its normal equations."""
    a0, a1, a2 = m[2] * m[4] - m[3] * m[3], m[2] * m[3] - m[1] * m[4], m[1] * m[3] - m[2] * m[2]
    det = m[0] * a0 + m[1] * a1 + m[2] * a2
    if m[0] < 4.0 or det <= SINGULAR * m[0] * m[2] * m[4]:
        return math.nan, 0.0
    return (a0 * m[5] + a1 * m[6] + a2 * m[7]) / det, a0 / det
