"""`denoise`: noise averaged over the longest window in which nothing happens.

Around every sample a line and a parabola are fitted to windows that grow, up to the look-ahead on
one side and `PAST_NS` on the other. Each side grows by itself until its value disagrees with a
shorter window: beside a contact the window goes on growing on the side away from it. The value with
the least variance is used (Lepski's method; Goldenshluger and Nemirovski 1997). Two windows, one
within the other, agree if the noise that the longer one averages away explains their difference. A
window never crosses a gap.

See hardware.md 1.3. Part of the model `denoise`, before every model with a state. A reading is an
outlier if it lies far from the mean of its two neighbours, which lie near each other; that mean
replaces it. It needs the next reading, so frames wait for one more.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from devices.arrays import Bools, Floats, Ints, Times
from devices.jit import jit_cached, jit_inlined
from service.estimation.records import RecordArray

PAST_NS = 250_000_000  # reach of the longest window into the past
WINDOW_REACHES = np.array([1, 2, 4, 8, 16, 32, 64, 128])
"""Reaches of the windows to either side, in samples."""
WINDOW_READINGS_MAX = 2 * int(WINDOW_REACHES[-1]) + 2
"""Number of readings in the longest window, plus one."""
AGREEMENT_SIGMAS = 2.25
"""Largest difference of two windows' values, in standard uncertainties; chance exceeds it in one of
forty. A compromise between noise in quiet stance and lag at an impact."""
MOVE_SIGMAS = 10.0
"""Change of a reading between its own instant and the frame's, in its standard deviations, from
which noise does not hide it."""
VARIANCE_REDUCTION_MIN = 1e-6
"""Relative reduction of variance below which a longer window differs by rounding only."""
DETERMINANT_MIN = 1e-5
"""Relative determinant below which samples lie too close together for the curve, as two instants
for a parabola; windows of equal steps have a hundred times more."""


WindowRows = tuple[int, int, int, int]
"""First and last row that the window of a line reaches, then those of a parabola."""
ALL_ROWS: WindowRows = (0, 1 << 62, 0, 1 << 62)
"""All rows."""
SampleColumns = tuple[Floats, Floats, Times, Ints]
"""Values (n, columns), NaN where there is none; standard deviation of each and its instant, both
(n, columns); and (n,) the number of the gapless run that a frame belongs to."""
SCRATCH_SHAPE = (3, 4 * len(WINDOW_REACHES) + 1)
"""Shape of the work array of `denoise_sample`: rows of values, of variances, and of ones for
parabolas; a column for each smaller window, at most so many."""
WindowMoments = tuple[float, float, float, float, float, float, float, float]
"""Sums over samples: their number, the first four powers of their times, their values, and these
times time and its square. Eight numbers that stay in registers."""


class WindowDifference(Protocol):
    """Record of a tile with the change of its average from a shorter window."""

    window_difference_n: float
    """Average less that of a window of half the length; NaN: there is none."""
    window_difference_sigma_n: float
    """Standard deviation of that difference by noise."""
    smoothing_error_n: float
    """Load that averaging removes, estimated."""


@jit_inlined
def find_oldest_and_newest_window_rows(
    frame_t_ns: Times,
    i: int,
    end: int,
    previous_rows: tuple[int, int],
    lookahead_ns: int,
) -> tuple[int, int]:
    """Return the oldest and the newest row that windows of row `i` may reach.

    Args:
        frame_t_ns: instants of all rows.
        i: row.
        end: row after the last that is stored.
        previous_rows: answer for the row before, or any row twice.
        lookahead_ns: look-ahead; no more frames arrive within it.
    """
    oldest, newest = previous_rows
    while oldest > 0 and frame_t_ns[oldest - 1] >= frame_t_ns[i] - PAST_NS:
        oldest -= 1
    while frame_t_ns[oldest] < frame_t_ns[i] - PAST_NS:
        oldest += 1
    newest = max(newest, i)
    while newest + 1 < end and frame_t_ns[newest + 1] <= frame_t_ns[i] + lookahead_ns:
        newest += 1
    return oldest, newest


@jit_cached
def denoise_sample(
    columns: SampleColumns,
    i: int,
    j: int,
    at_ns: int,
    rows: tuple[int, int],
    variance_inflation: Floats,
    within: WindowRows,
    scratch: Floats,
) -> tuple[tuple[float, float, float, float], WindowRows]:
    """Denoise the value of row `i`, column `j`, which must exist.

    Args:
        columns: values with their noise, instants and runs.
        i: row.
        j: column.
        at_ns: instant at which the fitted curve is evaluated.
        rows: oldest and newest that windows may reach, from `find_oldest_and_newest_window_rows`.
        variance_inflation: (`WINDOW_READINGS_MAX` + 1,), variance of a mean of n readings over that
            of white noise.
        within: rows that windows may reach: `ALL_ROWS`, or those of the sum of tiles.
        scratch: (`SCRATCH_SHAPE`), overwritten.

    Returns:
        The value; its variance in units of that of a single value: remaining noise, and curvature
        within the window; its difference from a window of half the length; and the variance of
        that by noise, in the same units, for `estimate_smoothing_errors`. And the rows reached, as
        `within`.
    """
    values, sigmas, t_ns, run = columns
    oldest, newest = rows
    sigma = sigmas[i, j]
    # Times relative to `at_ns`, in milliseconds.
    kept_values, kept_variances, kept_bent = scratch[0], scratch[1], scratch[2]
    line_low, line_high, bent_low, bent_high = within
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    moments = _add_sample(nothing, (t_ns[i, j] - at_ns) * 1e-6, values[i, j])
    best = shorter = shortest = _move_along_line(columns, i, j, at_ns, rows)
    variance = shorter_variance = shortest_variance = 1.0
    kept_values[0], kept_variances[0], kept_bent[0] = best, variance, 1.0
    stored = 1
    low = high = straight_low = straight_high = i
    open_low = open_high = straight = True
    for reach in WINDOW_REACHES:
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
                    trial = _add_sample(trial, (t_ns[at, j] - at_ns) * 1e-6, values[at, j])
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
                value, of_noise = _fit_parabola(trial) if bent else _fit_line(trial)
                if math.isnan(value):
                    continue
                of_noise *= _interpolate_inflation(variance_inflation, of_noise)
                if not _is_in_agreement(
                    scratch, stored, value, of_noise, bent, (AGREEMENT_SIGMAS * sigma) ** 2
                ):
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
            if not math.isnan(accepted) and remains < (1.0 - VARIANCE_REDUCTION_MIN) * variance:
                best, variance = accepted, remains
        if variance < before_variance:
            shortest, shortest_variance = shorter, shorter_variance
            shorter, shorter_variance = before, before_variance
        if not open_low and not open_high:
            break
    # A window of half the length gives the same but for noise; if not, neither curve describes
    # the load here.
    bend, of_bend = best - shortest, shortest_variance - variance
    if sigma > 0.0:
        variance += max(0.0, (bend / sigma) ** 2 - of_bend)
    return (best, variance, bend, of_bend), (straight_low, straight_high, low, high)


@jit_cached
def _move_along_line(
    columns: SampleColumns, i: int, j: int, at_ns: int, rows: tuple[int, int]
) -> float:
    """Return a value at another instant, if the move exceeds its noise; else the value itself."""
    values, sigmas, t_ns, run = columns
    value: float = values[i, j]
    way = -1 if at_ns < t_ns[i, j] else 1
    k, at = i, i + way
    while rows[0] <= at <= rows[1] and run[at] == run[i] and way * (at_ns - t_ns[at, j]) > 0:
        k, at = at, at + way
    if at < rows[0] or at > rows[1] or run[at] != run[i] or t_ns[at, j] == t_ns[k, j]:
        return value
    part = float(at_ns - t_ns[k, j]) / float(t_ns[at, j] - t_ns[k, j])
    moved = values[k, j] + part * (values[at, j] - values[k, j])
    return moved if abs(moved - value) > MOVE_SIGMAS * sigmas[i, j] else value


@jit_inlined
def estimate_smoothing_errors(tiles: RecordArray[WindowDifference]) -> None:
    """Write the part of the tiles' window differences that exceeds noise into `smoothing_error_n`.

    Tiles bear the same load: a window smooths it in every tile, to the same side. The noise of one
    tile hides that; in their sum it may show.

    Args:
        tiles: differences of averages from those of shorter windows; updated.
    """
    total, variance = 0.0, 0.0
    for j in range(len(tiles)):
        if not math.isnan(tiles[j].window_difference_n):
            total += tiles[j].window_difference_n
            sigma_n = tiles[j].window_difference_sigma_n
            variance += sigma_n * sigma_n
    part = 0.0
    if total * total > AGREEMENT_SIGMAS * AGREEMENT_SIGMAS * variance:
        part = math.sqrt(1.0 - variance / (total * total))
    for j in range(len(tiles)):
        difference_n = tiles[j].window_difference_n
        tiles[j].smoothing_error_n = 0.0 if math.isnan(difference_n) else part * difference_n


@jit_inlined
def _is_in_agreement(
    kept: Floats, stored: int, value: float, of_noise: float, bent: bool, most: float
) -> bool:
    """Return whether a window's value agrees with the first `stored` of shorter ones.

    A shorter line is not a part of a longer parabola: their noise is treated as independent.
    """
    values, variances, were_bent = kept[0], kept[1], kept[2]
    apart = 0
    for m in range(stored):  # all of them, several at a time: to stop at one would cost more
        difference, variance = value - values[m], variances[m]
        within = max(variance - of_noise, VARIANCE_REDUCTION_MIN * variance)
        of_difference = variance + of_noise if bent and were_bent[m] == 0.0 else within
        apart += difference * difference > most * of_difference
    return apart == 0


@jit_cached
def _interpolate_inflation(variance_inflation: Floats, of_noise: float) -> float:
    """Interpolate the inflation for a curve's value, as uncertain as a mean of 1/of_noise."""
    readings = min(1.0 / of_noise, len(variance_inflation) - 1.5)
    whole = int(readings)
    below: float = variance_inflation[whole]
    above: float = variance_inflation[whole + 1]
    return below + (readings - whole) * (above - below)


