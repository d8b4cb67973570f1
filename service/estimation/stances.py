"""Stances: contacts of the foot with the ground, from estimates.

The only definition of a stance: a run of frames whose `contact` is 1, with the frames of unknown
contact in between. During a gap longer than `LONG_GAP_NS`, or a restart of the node, the foot may
have been lifted: the stance is cut there, and another one begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Columns, Floats, Times
from devices.flags import CONTACT_UNKNOWN, EstimateFlag
from service.estimation import LONG_GAP_NS
from service.estimation.records import SIGMAS_95
from service.estimation.stance_curves import PeakSearch

STANCE_INPUT_COLUMNS = (
    "contact",
    "grf_n",
    "grf_sigma_n",
    "cop_x_m",
    "cop_sigma_x_m",
    "estimate_flags",
)
"""Columns of estimates that stances need; with several parts also `part`."""

STANCE_COLUMNS = (
    *("number", "part", "begin_t_ns", "end_t_ns", "duration_s", "duration_sigma_s"),
    *("peak_grf_n", "peak_t_ns", "peak_sigma_n", "impulse_n_s", "impulse_sigma_n_s"),
    *("cop_x_first_m", "cop_x_last_m", "cop_x_range_m", "cop_x_range_sigma_m"),
    *("frames", "unknown_frames", "missing_frames", "estimate_flags"),
    *("begun", "ended", "is_whole"),
)
"""Columns of a table of stances."""

EDGE_NS = 10_000_000
"""Time over which the slope of the GRF at the edges of a stance is measured, within the stance."""
COP_SHARE_MIN = 0.8
"""Least share of a stance's frames with a COP, for an uncertainty of the COP's range."""
_SLOPE_SIGMAS = 2.0
"""Least change of the GRF over `EDGE_NS` for a slope, in its sigmas."""


@dataclass(frozen=True)
class Stance:
    """Contact of the foot with the ground. Unknown values are NaN.

    Attributes:
        number: number in its recording, from 1; cut stances count, too.
        part: part of the session.
        begin_t_ns: UTC of its first frame.
        end_t_ns: UTC of its last frame.
        duration_sigma_s: standard uncertainty of the duration (docs/method.md); NaN if the frame
            before or after the stance is missing, or if the GRF rises or falls too slowly there.
        peak_grf_n: largest GRF without the bias by noise (`service.estimation.stance_curves`); NaN
            without any, or if a tile was saturated, which hides the peak.
        peak_t_ns: UTC of the frame with that GRF; None without a peak.
        peak_sigma_n: standard uncertainty of the peak.
        impulse_n_s: integral of the GRF by the trapezoidal rule, in newton seconds; NaN if a frame
            is missing or has no GRF.
        impulse_sigma_n_s: standard uncertainty of the impulse, for errors of the GRF that are equal
            in all frames of the stance.
        cop_x_first_m: first known centre of pressure along x, in the foot frame.
        cop_x_last_m: last known one.
        cop_x_range_m: largest less smallest.
        cop_x_range_sigma_m: standard uncertainty of the range, with independent errors of smallest
            and largest; NaN if fewer than `COP_SHARE_MIN` of the frames have a COP: the range is
            then a lower bound.
        frames: number of frames from the first to the last.
        unknown_frames: number of these without a GRF.
        missing_frames: number of missing frames between the first and the last.
        estimate_flags: union of the flags of its frames.
        begun: the frame before exists and is without contact.
        ended: the frame after it likewise.
    """

    number: int
    part: int
    begin_t_ns: int
    end_t_ns: int
    duration_sigma_s: float
    peak_grf_n: float
    peak_t_ns: int | None
    peak_sigma_n: float
    impulse_n_s: float
    impulse_sigma_n_s: float
    cop_x_first_m: float
    cop_x_last_m: float
    cop_x_range_m: float
    cop_x_range_sigma_m: float
    frames: int
    unknown_frames: int
    missing_frames: int
    estimate_flags: int
    begun: bool
    ended: bool

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last."""
        return (self.end_t_ns - self.begin_t_ns) * 1e-9

    @property
    def is_whole(self) -> bool:
        """True if both edges exist, no frame is missing, and every GRF is known."""
        return self.begun and self.ended and not self.missing_frames and not self.unknown_frames

    def as_dict(self) -> dict[str, Any]:
        """Return the columns of `STANCE_COLUMNS` by name."""
        return {name: getattr(self, name) for name in STANCE_COLUMNS}


