"""Summaries of frames for live pages: content of a message, and the last minute.

Frames between two ticks are merged into one summary per node, so a slow subscriber costs no more
than a fast one. A batch is reduced once, for the live page and for both histories. No peak hides:
spans of consecutive frames are merged by minimum and maximum, and NaN counts as missing.

The newest GRF spans are kept as published, so that live messages continue them without a seam;
older ones are merged. Spans of tiles are in half precision, to 0.05 % of the value, which no plot
shows. Memory of a stream is bounded: 200 kB, and 5 kB per tile.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.flags import CONTACT_UNKNOWN
from devices.frames import FrameBatch
from service.protocol.codec import encode_message
from service.protocol.live import FrameMessage, FramesDropped, SessionProgress, SessionsProgress
from storage.intervals import NO_END, Intervals

SECONDS_MAX = 60.0
FORCE_SPAN_PERIOD_NS = 1_000_000_000 // 30
"""Least distance between the begins of merged spans: no plot of a minute is finer."""
TILE_SPAN_PERIOD_NS = 100_000_000
TILE_QUANTITIES = ("force_n", "gauge_kpa")
_AS_PUBLISHED_NS = 2_000_000_000
_AS_PUBLISHED_MAX = 128
_HALF_MAX = float(np.finfo(np.float16).max)
_NO_VALUE = np.full(1, math.nan)


class ForceSpan(NamedTuple):
    """GRF over consecutive frames; forces are NaN where unknown."""

    seq_first: int
    seq: int
    n: int
    """Number of frames; less than the range of numbers where some are missing."""
    t_ns_first: int
    t_ns: int
    """Time of the newest frame, node's UTC."""
    grf_n: float
    """GRF of the newest frame."""
    grf_min_n: float
    grf_max_n: float
    grf_lower_bound_max_n: float
    """Greatest lower bound among the frames without a GRF."""

    def join(self, later: ForceSpan) -> ForceSpan:
        """Return this span and a later one as one."""
        return ForceSpan(
            self.seq_first,
            later.seq,
            self.n + later.n,
            self.t_ns_first,
            later.t_ns,
            later.grf_n,
            nan_min(self.grf_min_n, later.grf_min_n),
            nan_max(self.grf_max_n, later.grf_max_n),
            nan_max(self.grf_lower_bound_max_n, later.grf_lower_bound_max_n),
        )


def nan_min(a: float, b: float) -> float:
    """Return the smaller of two numbers; NaN counts as missing."""
    return b if math.isnan(a) else a if math.isnan(b) else min(a, b)


def nan_max(a: float, b: float) -> float:
    """Return the greater of two numbers; NaN counts as missing."""
    return -nan_min(-a, -b)


def summarize_force(frames: FrameBatch, columns: Mapping[str, npt.NDArray[Any]]) -> ForceSpan:
    """Return frames and their estimates, which may be none, as a span."""
    grf_n = columns.get("grf_n", _NO_VALUE)
    is_unknown = np.isnan(grf_n)
    bounds_n = columns.get("grf_lower_bound_n", _NO_VALUE)
    hidden_n = (
        bounds_n[is_unknown] if len(bounds_n) == len(grf_n) and is_unknown.any() else _NO_VALUE
    )
    return ForceSpan(
        seq_first=int(frames.seq[0]),
        seq=int(frames.seq[-1]),
        n=len(frames),
        t_ns_first=int(frames.t_ns[0]),
        t_ns=int(frames.t_ns[-1]),
        grf_n=float(grf_n[-1]),
        grf_min_n=float(np.fmin.reduce(grf_n)),
        grf_max_n=float(np.fmax.reduce(grf_n)),
        grf_lower_bound_max_n=float(np.fmax.reduce(hidden_n)),
    )


def reduce_tiles(columns: Mapping[str, npt.NDArray[Any]], tile_count: int) -> Floats:
    """Return each tile's minimum and maximum of `TILE_QUANTITIES`, (2, quantities, tiles)."""
    found = np.full((2, len(TILE_QUANTITIES), tile_count), np.nan)
    for i, name in enumerate(TILE_QUANTITIES):
        if name in columns:
            np.fmin.reduce(columns[name], axis=0, out=found[0, i])
            np.fmax.reduce(columns[name], axis=0, out=found[1, i])
    return found


