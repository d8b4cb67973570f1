"""`denoise`: noise averaged away over as long as nothing happens.

Around every sample a line and a parabola are fitted to windows that grow, up to the look-ahead on
one side and `PAST_NS` on the other. The longest one is taken whose value still agrees with those of
all shorter ones (intersection of confidence intervals, Goldenshluger and Nemirovski 1997; Katkovnik
1999). A window never crosses a gap.
"""

from __future__ import annotations

import math

import numpy as np

from devices.arrays import Floats, Times
from service.estimation.compiled import compiled

PAST_NS = 250_000_000  # how far the longest window reaches back
REACHES = np.array([1, 2, 4, 8, 16, 32, 64, 128])
"""How far the windows reach to either side, in samples."""
AVERAGED_MAX = 2 * int(REACHES[-1]) + 2
"""Readings in the longest window, and one."""
AGREE = 1.0
"""In standard uncertainties: how far the value of a longer window may be from that of any shorter
one. A compromise between noise in quiet stance and lag at an impact."""
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
) -> tuple[Floats, Floats]:
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

    Returns:
        Values (stop - first, tiles), and their squared standard uncertainty in units of that of a
        single one: what is left of the noise, and what curvature within the window adds.
    """
    n, tiles = values.shape
    out = np.full((stop - first, tiles), math.nan)
    left = np.full((stop - first, tiles), math.nan)
    moments = np.empty(8)
    newest = oldest = first
    while oldest > 0 and frame_t_ns[oldest - 1] >= frame_t_ns[first] - past_ns:
        oldest -= 1
    for i in range(first, stop):
        newest = max(newest, i)
        while newest + 1 < n and frame_t_ns[newest + 1] <= frame_t_ns[i] + look_ns:
            newest += 1
        while frame_t_ns[oldest] < frame_t_ns[i] - past_ns:
            oldest += 1
        for j in range(tiles):
            if math.isnan(values[i, j]):
                continue
            sigma = sigmas[i, j]
            moments[:] = 0.0
            # Times relative to the instant asked for, in milliseconds.
            _add(moments, (t_ns[i, j] - at_ns[i, j]) * 1e-6, values[i, j])
            best = shorter = shortest = values[i, j]
            variance = shorter_variance = shortest_variance = 1.0
            least, most = best - agree * sigma, best + agree * sigma
            low = high = i
            straight, agrees = True, True
            for reach in reaches:
                before_low, before_high = low, high
                while low > max(oldest, i - reach) and run[low - 1] == run[i]:
                    low -= 1
                    if not math.isnan(values[low, j]):
                        _add(moments, (t_ns[low, j] - at_ns[i, j]) * 1e-6, values[low, j])
                while high < min(newest, i + reach) and run[high + 1] == run[i]:
                    high += 1
                    if not math.isnan(values[high, j]):
                        _add(moments, (t_ns[high, j] - at_ns[i, j]) * 1e-6, values[high, j])
                if low == before_low and high == before_high:
                    break
                accepted, remains = math.nan, 0.0
                for bent in (True, False):
                    if not bent and not straight:
                        break
                    value, of_noise = _parabola(moments) if bent else _line(moments)
                    if math.isnan(value):
                        continue
                    of_noise *= _left(noise_left[j], of_noise)
                    spread = agree * sigma * math.sqrt(of_noise)
                    if value - spread > most or value + spread < least:
                        straight = False
                        agrees = not bent
                        break
                    least, most = max(least, value - spread), min(most, value + spread)
                    accepted, remains = value, of_noise
                if not agrees:
                    break
                if not math.isnan(accepted) and remains < variance:
                    shortest, shortest_variance = shorter, shorter_variance
                    shorter, shorter_variance = best, variance
                    best, variance = accepted, remains
            # A window of half the length gives the same but for noise; if not, neither curve is a
            # good description of what happens here.
            if sigma > 0.0:
                off = ((best - shortest) / sigma) ** 2
                variance += max(0.0, off - (shortest_variance - variance))
            out[i - first, j], left[i - first, j] = best, variance
    return out, left


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