def compute_stances(seq: npt.NDArray[np.uint64], t_ns: Times, columns: Columns) -> list[Stance]:
    """Compute the stances of a complete recording; arguments as of `StanceDetector.add_frames`."""
    gathered = StanceDetector()
    return [*gathered.add_frames(seq, t_ns, columns), *gathered.finish()]


class StanceDetector:
    """Detector of stances in consecutive frames; the result does not depend on the batches.

    It stores sums and the last seconds: its memory does not grow with the length of a stance.
    """

    def __init__(self) -> None:
        self._seen: _Frame | None = None
        self._open: _OpenStance | None = None
        self._unsure = _UnknownFrames()
        self._number = 0

    def add_frames(
        self, seq: npt.NDArray[np.uint64], t_ns: Times, columns: Columns
    ) -> list[Stance]:
        """Add the next n frames; return the stances that have ended.

        Args:
            seq: (n,), numbers of the frames.
            t_ns: (n,), UTC.
            columns: `STANCE_INPUT_COLUMNS`, (n,) each, contact being 1, 0 or `CONTACT_UNKNOWN`;
                `part`, 0 if absent.
        """
        over: list[Stance] = []
        sure = np.flatnonzero(columns["contact"] != CONTACT_UNKNOWN)
        if not len(sure):
            self._unsure.add_frames(columns["estimate_flags"])
            return over
        known: npt.NDArray[Any] | slice = sure
        if len(sure) == len(columns["contact"]):
            known = slice(None)  # as nearly always, and nothing is copied
        part = columns["part"][known] if "part" in columns else np.zeros(len(sure), np.uint16)
        loaded = columns["contact"][known] == 1
        frames = _KnownFrames(seq[known], t_ns[known], part, loaded, columns["grf_n"][known])
        for first, end in frames.iterate_runs():
            begin, last = frames.get_frame(first), frames.get_frame(end - 1)
            if first or not begin.continues(self._seen):
                over += self._end_stance(begin)
            if begin.loaded:
                since = int(sure[first])
                if self._open is None:
                    self._number += 1
                    before = self._seen if begin.is_adjacent_edge(self._seen) else None
                    self._open = _OpenStance(self._number, begin, before)
                else:
                    self._open.add_unknown_frames(self._unsure)
                    since = 0
                self._open.add_frames(slice(since, int(sure[end - 1]) + 1), t_ns, columns)
                self._open.last = last
            self._seen, self._unsure = last, _UnknownFrames()
        self._unsure.add_frames(columns["estimate_flags"][int(sure[-1]) + 1 :])
        return over

    def finish(self) -> list[Stance]:
        """Return the stance that has not ended, if there is one, at the end of the frames."""
        return self._end_stance(None)

    def _end_stance(self, behind: _Frame | None) -> list[Stance]:
        stance, self._open = self._open, None
        return [] if stance is None else [stance.to_stance(behind)]


@dataclass(frozen=True)
class _Frame:
    """Frame with known contact."""

    seq: int
    t_ns: int
    part: int
    loaded: bool
    grf_n: float

    def is_near(self, other: _Frame | None) -> bool:
        """Return whether no gap in which the foot may have moved lies between two frames."""
        if other is None:
            return False
        return self.part == other.part and abs(self.t_ns - other.t_ns) <= LONG_GAP_NS

    def continues(self, before: _Frame | None) -> bool:
        """Return whether it belongs to the same stance, or flight, as the frame before."""
        return before is not None and self.is_near(before) and self.loaded == before.loaded

    def is_adjacent_edge(self, other: _Frame | None) -> bool:
        """Return whether the two frames are consecutive and differ in contact."""
        if other is None or not self.is_near(other) or self.loaded == other.loaded:
            return False
        return abs(self.seq - other.seq) == 1