def join_tiles(earlier: npt.NDArray[Any], later: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return minima and maxima of `reduce_tiles` for both spans together."""
    found = np.empty_like(earlier)
    np.fmin(earlier[0], later[0], out=found[0])
    np.fmax(earlier[1], later[1], out=found[1])
    return found


class _SpanRing:
    """Ring of the last minute's spans, one for all frames within a period."""

    def __init__(self, row_fields: list[Any], period_ns: int) -> None:
        self.rows = np.zeros(int(SECONDS_MAX * 1e9) // period_ns + 2, np.dtype(row_fields))
        self._period_ns = period_ns
        self._count = 0
        """Number of spans ever begun."""
        self._newest_begin_ns = 0

    def find_or_begin_row(self, t_ns_first: int) -> tuple[int, bool]:
        """Return the index of the row of a span, and whether it begins with this span."""
        begins = not self._count or t_ns_first - self._newest_begin_ns >= self._period_ns
        if begins:
            self._newest_begin_ns = t_ns_first
            self._count += 1
        return (self._count - 1) % len(self.rows), begins

    def get_oldest_first(self) -> npt.NDArray[np.void]:
        """Return a copy of all rows."""
        return self.rows[
            np.arange(max(0, self._count - len(self.rows)), self._count) % len(self.rows)
        ]


class StreamHistory:
    """GRF and tiles over the last minute of a stream.

    Args:
        stream_id: stream of the frames.
        tile_count: number of tiles.
    """

    def __init__(self, stream_id: str, tile_count: int) -> None:
        self.stream_id, self.tile_count = stream_id, tile_count
        numbers = [(name, np.int64) for name in ForceSpan._fields if not name.startswith("grf_")]
        forces = [(name, float) for name in ForceSpan._fields if name.startswith("grf_")]
        self._as_published: deque[ForceSpan] = deque()
        self._forces = _SpanRing([*numbers, *forces], FORCE_SPAN_PERIOD_NS)
        self._tiles = _SpanRing(
            [
                *((name, np.int64) for name in ("seq_first", "seq", "n", "t_ns")),
                ("extremes", np.float16, (2, len(TILE_QUANTITIES), tile_count)),
            ],
            TILE_SPAN_PERIOD_NS,
        )

    def add_span(self, span: ForceSpan, tiles: Floats) -> None:
        """Add frames that are published now, newer than those before.

        Args:
            span: their GRF.
            tiles: their `reduce_tiles`.
        """
        self._as_published.append(span)
        while (
            span.t_ns - self._as_published[0].t_ns > _AS_PUBLISHED_NS
            or len(self._as_published) > _AS_PUBLISHED_MAX
        ):
            older = self._as_published.popleft()
            at, begins = self._forces.find_or_begin_row(older.t_ns_first)
            rows = self._forces.rows
            rows[at] = older if begins else ForceSpan(*rows[at].item()).join(older)
        at, begins = self._tiles.find_or_begin_row(span.t_ns_first)
        row, halves = self._tiles.rows[at], np.clip(tiles, -_HALF_MAX, _HALF_MAX).astype(np.float16)
        if begins:
            row["seq_first"], row["n"], row["extremes"] = span.seq_first, span.n, halves
        else:
            row["n"] += span.n
            row["extremes"] = join_tiles(row["extremes"], halves)
        row["seq"], row["t_ns"] = span.seq, span.t_ns

    def get_force_spans(
        self, seconds: float, before_seq: int | None = None
    ) -> npt.NDArray[np.void]:
        """Return the newest seconds of GRF, with the fields of `ForceSpan`, oldest first.

        Args:
            seconds: counted back from the newest selected span.
            before_seq: only spans that begin before this number.
        """
        newest = np.array(list(self._as_published), self._forces.rows.dtype)
        rows = np.concatenate([self._forces.get_oldest_first(), newest])
        return _select_newest(rows, seconds, before_seq)

    def get_tile_spans(self, seconds: float, before_seq: int | None = None) -> npt.NDArray[np.void]:
        """Return the newest seconds of tiles, as `get_force_spans`.

        Fields are `seq_first`, `seq`, `n` and `t_ns` as of `ForceSpan`, and `extremes` as of
        `reduce_tiles`.
        """
        return _select_newest(self._tiles.get_oldest_first(), seconds, before_seq)


def _select_newest(
    rows: npt.NDArray[np.void], seconds: float, before_seq: int | None
) -> npt.NDArray[np.void]:
    keep = np.asarray(rows["seq_first"] < (NO_END if before_seq is None else before_seq))
    if keep.any():
        keep &= rows["t_ns"] > rows["t_ns"][keep][-1] - int(seconds * 1e9)
    return rows[keep]


SUMMARY_NS = 1_000_000_000
"""Longest time in a summary; older frames are reported as dropped."""
_NOTICES_MAX = 256

# Decimal places: finer than the measurement.
_DIGITS = {"kpa": 4, "n": 4, "m": 6, "rad": 5}
_PER_TILE = (("gauge_kpa", "kpa"), ("force_n", "n"), ("force_sigma_n", "n"))
_PER_FRAME = (
    ("grf_n", "n"),
    ("grf_sigma_n", "n"),
    ("grf_lower_bound_n", "n"),
    ("cop_x_m", "m"),
    ("cop_y_m", "m"),
    ("cop_sigma_x_m", "m"),
    ("cop_sigma_y_m", "m"),
    ("angle_rad", "rad"),
)


@dataclass(frozen=True)
class FrameSummary:
    """Summary of consecutive frames of one stream.

    Attributes:
        stream_id: stream of the frames.
        span: their GRF.
        tiles: minimum and maximum of each tile, from `reduce_tiles`.
        newest: estimates of the newest frame, for the message.
    """

    stream_id: str
    span: ForceSpan
    tiles: Floats
    newest: Mapping[str, Any]

    def join_extremes(self, later: FrameSummary) -> FrameSummary:
        """Return this summary and a later one as one."""
        return FrameSummary(
            self.stream_id,
            self.span.join(later.span),
            join_tiles(self.tiles, later.tiles),
            later.newest,
        )


@dataclass(frozen=True)
class Update:
    """Content of one tick."""

    notices: tuple[str, ...]
    progress_by_session: Mapping[str, SessionProgress]
    dropped: Mapping[str, Intervals]
    summaries: Mapping[str, FrameSummary]

    def encode_messages(self, ages_ms: Mapping[str, float]) -> list[str]:
        """Encode the update as messages.

        Args:
            ages_ms: age of the newest frame, by node, where known.
        """
        texts = []
        if self.progress_by_session:  # before the notice of a sealed session with its final numbers
            texts.append(encode_message(SessionsProgress(sessions={**self.progress_by_session})))
        texts += self.notices
        for node, dropped in self.dropped.items():
            for first, last in dropped:
                texts.append(encode_message(FramesDropped(node=node, from_seq=first, to_seq=last)))
        for node, piece in self.summaries.items():
            texts.append(encode_message(_make_frame_message(node, piece, ages_ms.get(node))))
        return texts


class PendingUpdate:
    """Content that is still to be sent; its size does not grow with time.

    Args:
        node_filter: node of interest; None: all.
    """

    def __init__(self, node_filter: str | None = None) -> None:
        self._node_filter = node_filter
        self._summaries: dict[str, FrameSummary] = {}
        self._last_seq: dict[str, tuple[str, int]] = {}
        self._dropped: dict[str, Intervals] = {}
        self._notices: deque[str] = deque(maxlen=_NOTICES_MAX)
        self._progress_by_session: dict[str, SessionProgress] = {}

    def __bool__(self) -> bool:
        """Return whether there is anything to send."""
        return bool(self._summaries or self._notices or self._progress_by_session or self._dropped)

    def add_notice(self, message: str) -> None:
        """Add a message for all; the oldest are dropped if they are not sent."""
        self._notices.append(message)

    def join_summary_or_drop_older(self, node: str, summary: FrameSummary) -> None:
        """Merge the summary of newer frames of a node, unless it is filtered out."""
        if self._node_filter not in (None, node):
            return
        span = summary.span
        stream_id, last_seq = self._last_seq.get(node, (summary.stream_id, span.seq_first - 1))
        if stream_id == summary.stream_id and span.seq_first > last_seq + 1:
            self._add_dropped(node, last_seq + 1, span.seq_first - 1)
        self._last_seq[node] = (summary.stream_id, span.seq)
        before = self._summaries.get(node)
        if before is not None:
            short = 0 <= span.t_ns - before.span.t_ns_first < SUMMARY_NS
            if short and before.stream_id == summary.stream_id:
                summary = before.join_extremes(summary)
            else:
                self._add_dropped(node, before.span.seq_first, before.span.seq)
        self._summaries[node] = summary

    def add_progress(self, node: str, progress_by_session: Mapping[str, SessionProgress]) -> None:
        """Add the progress of sessions of a node, unless it is filtered out; the newest is sent."""
        if self._node_filter in (None, node):
            self._progress_by_session |= progress_by_session

    def pop_update(self) -> Update:
        """Remove and return the content."""
        news = Update(
            tuple(self._notices), self._progress_by_session, self._dropped, self._summaries
        )
        self._notices.clear()
        self._progress_by_session, self._dropped, self._summaries = {}, {}, {}
        return news

    def add_update(self, update: Update) -> None:
        """Add an update that is newer than the present content."""
        self._notices.extend(update.notices)
        self._progress_by_session |= update.progress_by_session
        for node, dropped in update.dropped.items():
            for first, last in dropped:
                self._add_dropped(node, first, last)
        for node, piece in update.summaries.items():
            self.join_summary_or_drop_older(node, piece)

    def _add_dropped(self, node: str, seq_first: int, seq_last: int) -> None:
        # Frames missed for hours are one interval, not a growing list.
        self._dropped.setdefault(node, Intervals()).add(seq_first, seq_last)


def _make_frame_message(node: str, summary: FrameSummary, age_ms: float | None) -> FrameMessage:
    (force_min_n, gauge_min_kpa), (force_max_n, gauge_max_kpa) = summary.tiles
    return FrameMessage(
        node=node,
        seq_first=summary.span.seq_first,
        seq=summary.span.seq,
        t_ns=summary.span.t_ns,
        n=summary.span.n,
        **summary.newest,
        gauge_min_kpa=round_values(gauge_min_kpa, "kpa"),
        gauge_max_kpa=round_values(gauge_max_kpa, "kpa"),
        force_min_n=round_values(force_min_n, "n"),
        force_max_n=round_values(force_max_n, "n"),
        grf_min_n=round_value(summary.span.grf_min_n, "n"),
        grf_max_n=round_value(summary.span.grf_max_n, "n"),
        grf_lower_bound_max_n=round_value(summary.span.grf_lower_bound_max_n, "n"),
        age_ms=None if age_ms is None else round(age_ms, 1),
    )


def summarize_frames(
    stream_id: str,
    span: ForceSpan,
    tiles: Floats,
    frames: FrameBatch,
    columns: Mapping[str, npt.NDArray[Any]],
) -> FrameSummary:
    """Return frames and their estimates, which may be none, as a summary.

    Args:
        stream_id: stream of the frames.
        span: GRF over the same frames.
        tiles: minimum and maximum of each tile, from `reduce_tiles`.
        frames: n frames.
        columns: their estimates by name.
    """
    newest: dict[str, Any] = {
        "tile_flags": frames.tile_flags[-1].tolist(),
        "frame_flags": int(frames.frame_flags[-1]),
        "servo_age_us": int(frames.servo_age_us[-1]) if frames.servo_age_us[-1] >= 0 else None,
    }
    unknown = np.full((1, frames.tile_count), np.nan)
    for name, unit in _PER_TILE:
        newest[name] = round_values(columns.get(name, unknown)[-1], unit)
    for name, unit in _PER_FRAME:
        newest[name] = round_value(float(columns.get(name, unknown[:, 0])[-1]), unit)
    contact = int(columns["contact"][-1]) if "contact" in columns else CONTACT_UNKNOWN
    newest["contact"] = None if contact == CONTACT_UNKNOWN else bool(contact)
    newest["estimate_flags"] = (
        int(columns["estimate_flags"][-1]) if "estimate_flags" in columns else 0
    )
    force_n = columns.get("force_n", unknown)
    # A lower bound is a force without an uncertainty.
    sigma_n = columns.get("force_sigma_n", np.zeros((1, frames.tile_count)))
    newest["saturated"] = (np.isfinite(force_n[-1]) & np.isnan(sigma_n[-1])).tolist()
    return FrameSummary(stream_id, span, tiles, newest)


def round_values(values: npt.NDArray[Any], unit: str) -> list[float | None]:
    """Round numbers for JSON; non-finite values become None."""
    return [
        number if math.isfinite(number) else None for number in values.round(_DIGITS[unit]).tolist()
    ]


def round_value(value: float, unit: str) -> float | None:
    """Round a number for JSON; a non-finite value becomes None."""
    return round(value, _DIGITS[unit]) if math.isfinite(value) else None
