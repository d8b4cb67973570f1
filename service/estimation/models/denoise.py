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
from devices.compiled import compiled

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


@compiled
def denoised(
    values: Floats,
    sigmas: Floats,
    t_ns: Times,
    frame_t_ns: Times,
    at_ns: Times,
    run: Times,
    first: int,
    stop: int,
    look_ns: int,
    past_ns: int,
    reaches: Times,
    agree: float,
    noise_left: Floats,
    within: Ints,
) -> tuple[Floats, Floats, Floats, Floats, Ints]:
    """Averaged values of rows `first` to `stop`.

    Args:
        values: (n, tiles), NaN where there is none.
        sigmas: (n, tiles), standard deviation of a single one.
        t_ns: (n, tiles), instants of the samples.
        frame_t_ns: (n,), of the frames, which bound the windows.
        at_ns: (n, tiles), the instants that are asked for.
        run: (n,), number of the unbroken run that a frame belongs to.
        first: row.
        stop: row after the last.
        look_ns: look-ahead; all frames within it are there, or will never come.
        past_ns: how far a window may reach back.
        reaches: as `REACHES`.
        agree: as `AGREE`.
        noise_left: (tiles, `AVERAGED_MAX` + 1), how much more of the noise's variance is left of an
            average of so many readings than of white noise.
        within: (stop - first, 4), rows that a window may reach: of a line the first and the last,
            and of a parabola; `anywhere`, or what windows of the sum of tiles reached.

    Returns:
        Values (stop - first, tiles), and their squared standard uncertainty in units of that of a
        single one: what is left of the noise, and what curvature within the window adds. And how
        far they are from those of a window of half the length, with the variance that noise gives
        that, in the same units: for `shared_bend`. And the rows that the windows of the last tile
        reached, as `within`.
    """
    n, tiles = values.shape
    out = np.full((stop - first, tiles), math.nan)
    left = np.full((stop - first, tiles), math.nan)
    bend = np.full((stop - first, tiles), math.nan)
    of_bend = np.full((stop - first, tiles), math.nan)
    reached = np.empty((stop - first, 4), dtype=np.int64)
    moments, trial = np.empty(8), np.empty(8)
    kept = np.empty((4 * len(reaches) + 1, 3))
    newest = oldest = first
    while oldest > 0 and frame_t_ns[oldest - 1] >= frame_t_ns[first] - past_ns:
        oldest -= 1
    for i in range(first, stop):
        newest = max(newest, i)
        while newest + 1 < n and frame_t_ns[newest + 1] <= frame_t_ns[i] + look_ns:
            newest += 1
        while frame_t_ns[oldest] < frame_t_ns[i] - past_ns:
            oldest += 1
        line_low, line_high, bent_low, bent_high = within[i - first]
        for j in range(tiles):
            if math.isnan(values[i, j]):
                reached[i - first] = within[i - first]
                continue
            sigma = sigmas[i, j]
            # Times relative to the instant asked for, in milliseconds.
            moments[:] = 0.0
            _add(moments, (t_ns[i, j] - at_ns[i, j]) * 1e-6, values[i, j])
            best = shorter = shortest = values[i, j]
            variance = shorter_variance = shortest_variance = 1.0
            kept[0, 0], kept[0, 1], kept[0, 2] = best, variance, 1.0
            stored = 1
            low = high = straight_low = straight_high = i
            open_low = open_high = straight = True
            for reach in reaches:
                before, before_variance = best, variance
                for ahead in (False, True):
                    if not (open_high if ahead else open_low):
                        continue
                    way, edge = (1, high) if ahead else (-1, low)
                    if ahead:
                        end = min(newest, i + reach, bent_high)
                    else:
                        end = max(oldest, i - reach, bent_low)
                    trial[:] = moments
                    at = edge
                    while at != end and run[at + way] == run[i]:
                        at += way
                        if not math.isnan(values[at, j]):
                            _add(trial, (t_ns[at, j] - at_ns[i, j]) * 1e-6, values[at, j])
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
                        of_noise *= _left(noise_left[j], of_noise)
                        if not _agree(kept, stored, value, of_noise, bent, (agree * sigma) ** 2):
                            agrees = not bent
                            straight = False
                            break
                        kept[stored, 0], kept[stored, 1], kept[stored, 2] = value, of_noise, bent
                        stored += 1
                        accepted, remains = value, of_noise
                    if not agrees:
                        if ahead:
                            open_high = False
                        else:
                            open_low = False
                        continue
                    moments[:] = trial
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
            bend[i - first, j] = best - shortest
            of_bend[i - first, j] = shortest_variance - variance
            if sigma > 0.0:
                off = ((best - shortest) / sigma) ** 2
                variance += max(0.0, off - (shortest_variance - variance))
            out[i - first, j], left[i - first, j] = best, variance
            reached[i - first, 0], reached[i - first, 1] = straight_low, straight_high
            reached[i - first, 2], reached[i - first, 3] = low, high
    return out, left, bend, of_bend, reached