@dataclass(frozen=True)
class _KnownFrames:
    """Frames of a batch with known contact, (n,) each."""

    seq: npt.NDArray[np.uint64]
    t_ns: Times
    part: npt.NDArray[Any]
    loaded: Bools
    grf_n: Floats

    def get_frame(self, i: int) -> _Frame:
        """Return frame `i`."""
        seq, t_ns, part = int(self.seq[i]), int(self.t_ns[i]), int(self.part[i])
        return _Frame(seq, t_ns, part, bool(self.loaded[i]), float(self.grf_n[i]))

    def iterate_runs(self) -> Iterator[tuple[int, int]]:
        """Iterate over stances and flights: first row, and row after the last."""
        differs = (self.loaded[1:] != self.loaded[:-1]) | (self.part[1:] != self.part[:-1])
        cut = np.flatnonzero(differs | (np.diff(self.t_ns) > LONG_GAP_NS)) + 1
        edges = [0, *cut.tolist(), len(self.loaded)]
        return pairwise(edges)


@dataclass
class _UnknownFrames:
    """Frames of unknown contact since the last known one; part of a stance if it continues."""

    frames: int = 0
    status: int = 0

    def add_frames(self, status: npt.NDArray[np.uint16]) -> None:
        self.frames += len(status)
        self.status |= int(np.bitwise_or.reduce(status))


@dataclass(frozen=True)
class _ForceSeries:
    """GRF of consecutive frames, (n,) each."""

    t_ns: Times
    grf_n: Floats
    sigma_n: Floats

    @classmethod
    def make_empty(cls) -> _ForceSeries:
        """Make an empty one."""
        return cls(np.empty(0, np.int64), np.empty(0), np.empty(0))

    def append(self, other: _ForceSeries) -> _ForceSeries:
        """Return these frames, then the others."""
        return _ForceSeries(
            np.append(self.t_ns, other.t_ns),
            np.append(self.grf_n, other.grf_n),
            np.append(self.sigma_n, other.sigma_n),
        )

    def slice_rows(self, begin: int | None, end: int | None) -> _ForceSeries:
        """Return rows `begin` to `end`."""
        return _ForceSeries(self.t_ns[begin:end], self.grf_n[begin:end], self.sigma_n[begin:end])

    def compute_edge_sigma_s(self, edge: int, inside: int, outside: _Frame) -> float:
        """Return the uncertainty of the instant of an edge, due to that of the force.

        Args:
            edge: index of the stance's first or last frame.
            inside: index of the frame `EDGE_NS` further inside.
            outside: the frame beside the stance.
        """
        change_n = self.grf_n[inside] - outside.grf_n
        if not change_n > _SLOPE_SIGMAS * np.hypot(self.sigma_n[inside], self.sigma_n[edge]):
            return np.nan
        lasted_s = abs(int(self.t_ns[inside]) - outside.t_ns) * 1e-9
        return float(self.sigma_n[edge] / change_n * lasted_s)


