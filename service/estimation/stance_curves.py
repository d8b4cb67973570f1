"""Curves of stances: time-normalized overlay, and a peak without the bias of noisy frames.

The only definition of this normalization. A stance lasts from its first frame to its last
(`service.estimation.stances`). A value between two frames lies on the straight line between them,
and is NaN if either frame is, or if frames are missing between them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Columns, Floats, Ints, Times
from devices.flags import EstimateFlag

OVERLAY_COLUMNS = ("grf_n", "cop_x_m", "cop_y_m")
"""Columns of estimates in the overlay."""


@dataclass(frozen=True)
class CurveStatistics:
    """Statistics of one quantity over all stances, (points,) each.

    Attributes:
        mean: over the stances with a value; NaN without any.
        sd: sample standard deviation over these; NaN for fewer than two.
        count: number of these stances.
    """

    mean: Floats
    sd: Floats
    count: Ints


@dataclass(frozen=True)
class Overlay:
    """Overlay of stances.

    Attributes:
        statistics: statistics by column.
        rows: (k,), indices of the stances with single curves.
        curves: by column, (k, points), these curves.
    """

    statistics: Mapping[str, CurveStatistics]
    rows: Ints
    curves: Mapping[str, Floats]


def select_evenly(count: int, max_count: int) -> Ints:
    """Return at most `max_count` of `count` indices: first, last, and evenly in between."""
    if count <= max_count:
        return np.arange(count)
    return np.round(np.linspace(0, count - 1, max_count)).astype(np.int64)


def resample_stance(t_ns: Times, values: Floats, is_after_gap: Bools, points: int) -> Floats:
    """Resample one stance at `points` percentages from 0 to 100, (points, ...).

    Args:
        t_ns: (n,), instants of its frames, rising, n of 2 or more.
        values: (n, ...), in these frames.
        is_after_gap: (n,), whether frames are missing before each.
        points: number of points, 2 or more.
    """
    share = (t_ns - t_ns[0]) / float(t_ns[-1] - t_ns[0])
    at = np.linspace(0.0, 1.0, points)
    behind = np.clip(np.searchsorted(share, at), 1, len(share) - 1)
    before = behind - 1
    wide = (slice(None), *(None,) * (values.ndim - 1))
    part = ((at - share[before]) / (share[behind] - share[before]))[wide]
    low, high = values[before], np.array(values[behind])
    is_between = is_after_gap[behind] & (part.reshape(-1) < 1.0)
    # Exactly at a frame its value counts, even beside a NaN.
    high[is_between] = np.nan
    between = np.where(part >= 1.0, high, low + (high - low) * part)
    return np.asarray(np.where(part <= 0.0, low, between))


class StanceOverlayBuilder:
    """Accumulator of stances from consecutive frames; the result does not depend on the batches.

    It stores sums, and the curves of some stances: its memory does not grow with their number.
    """

    def __init__(
        self,
        part: npt.NDArray[Any],
        begin_t_ns: Times,
        end_t_ns: Times,
        *,
        points: int,
        rows: Collection[int],
    ) -> None:
        """Set the stances and the points.

        Args:
            part: (m,), part of each stance, in the order of the frames.
            begin_t_ns: (m,), instant of its first frame.
            end_t_ns: (m,), instant of its last frame, later than the first.
            points: number of percentages from 0 to 100, both included.
            rows: indices of the stances with single curves.
        """
        self._windows = list(
            zip(part.tolist(), begin_t_ns.tolist(), end_t_ns.tolist(), strict=True)
        )
        self._next = 0
        self._open: list[tuple[Times, Floats, Bools]] = []
        self._points = points
        self._wanted = frozenset(int(row) for row in rows)
        self._kept: list[tuple[int, Floats]] = []
        shape = (points, len(OVERLAY_COLUMNS))
        self._count = np.zeros(shape, np.int64)
        self._mean, self._squares = np.zeros(shape), np.zeros(shape)

    def add_frames(self, t_ns: Times, columns: Columns) -> None:
        """Add the next n frames.

        Args:
            t_ns: (n,), instants, rising within a part.
            columns: `OVERLAY_COLUMNS` and `estimate_flags`, (n,) each; `part`, 0 if absent.
        """
        if not len(t_ns) or self._next >= len(self._windows):
            return
        part = columns["part"] if "part" in columns else np.zeros(len(t_ns), np.uint16)
        values = np.stack([columns[name].astype(np.float64) for name in OVERLAY_COLUMNS], axis=1)
        gaps = (columns["estimate_flags"] & EstimateFlag.GAP) != 0
        edges = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), len(part)]
        for first, end in pairwise(edges):
            rows = slice(first, end)
            self._add_part_frames(int(part[first]), t_ns[rows], values[rows], gaps[rows])

    def build_overlay(self) -> Overlay:
        """Return the overlay of all stances that are complete."""
        known = self._count > 0
        mean = np.where(known, self._mean, np.nan)
        several = self._count > 1
        sd = np.sqrt(np.where(several, self._squares / np.maximum(1, self._count - 1), np.nan))
        spread = {
            name: CurveStatistics(mean[:, i], sd[:, i], self._count[:, i])
            for i, name in enumerate(OVERLAY_COLUMNS)
        }
        rows = np.array([row for row, _ in self._kept], np.int64)
        empty = np.empty((0, self._points, len(OVERLAY_COLUMNS)))
        curves = np.stack([curve for _, curve in self._kept]) if self._kept else empty
        return Overlay(
            spread, rows, {name: curves[:, :, i] for i, name in enumerate(OVERLAY_COLUMNS)}
        )

    def _add_part_frames(self, part: int, t_ns: Times, values: Floats, gaps: Bools) -> None:
        while self._next < len(self._windows):
            of, begin_ns, end_ns = self._windows[self._next]
            if of != part or begin_ns > t_ns[-1]:
                return
            rows = slice(
                int(np.searchsorted(t_ns, begin_ns)),
                int(np.searchsorted(t_ns, end_ns, side="right")),
            )
            self._open.append((t_ns[rows], values[rows], gaps[rows]))
            if t_ns[-1] < end_ns:
                return
            self._add_stance()

    def _add_stance(self) -> None:
        row, pieces = self._next, self._open
        self._next, self._open = row + 1, []
        t_ns, values, gaps = (np.concatenate(each) for each in zip(*pieces, strict=True))
        curve = resample_stance(t_ns, values, gaps, self._points)
        if row in self._wanted:
            self._kept.append((row, curve))
        # Welford (1962): no cancellation for any number of stances.
        known = np.isfinite(curve)
        self._count += known
        off = np.where(known, curve - self._mean, 0.0)
        self._mean += off / np.maximum(1, self._count)
        self._squares += np.where(known, off * (curve - self._mean), 0.0)


MAX_HALF_WIDTH = 256
"""Frames to either side in the widest window."""
_CHUNK = 4096
"""Number of frames that are searched together: a longer stance needs no more memory."""
_AGREEMENT_SIGMAS = 1.0
_SELECTION_SIGMAS = 6.0
_NOISE_CAP = 8.0
_CENTRES_PER_HALF = 8
"""Number of windows with centres within half the width of one; all frames, if they are fewer."""


@dataclass(frozen=True)
class _Candidate:
    """Estimate of the peak from one window; squared sigmas in N²."""

    lower_n: float = -math.inf
    force_n: float = math.nan
    t_ns: int = 0
    independent_n2: float = math.nan
    common_n2: float = math.nan
    frames: int = 1


class StancePeak(NamedTuple):
    """Peak of a force: its node's UTC, and standard uncertainty."""

    force_n: float
    t_ns: int
    sigma_n: float


