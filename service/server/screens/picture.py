"""What screens are told: the newest frame of each node, the peaks of all since, and what was not.

Until it is told, everything is summed up in one piece per node: who is told rarely, or never, costs
no more than who is told often. Minimum and maximum of what was skipped go with every message, so
that no peak hides.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.frames import FrameBatch
from service.estimation.foot import UNKNOWN
from service.server.screens.spans import Span
from storage.intervals import Intervals

SUMMARY_NS = 1_000_000_000
"""A message sums up a second at most; older frames are reported as dropped."""
_NOTICES_MAX = 256

# Digits that are finer than what is measured, and no more.
_DIGITS = {"kpa": 4, "n": 4, "m": 6, "rad": 5}
_PER_TILE = (("gauge_kpa", "kpa"), ("force_n", "n"), ("force_sigma_n", "n"))
_PER_FRAME = (
    ("grf_n", "n"),
    ("grf_sigma_n", "n"),
    ("grf_at_least_n", "n"),
    ("cop_x_m", "m"),
    ("cop_y_m", "m"),
    ("cop_sigma_x_m", "m"),
    ("cop_sigma_y_m", "m"),
    ("angle_rad", "rad"),
)
# Made once: `json.dumps` would make one for each message.
_ENCODER = json.JSONEncoder(separators=(",", ":"), allow_nan=False)


@dataclass(frozen=True)
class Piece:
    """Some consecutive frames of one stream, summed up once for all screens.

    Arrays are over tiles; NaN where nothing is known.
    """

    boot_id: str
    span: Span
    newest: Mapping[str, Any]
    gauge_min_kpa: Floats
    gauge_max_kpa: Floats
    force_min_n: Floats
    force_max_n: Floats

    def joined(self, later: Piece) -> Piece:
        """This piece and a later one as one."""
        return Piece(
            boot_id=self.boot_id,
            span=self.span.joined(later.span),
            newest=later.newest,
            gauge_min_kpa=np.fmin(self.gauge_min_kpa, later.gauge_min_kpa),
            gauge_max_kpa=np.fmax(self.gauge_max_kpa, later.gauge_max_kpa),
            force_min_n=np.fmin(self.force_min_n, later.force_min_n),
            force_max_n=np.fmax(self.force_max_n, later.force_max_n),
        )


@dataclass(frozen=True)
class News:
    """What is to be told at one time."""

    notices: tuple[str, ...]
    counted: Mapping[str, Mapping[str, Any]]
    dropped: Mapping[str, Intervals]
    pieces: Mapping[str, Piece]

    def texts(self, ages_ms: Mapping[str, float]) -> list[str]:
        """As messages.

        Args:
            ages_ms: how old the newest frame is, by node, where that is known.
        """
        texts = []
        if self.counted:  # before a session is told as sealed, with its final numbers
            texts.append(dumps({"type": "counted", "sessions": self.counted}))
        texts += self.notices
        for node, dropped in self.dropped.items():
            for first, last in dropped:
                message = {"type": "dropped", "node": node, "from_seq": first, "to_seq": last}
                texts.append(dumps(message))
        for node, piece in self.pieces.items():
            texts.append(dumps(_frame(node, piece, ages_ms.get(node))))
        return texts


class Summary:
    """What is still to be told; it does not grow with time.

    Args:
        only: the node that is of interest; None: all.
    """

    def __init__(self, only: str | None = None) -> None:
        self._only = only
        self._pieces: dict[str, Piece] = {}
        self._last_seq: dict[str, tuple[str, int]] = {}
        self._dropped: dict[str, Intervals] = {}
        self._notices: deque[str] = deque(maxlen=_NOTICES_MAX)
        self._counted: dict[str, Mapping[str, Any]] = {}

    def __bool__(self) -> bool:
        """Is there anything?"""
        return bool(self._pieces or self._notices or self._counted or self._dropped)

    def notice(self, message: str) -> None:
        """A message for everybody; the oldest are forgotten if nobody takes them."""
        self._notices.append(message)

    def add(self, node: str, piece: Piece) -> None:
        """More frames of a node."""
        if self._only not in (None, node):
            return
        span = piece.span
        boot_id, last_seq = self._last_seq.get(node, (piece.boot_id, span.seq_first - 1))
        if boot_id == piece.boot_id and span.seq_first > last_seq + 1:
            self._drop(node, last_seq + 1, span.seq_first - 1)
        self._last_seq[node] = (piece.boot_id, span.seq)
        before = self._pieces.get(node)
        if before is not None:
            short = 0 <= span.t_ns - before.span.t_ns_first < SUMMARY_NS
            if short and before.boot_id == piece.boot_id:
                piece = before.joined(piece)
            else:
                self._drop(node, before.span.seq_first, before.span.seq)
        self._pieces[node] = piece

    def count(self, node: str, counted: Mapping[str, Mapping[str, Any]]) -> None:
        """What sessions of a node have come to, by id; of each only the newest word is told."""
        if self._only in (None, node):
            self._counted |= counted

    def take(self) -> News:
        """All there is, which is then told."""
        news = News(tuple(self._notices), self._counted, self._dropped, self._pieces)
        self._notices.clear()
        self._counted, self._dropped, self._pieces = {}, {}, {}
        return news

    def join(self, news: News) -> None:
        """What was taken, and could not be told."""
        self._notices.extend(news.notices)
        self._counted |= news.counted
        for node, dropped in news.dropped.items():
            for first, last in dropped:
                self._drop(node, first, last)
        for node, piece in news.pieces.items():
            self.add(node, piece)

    def _drop(self, node: str, seq_first: int, seq_last: int) -> None:
        # What a screen misses for hours is one interval, not a list that grows.
        self._dropped.setdefault(node, Intervals()).add(seq_first, seq_last)


def _frame(node: str, piece: Piece, age_ms: float | None) -> dict[str, Any]:
    return {
        "type": "frame",
        "node": node,
        "seq_first": piece.span.seq_first,
        "seq": piece.span.seq,
        "t_ns": piece.span.t_ns,
        "n": piece.span.n,
        **piece.newest,
        "gauge_min_kpa": rounded(piece.gauge_min_kpa, "kpa"),
        "gauge_max_kpa": rounded(piece.gauge_max_kpa, "kpa"),
        "force_min_n": rounded(piece.force_min_n, "n"),
        "force_max_n": rounded(piece.force_max_n, "n"),
        "grf_min_n": one(piece.span.grf_min_n, "n"),
        "grf_max_n": one(piece.span.grf_max_n, "n"),
        "grf_at_least_max_n": one(piece.span.grf_at_least_max_n, "n"),
        "age_ms": None if age_ms is None else round(age_ms, 1),
    }


def sum_up(
    boot_id: str,
    span: Span,
    frames: FrameBatch,
    columns: Mapping[str, npt.NDArray[Any]],
) -> Piece:
    """Frames and their estimates, which may be none, as a piece.

    Args:
        boot_id: the stream that they are of.
        span: of the same frames.
        frames: n frames.
        columns: their estimates by name.
    """
    tiles = frames.tile_count
    newest: dict[str, Any] = {
        "status": frames.status[-1].tolist(),
        "frame_status": int(frames.frame_status[-1]),
        "servo_age_us": int(frames.servo_age_us[-1]) if frames.servo_age_us[-1] >= 0 else None,
    }
    unknown = np.full((1, tiles), np.nan)
    for name, unit in _PER_TILE:
        newest[name] = rounded(columns.get(name, unknown)[-1], unit)
    for name, unit in _PER_FRAME:
        newest[name] = one(float(columns.get(name, unknown[:, 0])[-1]), unit)
    contact = int(columns["contact"][-1]) if "contact" in columns else UNKNOWN
    newest["contact"] = None if contact == UNKNOWN else bool(contact)
    newest["estimate_status"] = (
        int(columns["estimate_status"][-1]) if "estimate_status" in columns else 0
    )
    gauge_kpa = columns.get("gauge_kpa", unknown)
    force_n = columns.get("force_n", unknown)
    # A lower bound is a force without an uncertainty.
    sigma_n = columns.get("force_sigma_n", np.zeros((1, tiles)))
    newest["saturated"] = (np.isfinite(force_n[-1]) & np.isnan(sigma_n[-1])).tolist()
    return Piece(
        boot_id=boot_id,
        span=span,
        newest=newest,
        gauge_min_kpa=np.fmin.reduce(gauge_kpa, axis=0),
        gauge_max_kpa=np.fmax.reduce(gauge_kpa, axis=0),
        force_min_n=np.fmin.reduce(force_n, axis=0),
        force_max_n=np.fmax.reduce(force_n, axis=0),
    )


def rounded(values: npt.NDArray[Any], unit: str) -> list[float | None]:
    """Numbers for a screen; what is not finite is null."""
    return [
        number if math.isfinite(number) else None for number in values.round(_DIGITS[unit]).tolist()
    ]


def one(value: float, unit: str) -> float | None:
    """One number for a screen; what is not finite is null."""
    return round(value, _DIGITS[unit]) if math.isfinite(value) else None


def dumps(message: Mapping[str, Any]) -> str:
    """Compact JSON; NaN has no place in it."""
    return _ENCODER.encode(message)