@jit_inlined
def _add_sample(m: WindowMoments, time: float, value: float) -> WindowMoments:
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


@jit_cached
def _fit_line(m: WindowMoments) -> tuple[float, float]:
    """Return the fitted line at time 0, and its variance in units of a sample's."""
    det = m[0] * m[2] - m[1] * m[1]
    if m[0] < 3.0 or det <= DETERMINANT_MIN * m[0] * m[2]:
        return math.nan, 0.0
    return (m[2] * m[5] - m[1] * m[6]) / det, m[2] / det


@jit_cached
def _fit_parabola(m: WindowMoments) -> tuple[float, float]:
    """Return the fitted parabola at time 0, and its variance, by cofactors of its equations."""
    a0, a1, a2 = m[2] * m[4] - m[3] * m[3], m[2] * m[3] - m[1] * m[4], m[1] * m[3] - m[2] * m[2]
    det = m[0] * a0 + m[1] * a1 + m[2] * a2
    if m[0] < 4.0 or det <= DETERMINANT_MIN * m[0] * m[2] * m[4]:
        return math.nan, 0.0
    return (a0 * m[5] + a1 * m[6] + a2 * m[7]) / det, a0 / det


OUTLIER_SIGMAS = 3.0
"""In units of the noise that a reading has about the mean of two; one healthy reading in 600."""
_ABOUT_MEAN = math.sqrt(1.5)  # of a reading's own noise and that of a mean of two


def find_outliers(kpa: Floats, noise_kpa: Floats) -> Bools:
    """Return a mask of the outliers, (n, tiles); the first and the last row have none.

    Args:
        kpa: (n, tiles), NaN where there is none.
        noise_kpa: (tiles,), standard deviation of a reading.
    """
    found = np.zeros(kpa.shape, dtype=bool)
    _fill_outlier_mask(kpa, noise_kpa, found)
    return found


@jit_cached
def is_outlier(before: float, kpa: float, after: float, noise_kpa: float) -> bool:
    """Return whether a reading is an outlier between its neighbours; False beside a NaN."""
    off_kpa = abs(kpa - 0.5 * (before + after))
    return off_kpa > OUTLIER_SIGMAS * _ABOUT_MEAN * noise_kpa and abs(after - before) < off_kpa


@jit_cached
def _fill_outlier_mask(kpa: Floats, noise_kpa: Floats, found: Bools) -> None:
    n, tiles = kpa.shape
    for i in range(1, n - 1):
        for j in range(tiles):
            found[i, j] = is_outlier(kpa[i - 1, j], kpa[i, j], kpa[i + 1, j], noise_kpa[j])
