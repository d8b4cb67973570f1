"""`denoise`: white noise averaged away over as long as nothing happens.

Around every sample a straight line is fitted to windows that grow, up to the look-ahead on one side
and `PAST_NS` on the other. The longest one is taken whose value still agrees with those of all
shorter ones (intersection of confidence intervals, Goldenshluger and Nemirovski 1997; Katkovnik
1999). A window never crosses a gap.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from service.estimation.compiled import compiled

Floats = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

PAST_NS = 250_000_000
REACHES = np.array([1, 2, 3, 4, 6, 8, 11, 16, 22, 32, 45, 64, 90, 128])
"""How far the windows reach to either side, in samples."""
AGREE = 2.0
"""In standard uncertainties: how far the value of a longer window may be from that of any shorter
one. A compromise between noise in quiet stance and lag at an impact."""


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

    Returns:
        Values (stop - first, tiles), and their squared standard uncertainty in units of that of a
        single one: what is left of the noise, and what curvature within the window adds.
    """
    n, tiles = values.shape
    out = np.full((stop - first, tiles), math.nan)
    left = np.full((stop - first, tiles), math.nan)
    newest = first
    oldest = first
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
            low, high = i, i
            sigma = sigmas[i, j]
            # Times relative to the instant asked for, in milliseconds.
            time = (t_ns[i, j] - at_ns[i, j]) * 1e-6
            s0, s1, s2, y0, y1 = 1.0, time, time * time, values[i, j], time * values[i, j]
            best, variance = values[i, j], 1.0
            shorter, shorter_variance = best, variance
            shortest, shortest_variance = best, variance
            least, most = best - agree * sigma, best + agree * sigma
            for reach in reaches:
                grown = False
                while low > oldest and low > i - reach and run[low - 1] == run[i]:
                    low -= 1
                    value = values[low, j]
                    grown = True
                    if not math.isnan(value):
                        time = (t_ns[low, j] - at_ns[i, j]) * 1e-6
                        s0 += 1.0
                        s1 += time
                        s2 += time * time
                        y0 += value
                        y1 += time * value
                while high < newest and high < i + reach and run[high + 1] == run[i]:
                    high += 1
                    value = values[high, j]
                    grown = True
                    if not math.isnan(value):
                        time = (t_ns[high, j] - at_ns[i, j]) * 1e-6
                        s0 += 1.0
                        s1 += time
                        s2 += time * time
                        y0 += value
                        y1 += time * value
                if not grown:
                    break
                det = s0 * s2 - s1 * s1
                if s0 < 3.0 or det <= 0.0:
                    continue
                value = (s2 * y0 - s1 * y1) / det
                remains = s2 / det
                spread = agree * sigma * math.sqrt(remains)
                least, most = max(least, value - spread), min(most, value + spread)
                if least > most:
                    break
                if remains < variance:
                    shortest, shortest_variance = shorter, shorter_variance
                    shorter, shorter_variance = best, variance
                    best, variance = value, remains
            # A window of half the length gives the same but for noise; if not, a line is no good
            # description of what happens here.
            if sigma > 0.0:
                bent = ((best - shortest) / sigma) ** 2 - (shortest_variance - variance)
                variance += max(0.0, bent)
            out[i - first, j], left[i - first, j] = best, variance
    return out, left