class PeakSearch:
    """Search for the peak of a force in the consecutive frames of a stance.

    Parabolas over time are fitted to windows of the frames i - h to i + h, h = 0, 2, 4, 8, ...
    (Savitzky and Golay 1964). At frame i their value is a_h = sum(c_j f_j), with the noise
    v_h = sqrt(sum(c_j² q_j²)). A window counts if it agrees with all narrower windows k,
    |a_h - a_k| <= v_k (Lepski 1991). The peak is the a_h with the largest lower bound
    a_h - 6 v_h: 6 sigmas exceed the noise of the largest of many thousand frames (Duembgen and
    Spokoiny 2001), so only a significantly larger force is taken from a narrower window.

    The residuals of parabolas through five frames give the variance q² of independent noise. A
    frame's sigma also contains errors that it shares with its neighbours, so its noise q_j is
    sigma_j, but at most 8 q. In the mean of sigma_j² over the window q² averages out, the rest does
    not. One of n / (2h + 1) windows was chosen for its noise, hence the logarithm:

        sigma² = max(mean(sigma_j²) - q², 0) + q² sum(c_j²) (1 + 2 ln(n / (2h + 1)))

    Of fewer than five frames the peak is the largest, with its sigma. The result does not depend
    on the batches.
    """

    def __init__(self) -> None:
        self._t_ns: Times = np.empty(0, np.int64)
        self._forces: Floats = np.empty((2, 0))
        self._frames = 0
        self._best = _Candidate()

    def add_frames(self, t_ns: Times, grf_n: Floats, sigma_n: Floats) -> None:
        """Add the next n frames, (n,) each; frames without a force are left out."""
        known = np.isfinite(grf_n) & np.isfinite(sigma_n)
        self._frames += int(np.count_nonzero(known))
        self._t_ns = np.append(self._t_ns, t_ns[known])
        self._forces = np.append(self._forces, [grf_n[known], sigma_n[known]], axis=1)
        while len(self._t_ns) >= _CHUNK + 2 * MAX_HALF_WIDTH:
            self._search(slice(0, _CHUNK + 2 * MAX_HALF_WIDTH))
            self._t_ns, self._forces = self._t_ns[_CHUNK:], self._forces[:, _CHUNK:]

    def join(self, other: PeakSearch) -> None:
        """Add the frames of another search, after a gap that no window spans."""
        for each in (self, other):
            each._search(slice(None))  # noqa: SLF001
        self._best = max(self._best, other._best, key=lambda best: best.lower_n)
        self._frames += other._frames
        self._t_ns, self._forces = other._t_ns[:0], other._forces[:, :0]

    def estimate_peak(self) -> StancePeak | None:
        """Estimate the highest peak until now; None without a force."""
        if not self._frames:
            return None
        self._search(slice(None))
        best = self._best
        selection = 1.0 + 2.0 * math.log(self._frames / best.frames)
        variance = best.common_n2 + best.independent_n2 * selection
        return StancePeak(best.force_n, best.t_ns, math.sqrt(variance))

    def _search(self, rows: slice) -> None:
        """Replace the best candidate if one of these frames has a better one."""
        t_ns, (force_n, sigma_n) = self._t_ns[rows], self._forces[:, rows]
        noise_n2 = _estimate_noise_n2(t_ns, force_n)
        capped_n2 = np.minimum(sigma_n**2, _NOISE_CAP**2 * noise_n2)
        centres = np.arange(len(force_n))  # at which all windows so far agree
        narrower = np.empty((2, 0, len(centres)))  # values and noises, (windows, centres)
        half = 0
        while half <= MAX_HALF_WIDTH:
            is_used = (centres >= half) & (centres < len(force_n) - half)
            is_used &= centres % max(1, half // _CENTRES_PER_HALF) == 0
            most_n = narrower[0] + _AGREEMENT_SIGMAS * narrower[1]  # of a window that agrees
            is_used &= np.all(most_n > self._best.lower_n, axis=0)
            centres, narrower = centres[is_used], narrower[..., is_used]
            frames, weights = _fit_parabolas(t_ns, centres, half)
            value_n = np.sum(weights * force_n[frames], axis=1)
            scatter_n = np.sqrt(np.sum(weights**2 * capped_n2[frames], axis=1))
            agrees = np.abs(value_n - narrower[0]) <= _AGREEMENT_SIGMAS * narrower[1]
            is_used = np.all(agrees, axis=0)
            if not is_used.any():
                return
            narrower = np.append(narrower, [[value_n], [scatter_n]], axis=1)[..., is_used]
            centres, (value_n, scatter_n) = centres[is_used], narrower[:, -1]
            lower_n = value_n - _SELECTION_SIGMAS * scatter_n
            at = int(np.argmax(lower_n))
            if lower_n[at] > self._best.lower_n:
                sigma_n2 = float(np.mean(sigma_n[frames[is_used][at]] ** 2))
                self._best = _Candidate(
                    float(lower_n[at]),
                    float(value_n[at]),
                    int(t_ns[centres[at]]),
                    float(np.sum(weights[is_used][at] ** 2)) * min(noise_n2, sigma_n2),
                    max(sigma_n2 - noise_n2, 0.0),
                    2 * half + 1,
                )
            half = max(2, 2 * half)


def _fit_parabolas(t_ns: Times, centres: npt.NDArray[np.intp], half: int) -> tuple[Any, Floats]:
    """Return frames (k, 2 half + 1) of windows about centres, and weights of their parabolas."""
    frames = centres[:, None] + np.arange(-half, half + 1)
    if half == 0:
        return frames, np.ones(frames.shape)
    x = (t_ns[frames] - t_ns[centres][:, None]) / (t_ns[frames[:, -1:]] - t_ns[frames[:, :1]])
    x2 = x * x
    s1, s2, s3, s4 = (np.sum(of, axis=1, keepdims=True) for of in (x, x2, x * x2, x2 * x2))
    # First row of the inverse of the normal equations, by cofactors.
    weights = (s2 * s4 - s3 * s3) + (s2 * s3 - s1 * s4) * x + (s1 * s3 - s2 * s2) * x2
    return frames, weights / np.sum(weights, axis=1, keepdims=True)


def _estimate_noise_n2(t_ns: Times, force_n: Floats) -> float:
    """Return the variance of independent noise about parabolas through five frames; 0 of fewer."""
    centres = np.arange(2, len(force_n) - 2)
    if not len(centres):
        return 0.0
    frames, weights = _fit_parabolas(t_ns, centres, 2)
    residual_n = force_n[2:-2] - np.sum(weights * force_n[frames], axis=1)
    return float(np.sum(residual_n**2) / np.sum(1.0 - weights[:, 2]))