def anywhere(rows: int, n: int) -> Ints:
    """`within` of so many rows if windows may reach all of n."""
    return np.tile(np.array([0, n - 1, 0, n - 1]), (rows, 1))


@compiled
def shared_bend(bend_n: Floats, noise_n: Floats) -> Floats:
    """What of the tiles' bends is more than noise in their sum, (n, tiles), signed.

    Tiles bear the same load: what a window smooths away of it, it does in all of them, to the same
    side. One tile does not show that above its noise; their sum may.

    Args:
        bend_n: (n, tiles), how far averages are from those of shorter windows; NaN: there is none.
        noise_n: standard deviations that noise gives that.
    """
    n, tiles = bend_n.shape
    out = np.zeros((n, tiles))
    for i in range(n):
        total, variance = 0.0, 0.0
        for j in range(tiles):
            if not math.isnan(bend_n[i, j]):
                total += bend_n[i, j]
                variance += noise_n[i, j] * noise_n[i, j]
        if total * total > AGREE * AGREE * variance:
            part = math.sqrt(1.0 - variance / (total * total))
            for j in range(tiles):
                if not math.isnan(bend_n[i, j]):
                    out[i, j] = part * bend_n[i, j]
    return out


@compiled
def _agree(
    kept: Floats, stored: int, value: float, of_noise: float, bent: bool, most: float
) -> bool:
    """Does a window's value agree with the first `stored` of shorter ones, value, variance, bent?

    A shorter line is not a part of a longer parabola: their noise is taken for independent.
    """
    for m in range(stored):
        apart = value - kept[m, 0]
        if kept[m, 2] > 0.0 or not bent:
            of_difference = max(kept[m, 1] - of_noise, SAME * kept[m, 1])
        else:
            of_difference = kept[m, 1] + of_noise
        if apart * apart > most * of_difference:
            return False
    return True


@compiled
def _left(by_readings: Floats, of_noise: float) -> float:
    """Of a curve's value, which is as uncertain as a mean of so many readings."""
    readings = min(1.0 / of_noise, len(by_readings) - 1.5)
    whole = int(readings)
    below: float = by_readings[whole]
    above: float = by_readings[whole + 1]
    return below + (readings - whole) * (above - below)


@compiled
def _add(moments: Floats, time: float, value: float) -> None:
    square = time * time
    moments[0] += 1.0
    moments[1] += time
    moments[2] += square
    moments[3] += square * time
    moments[4] += square * square
    moments[5] += value
    moments[6] += time * value
    moments[7] += square * value


@compiled
def _line(m: Floats) -> tuple[float, float]:
    """Value of the fitted line at time 0, and its variance in units of a sample's."""
    det = m[0] * m[2] - m[1] * m[1]
    if m[0] < 3.0 or det <= SINGULAR * m[0] * m[2]:
        return math.nan, 0.0
    return (m[2] * m[5] - m[1] * m[6]) / det, m[2] / det


@compiled
def _parabola(m: Floats) -> tuple[float, float]:
    """Likewise of the fitted parabola, by the cofactors of its normal equations."""
    a0, a1, a2 = m[2] * m[4] - m[3] * m[3], m[2] * m[3] - m[1] * m[4], m[1] * m[3] - m[2] * m[2]
    det = m[0] * a0 + m[1] * a1 + m[2] * a2
    if m[0] < 4.0 or det <= SINGULAR * m[0] * m[2] * m[4]:
        return math.nan, 0.0
    return (a0 * m[5] + a1 * m[6] + a2 * m[7]) / det, a0 / det
