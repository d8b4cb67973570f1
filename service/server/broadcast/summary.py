"""Summaries of frames for live pages.

Frames between two ticks are merged into one summary per node, so a slow subscriber costs no more
than a fast one. Minimum and maximum of skipped frames are in every message, so that no peak hides.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.frames import FrameBatch
from service.estimation.foot import CONTACT_UNKNOWN
from service.protocol.codec import encode_message
from service.protocol.live import FrameMessage, FramesDropped, SessionProgress, SessionsProgress
from service.server.broadcast.history import ForceSpan, join_tiles
from storage.intervals import Intervals

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
