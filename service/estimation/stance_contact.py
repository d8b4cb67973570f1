"""Contact of the foot: sums over its frames, from which figures of a stance are computed.

Unknown values are NaN. The results do not depend on the batches in which frames come.
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

EDGE_NS = 10_000_000
"""Time over which the slope of the GRF is measured, within the stance."""
BRIDGED_GAP_MAX_NS = 200_000_000
"""Greatest gap within a stance, however long it lasts: shorter than the swing of a step."""
COP_SHARE_MIN = 0.8
"""Least share of a stance's frames with a COP, for an uncertainty of the COP's range."""
COP_GAP_SHARE_MAX = 0.05
"""Greatest share of gaps in the duration for it, if they last longer than `EDGE_NS`: a COP that
rolls over the foot moves as far."""
_SLOPE_SIGMAS = 2.0
"""Least change of the GRF over `EDGE_NS` for a slope, in its sigmas."""


@dataclass(frozen=True)
class Frame:
    """Frame with known contact."""

    seq: int
    t_ns: int
    part: int
    loaded: bool
    grf_n: float
    is_after_gap: bool
    """Frames are missing before it, by its flag."""

    def is_near(self, other: Frame | None, gap_ns: int) -> bool:
        """Return whether two frames of a part are at most `gap_ns` apart."""
        if other is None:
            return False
        return self.part == other.part and abs(self.t_ns - other.t_ns) <= gap_ns

    def continues(self, before: Frame | None) -> bool:
        """Return whether it belongs to the same stance, or flight, as the frame before."""
        return (
            before is not None
            and self.is_near(before, LONG_GAP_NS)
            and self.loaded == before.loaded
        )

    def may_be_bridged_to(self, behind: Frame | None) -> bool:
        """Return whether it and the next known frame are in contact, and may be of one stance."""
        return behind is not None and behind.loaded and self.is_near(behind, BRIDGED_GAP_MAX_NS)

    def is_edge(self, other: Frame | None) -> bool:
        """Return whether two frames differ in contact, and may be the edge of a stance."""
        return (
            other is not None
            and self.loaded != other.loaded
            and self.is_near(other, BRIDGED_GAP_MAX_NS)
        )

    def measure_gap_s(self, before: Frame) -> float:
        """Return the duration of the gap between a frame and itself; 0 if there is none."""
        has_gap = self.is_after_gap or self.seq - before.seq != 1
        return (self.t_ns - before.t_ns) * 1e-9 if has_gap else 0.0


@dataclass(frozen=True)
class KnownFrames:
    """Frames of a batch with known contact, (n,) each."""

    seq: npt.NDArray[np.uint64]
    t_ns: Times
    part: npt.NDArray[Any]
    loaded: Bools
    grf_n: Floats
    is_after_gap: Bools

    def get_frame(self, i: int) -> Frame:
        """Return frame `i`."""
        seq, t_ns, part = int(self.seq[i]), int(self.t_ns[i]), int(self.part[i])
        loaded, is_after_gap = bool(self.loaded[i]), bool(self.is_after_gap[i])
        return Frame(seq, t_ns, part, loaded, float(self.grf_n[i]), is_after_gap)

    def iterate_runs(self) -> Iterator[tuple[int, int]]:
        """Iterate over stances and flights: first row, and row after the last."""
        differs = (self.loaded[1:] != self.loaded[:-1]) | (self.part[1:] != self.part[:-1])
        cut = np.flatnonzero(differs | (np.diff(self.t_ns) > LONG_GAP_NS)) + 1
        edges = [0, *cut.tolist(), len(self.loaded)]
        return pairwise(edges)


@dataclass
class UnknownFrames:
    """Frames of unknown contact since the last known one; part of a stance if it continues."""

    frames: int = 0
    status: int = 0

    def add_frames(self, status: npt.NDArray[np.uint16]) -> None:
        """Add frames by their flags."""
        self.frames += len(status)
        self.status |= int(np.bitwise_or.reduce(status))


@dataclass(frozen=True)
class ForceSeries:
    """GRF of the frames that have one, (n,) each."""

    t_ns: Times
    grf_n: Floats
    sigma_n: Floats

    @classmethod
    def make_empty(cls) -> ForceSeries:
        """Make an empty one."""
        return cls(np.empty(0, np.int64), np.empty(0), np.empty(0))

    def append(self, other: ForceSeries) -> ForceSeries:
        """Return these frames, then the others."""
        return ForceSeries(
            np.append(self.t_ns, other.t_ns),
            np.append(self.grf_n, other.grf_n),
            np.append(self.sigma_n, other.sigma_n),
        )

    def slice_rows(self, begin: int | None, end: int | None) -> ForceSeries:
        """Return rows `begin` to `end`."""
        return ForceSeries(self.t_ns[begin:end], self.grf_n[begin:end], self.sigma_n[begin:end])

    def is_long(self) -> bool:
        """Return whether it lasts `EDGE_NS`."""
        return len(self.t_ns) > 0 and bool(self.t_ns[-1] - self.t_ns[0] >= EDGE_NS)

    def find_fastest_change_n_s(self, count: int) -> float:
        """Return the fastest change over `EDGE_NS` before each of the last `count` frames."""
        t_ns, grf_n = self.t_ns[-count:], self.grf_n[-count:]
        before = np.searchsorted(self.t_ns, t_ns - EDGE_NS, side="right") - 1
        rows = before >= 0
        steps_s = (t_ns[rows] - self.t_ns[before[rows]]) * 1e-9
        changes_n = np.abs(grf_n[rows] - self.grf_n[before[rows]])
        return float(np.max(changes_n / steps_s, initial=0.0))

    def measure_s(self, i: int, outside: Frame) -> float:
        """Return the time between a frame and one outside."""
        return abs(int(self.t_ns[i]) - outside.t_ns) * 1e-9

    def compute_edge_sigma_s(self, edge: int, inside: int, outside: Frame) -> float:
        """Return the uncertainty of the instant of an edge, due to that of the force.

        Args:
            edge: index of the stance's first or last frame.
            inside: index of the frame `EDGE_NS` further inside.
            outside: the frame beside the stance.
        """
        change_n = self.grf_n[inside] - outside.grf_n
        if not change_n > _SLOPE_SIGMAS * np.hypot(self.sigma_n[inside], self.sigma_n[edge]):
            return np.nan
        return float(self.sigma_n[edge] / change_n * self.measure_s(inside, outside))


@dataclass
class Gaps:
    """Gaps within a stance.

    With forces `before` and `after` beside a gap of `t`, and the fastest change `r` of the force,
    the force lies in a rhombus: at most `r t / 2` beside the line in its middle, `r t² / 4` of
    impulse on either side, and at most `(before + after + r t) / 2` high.
    """

    total_s: float = 0.0
    total_s4: float = 0.0
    """Sum of the fourth powers of their durations."""
    highest: list[tuple[float, float]] = field(default_factory=list)
    """Sum of the forces beside a gap, and its duration, of those where both are not less than those
    of another one: only there the force may be highest."""

    def add_gap(self, lasted_s: float, before_n: float, after_n: float) -> None:
        """Add a gap between two forces."""
        self.total_s += lasted_s
        self.total_s4 += lasted_s**4
        self._add_height(before_n + after_n, lasted_s)

    def join(self, other: Gaps) -> None:
        """Add the gaps of the next contact."""
        self.total_s += other.total_s
        self.total_s4 += other.total_s4
        for both_n, lasted_s in other.highest:
            self._add_height(both_n, lasted_s)

    def compute_impulse_sigma_n_s(self, change_n_s: float) -> float:
        """Return the uncertainty of the impulse: anywhere in the rhombus of each gap."""
        return change_n_s * float(np.sqrt(self.total_s4 / 3.0)) / 4.0

    def compute_highest_n(self, change_n_s: float) -> float:
        """Return the greatest force that may lie in a gap; minus infinity without any."""
        heights_n = (0.5 * (both_n + change_n_s * lasted_s) for both_n, lasted_s in self.highest)
        return max(heights_n, default=-np.inf)

    def _add_height(self, both_n: float, lasted_s: float) -> None:
        if any(n >= both_n and s >= lasted_s for n, s in self.highest):
            return
        self.highest = [(n, s) for n, s in self.highest if n > both_n or s > lasted_s]
        self.highest.append((both_n, lasted_s))


@dataclass
class Contact:
    """Contact without a gap longer than `LONG_GAP_NS`, or several joined: sums over its frames."""

    first: Frame
    before: Frame | None
    """Last frame before it with known contact, if it has none."""
    last: Frame = field(init=False)
    frames: int = 0
    unknown: int = 0
    status: int = 0
    unsure: UnknownFrames = field(default_factory=UnknownFrames)
    """Frames of unknown contact before it: of the stance if it is joined."""
    integrals: tuple[float, float] = (0.0, 0.0)
    """Integrals of the GRF and of its sigma over time, in newton seconds."""
    gaps: Gaps = field(default_factory=Gaps)
    change_n_s: float = 0.0
    """Fastest change of the GRF, over `EDGE_NS` or a gap, in newtons a second."""
    peak: PeakSearch = field(default_factory=PeakSearch)
    head: ForceSeries = field(default_factory=ForceSeries.make_empty)
    """First frames, up to one `EDGE_NS` after the first."""
    tail: ForceSeries = field(default_factory=ForceSeries.make_empty)
    """Last frames, from one `EDGE_NS` before the last."""
    last_force_seq: int = 0
    """Number of the last frame with a GRF."""
    cop_frames: int = 0
    """Number of frames with a COP."""
    cop_x_m: tuple[float, float] | None = None
    """First and last known COP."""
    extremes_x_m: Floats | None = None
    """(3, 2): smallest and largest of the 95 % intervals' lower ends, of COP, of the upper ends."""

    def add_unknown_frames(self, unsure: UnknownFrames) -> None:
        """Add the frames of unknown contact before the next ones."""
        if not self.frames:
            self.unsure = unsure
            return
        self.frames += unsure.frames
        self.unknown += unsure.frames
        self.status |= unsure.status

    def add_frames(
        self, rows: slice, seq: npt.NDArray[np.uint64], t_ns: Times, columns: Columns
    ) -> None:
        """Add the next frames; contact of the last one is known."""
        t_ns, unsure = t_ns[rows], columns["contact"][rows] == CONTACT_UNKNOWN
        flags = columns["estimate_flags"][rows]
        grf_n = columns["grf_n"][rows].astype(np.float64)  # a copy
        grf_n[unsure] = np.nan
        sigma_n = columns["grf_sigma_n"][rows].astype(np.float64)
        self.frames += len(grf_n)
        self.status |= int(np.bitwise_or.reduce(flags))
        self.peak.add_frames(t_ns, grf_n, sigma_n)
        known = np.flatnonzero(np.isfinite(grf_n))
        self.unknown += len(grf_n) - len(known)
        if len(known):
            force = ForceSeries(t_ns[known], grf_n[known], sigma_n[known])
            is_after_gap = (flags[known] & EstimateFlag.GAP) != 0
            self._add_force(force, seq[rows][known].astype(np.int64), is_after_gap)
        stated = np.isfinite(columns["cop_x_m"][rows]) & ~unsure
        if stated.any():
            x_m = columns["cop_x_m"][rows][stated].astype(np.float64)
            sigma_m = columns["cop_sigma_x_m"][rows][stated].astype(np.float64)
            bounds_m = x_m - SIGMAS_95 * sigma_m, x_m, x_m + SIGMAS_95 * sigma_m
            extremes_m = np.array([(of_m.min(), of_m.max()) for of_m in bounds_m])
            self._add_cop(len(x_m), (float(x_m[0]), float(x_m[-1])), extremes_m)

    def join(self, other: Contact) -> None:
        """Add the next contact, after a gap; it must not be used afterwards."""
        self.add_unknown_frames(other.unsure)
        self.frames += other.frames
        self.unknown += other.unknown
        self.status |= other.status
        if len(other.head.t_ns):
            if len(self.head.t_ns):
                between = self.tail.slice_rows(-1, None).append(other.head.slice_rows(0, 1))
                self._add_integrals(between)
                self._add_gap(between)
            self.integrals = (
                self.integrals[0] + other.integrals[0],
                self.integrals[1] + other.integrals[1],
            )
            self.gaps.join(other.gaps)
            self.change_n_s = max(self.change_n_s, other.change_n_s)
            # Of a short contact both reach over the gap, so that an edge has a slope.
            self.head = self.head if self.head.is_long() else self.head.append(other.head)
            self.tail = other.tail if other.tail.is_long() else self.tail.append(other.tail)
            self.last_force_seq = other.last_force_seq
        self.peak.join(other.peak)
        self.last = other.last
        if other.cop_x_m is not None and other.extremes_x_m is not None:
            self._add_cop(other.cop_frames, other.cop_x_m, other.extremes_x_m)

    def _add_cop(self, frames: int, x_m: tuple[float, float], extremes_m: Floats) -> None:
        """Add known centres of pressure: their number, first and last, and `extremes_x_m`."""
        self.cop_frames += frames
        self.cop_x_m = x_m if self.cop_x_m is None else (self.cop_x_m[0], x_m[1])
        if self.extremes_x_m is not None:
            before_m = self.extremes_x_m
            extremes_m = np.stack(
                [
                    np.minimum(extremes_m[:, 0], before_m[:, 0]),
                    np.maximum(extremes_m[:, 1], before_m[:, 1]),
                ],
                axis=1,
            )
        self.extremes_x_m = extremes_m

    def _add_force(
        self, force: ForceSeries, seq: npt.NDArray[np.int64], is_after_gap: Bools
    ) -> None:
        before = self.tail.slice_rows(-1, None)
        joined = before.append(force)
        self._add_integrals(joined)
        if len(before.t_ns):
            seq = np.append(self.last_force_seq, seq)
        else:
            is_after_gap = is_after_gap[1:]  # of the edge, which is counted when it ends
        for i in np.flatnonzero((np.diff(seq) != 1) | is_after_gap).tolist():
            self._add_gap(joined.slice_rows(i, i + 2))
        self.last_force_seq = int(seq[-1])
        if not self.head.is_long():
            begin_ns = joined.t_ns[0] if not len(self.head.t_ns) else self.head.t_ns[0]
            end = int(np.searchsorted(force.t_ns, begin_ns + EDGE_NS)) + 1
            self.head = self.head.append(force.slice_rows(0, end))
        tail = self.tail.append(force)
        self.change_n_s = max(self.change_n_s, tail.find_fastest_change_n_s(len(force.t_ns)))
        begin = int(np.searchsorted(tail.t_ns, tail.t_ns[-1] - EDGE_NS, side="right")) - 1
        self.tail = tail.slice_rows(max(0, begin), None)

    def _add_integrals(self, joined: ForceSeries) -> None:
        steps_s = np.diff(joined.t_ns) * 1e-9
        # One after the other, so that the sum does not depend on the batches.
        grf_n_s, sigma_n_s = (
            float(np.add.accumulate(np.append(sum_, (of[1:] + of[:-1]) * 0.5 * steps_s))[-1])
            for sum_, of in zip(self.integrals, (joined.grf_n, joined.sigma_n), strict=True)
        )
        self.integrals = grf_n_s, sigma_n_s

    def _add_gap(self, between: ForceSeries) -> None:
        """Add the gap between two frames."""
        lasted_s = int(between.t_ns[1] - between.t_ns[0]) * 1e-9
        before_n, after_n = between.grf_n.tolist()
        self.gaps.add_gap(lasted_s, before_n, after_n)
        self.change_n_s = max(self.change_n_s, abs(after_n - before_n) / lasted_s)

    def compute_duration_sigma_s(self, behind: Frame | None) -> float:
        """Return the sigma of the duration by the frames' distance and the force's uncertainty.

        The foot was put down at any instant between the frame before the stance and its first
        frame, and lifted likewise: on average the duration lacks half of both gaps.
        """
        head, tail = self.head, self.tail
        if self.before is None or behind is None or not head.is_long():
            return np.nan
        gaps_s = self._gaps_s(behind)
        missing_s = 0.5 * sum(gaps_s)
        spread_s = np.hypot(*gaps_s) / np.sqrt(12.0)
        # An offset of the force moves both edges, outwards or inwards: they add up.
        force_s = head.compute_edge_sigma_s(0, -1, self.before) + tail.compute_edge_sigma_s(
            -1, 0, behind
        )
        return float(np.sqrt(missing_s**2 + spread_s**2 + force_s**2))

    def _gaps_s(self, behind: Frame | None) -> tuple[float, float]:
        """Return the time to the frames beside the stance; 0 where there is none."""
        return (
            0.0 if self.before is None else (self.first.t_ns - self.before.t_ns) * 1e-9,
            0.0 if behind is None else (behind.t_ns - self.last.t_ns) * 1e-9,
        )

    def add_edge_gaps(self, behind: Frame | None) -> Gaps:
        """Return the gaps beside its first and last frame; add the slopes of the edges."""
        edges = Gaps()
        if not len(self.head.t_ns):
            return edges
        for force, edge, inside, outside in (
            (self.head, 0, -1, self.before),
            (self.tail, -1, 0, behind),
        ):
            if outside is None:
                continue
            lasted_s = force.measure_s(inside, outside)
            change_n_s = abs(force.grf_n[inside] - outside.grf_n) / lasted_s
            self.change_n_s = max(self.change_n_s, float(change_n_s))
            own, other = (self.first, outside) if edge == 0 else (outside, self.last)
            if gap_s := own.measure_gap_s(other):
                edges.add_gap(gap_s, outside.grf_n, float(force.grf_n[edge]))
        return edges

    def compute_impulse_sigma_n_s(self, behind: Frame | None) -> float:
        """Return the integral of the force's sigma, with gaps, and missing parts at the edges."""
        before_s, behind_s = self._gaps_s(behind)
        edges_n_s = 0.5 * (before_s * self.head.grf_n[0] + behind_s * self.tail.grf_n[-1])
        gaps_n_s = self.gaps.compute_impulse_sigma_n_s(self.change_n_s)
        return float(np.hypot(np.hypot(self.integrals[1], edges_n_s), gaps_n_s))

    def estimate_peak(self, edges: Gaps) -> tuple[float, int | None, float]:
        """Return the peak, its instant, and its sigma: NaN if it is hidden, or may be in a gap."""
        peak = None if self.status & EstimateFlag.SATURATED else self.peak.estimate_peak()
        if peak is None:
            return np.nan, None, np.nan
        highest_n = max(of.compute_highest_n(self.change_n_s) for of in (self.gaps, edges))
        is_bound = highest_n > peak.force_n + SIGMAS_95 * peak.sigma_n
        return peak.force_n, peak.t_ns, np.nan if is_bound else peak.sigma_n

    def compute_cop_range_m(self, edges: Gaps) -> tuple[float, float]:
        """Return the range of the centre of pressure, and its standard uncertainty.

        The largest of all frames lies between the largest lower and the largest upper end of their
        intervals, the smallest likewise: an uncertain frame may be the extreme one. So may one in a
        gap.
        """
        if self.extremes_x_m is None:
            return np.nan, np.nan
        low_m, x_m, high_m = self.extremes_x_m
        sigmas_m = (high_m - low_m) / (2.0 * SIGMAS_95)
        duration_s = (self.last.t_ns - self.first.t_ns) * 1e-9
        is_bound = (
            self.cop_frames < COP_SHARE_MIN * self.frames
            or self.gaps.total_s + edges.total_s
            > max(EDGE_NS * 1e-9, COP_GAP_SHARE_MAX * duration_s)
        )
        return float(x_m[1] - x_m[0]), np.nan if is_bound else float(np.hypot(*sigmas_m))