@dataclass
class _OpenStance:
    """Stance that has not ended, with the sums over its frames."""

    number: int
    first: _Frame
    before: _Frame | None
    """Frame before it, without contact; None if there is none."""
    last: _Frame = field(init=False)
    frames: int = 0
    unknown: int = 0
    status: int = 0
    integrals: tuple[float, float] = (0.0, 0.0)
    """Integrals of the GRF and of its sigma over time, in newton seconds."""
    peak: PeakSearch = field(default_factory=PeakSearch)
    head: _ForceSeries = field(default_factory=_ForceSeries.make_empty)
    """First frames, up to one `EDGE_NS` after the first."""
    tail: _ForceSeries = field(default_factory=_ForceSeries.make_empty)
    """Last frames, from one `EDGE_NS` before the last."""
    cop_frames: int = 0
    """Number of frames with a COP."""
    cop_x_m: tuple[float, float] | None = None
    """First and last known COP."""
    extremes_x_m: Floats | None = None
    """(3, 2): smallest and largest of the 95 % intervals' lower ends, of COP, of the upper ends."""

    def add_unknown_frames(self, unsure: _UnknownFrames) -> None:
        """Add the frames of unknown contact in between."""
        self.frames += unsure.frames
        self.unknown += unsure.frames
        self.status |= unsure.status

    def add_frames(self, rows: slice, t_ns: Times, columns: Columns) -> None:
        """Add the next frames; contact of the last one is known."""
        t_ns, unsure = t_ns[rows], columns["contact"][rows] == CONTACT_UNKNOWN
        grf_n = columns["grf_n"][rows].astype(np.float64)  # a copy
        grf_n[unsure] = np.nan
        sigma_n = columns["grf_sigma_n"][rows].astype(np.float64)
        self.frames += len(grf_n)
        self.unknown += int(np.count_nonzero(~np.isfinite(grf_n)))
        self.status |= int(np.bitwise_or.reduce(columns["estimate_flags"][rows]))
        self.peak.add_frames(t_ns, grf_n, sigma_n)
        self._add_force(_ForceSeries(t_ns, grf_n, sigma_n))
        stated = np.isfinite(columns["cop_x_m"][rows]) & ~unsure
        if stated.any():
            self._add_cop(columns["cop_x_m"][rows][stated], columns["cop_sigma_x_m"][rows][stated])

    def _add_cop(self, x_m: Floats, sigma_m: Floats) -> None:
        """Add known centres of pressure."""
        x_m, sigma_m = x_m.astype(np.float64), sigma_m.astype(np.float64)
        self.cop_frames += len(x_m)
        first = float(x_m[0]) if self.cop_x_m is None else self.cop_x_m[0]
        self.cop_x_m = first, float(x_m[-1])
        bounds_m = x_m - SIGMAS_95 * sigma_m, x_m, x_m + SIGMAS_95 * sigma_m
        now_m = np.array([(of_m.min(), of_m.max()) for of_m in bounds_m])
        if self.extremes_x_m is not None:
            before_m = self.extremes_x_m
            now_m[:, 0] = np.minimum(now_m[:, 0], before_m[:, 0])
            now_m[:, 1] = np.maximum(now_m[:, 1], before_m[:, 1])
        self.extremes_x_m = now_m

    def _add_force(self, force: _ForceSeries) -> None:
        joined = self.tail.slice_rows(-1, None).append(force)
        steps_s = np.diff(joined.t_ns) * 1e-9
        # One after the other, so that the sum does not depend on the batches.
        grf_n_s, sigma_n_s = (
            float(np.add.accumulate(np.append(sum_, (of[1:] + of[:-1]) * 0.5 * steps_s))[-1])
            for sum_, of in zip(self.integrals, (joined.grf_n, joined.sigma_n), strict=True)
        )
        self.integrals = grf_n_s, sigma_n_s
        if not len(self.head.t_ns) or self.head.t_ns[-1] - self.first.t_ns < EDGE_NS:
            end = int(np.searchsorted(force.t_ns, self.first.t_ns + EDGE_NS)) + 1
            self.head = self.head.append(force.slice_rows(0, end))
        tail = self.tail.append(force)
        begin = int(np.searchsorted(tail.t_ns, tail.t_ns[-1] - EDGE_NS, side="right")) - 1
        self.tail = tail.slice_rows(max(0, begin), None)

    def _duration_sigma_s(self, behind: _Frame | None) -> float:
        """Return the sigma of the duration by the frames' distance and the force's uncertainty.

        The foot was put down at any instant between the frame before the stance and its first
        frame, and lifted likewise: on average the duration lacks half of both gaps.
        """
        head, tail = self.head, self.tail
        if self.before is None or behind is None or head.t_ns[-1] - head.t_ns[0] < EDGE_NS:
            return np.nan
        gaps_s = self._gaps_s(behind)
        missing_s = 0.5 * sum(gaps_s)
        spread_s = np.hypot(*gaps_s) / np.sqrt(12.0)
        # An offset of the force moves both edges, outwards or inwards: they add up.
        force_s = head.compute_edge_sigma_s(0, -1, self.before) + tail.compute_edge_sigma_s(
            -1, 0, behind
        )
        return float(np.sqrt(missing_s**2 + spread_s**2 + force_s**2))

    def _gaps_s(self, behind: _Frame | None) -> tuple[float, float]:
        """Return the time to the frames beside the stance; 0 where there is none."""
        return (
            0.0 if self.before is None else (self.first.t_ns - self.before.t_ns) * 1e-9,
            0.0 if behind is None else (behind.t_ns - self.last.t_ns) * 1e-9,
        )

    def _impulse_sigma_n_s(self, behind: _Frame | None) -> float:
        """Return the integral of the force's sigma, with the missing parts at the edges."""
        before_s, behind_s = self._gaps_s(behind)
        edges_n_s = 0.5 * (before_s * self.head.grf_n[0] + behind_s * self.tail.grf_n[-1])
        return float(np.hypot(self.integrals[1], edges_n_s))

    def _cop_range_m(self) -> tuple[float, float]:
        """Return the range of the centre of pressure, and its standard uncertainty.

        The largest of all frames lies between the largest lower and the largest upper end of their
        intervals, the smallest likewise: an uncertain frame may be the extreme one.
        """
        if self.extremes_x_m is None:
            return np.nan, np.nan
        low_m, x_m, high_m = self.extremes_x_m
        sigmas_m = (high_m - low_m) / (2.0 * SIGMAS_95)
        is_bound = self.cop_frames < COP_SHARE_MIN * self.frames
        return float(x_m[1] - x_m[0]), np.nan if is_bound else float(np.hypot(*sigmas_m))

    def to_stance(self, behind: _Frame | None) -> Stance:
        """Make the stance; `behind` is the next frame with known contact, if there is one."""
        missing = self.last.seq - self.first.seq + 1 - self.frames
        peak = None if self.status & EstimateFlag.SATURATED else self.peak.estimate_peak()
        peak_n, peak_t_ns, peak_sigma_n = peak or (np.nan, None, np.nan)
        x_first_m, x_last_m = self.cop_x_m or (np.nan, np.nan)
        range_m, range_sigma_m = self._cop_range_m()
        behind = behind if self.last.is_adjacent_edge(behind) else None
        has_impulse = not (missing or self.unknown)
        return Stance(
            number=self.number,
            part=self.first.part,
            begin_t_ns=self.first.t_ns,
            end_t_ns=self.last.t_ns,
            duration_sigma_s=self._duration_sigma_s(behind),
            peak_grf_n=peak_n,
            peak_t_ns=peak_t_ns,
            peak_sigma_n=peak_sigma_n,
            impulse_n_s=self.integrals[0] if has_impulse else np.nan,
            impulse_sigma_n_s=self._impulse_sigma_n_s(behind) if has_impulse else np.nan,
            cop_x_first_m=x_first_m,
            cop_x_last_m=x_last_m,
            cop_x_range_m=range_m,
            cop_x_range_sigma_m=range_sigma_m,
            frames=self.frames,
            unknown_frames=self.unknown,
            missing_frames=missing,
            estimate_flags=self.status,
            begun=self.before is not None,
            ended=behind is not None,
        )
