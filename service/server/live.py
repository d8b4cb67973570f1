"""The live picture for screens: each subscriber gets the newest frame, and what lay between.

A subscriber is asked for a message at its own pace; until then everything is summed up in one
summary per node, so a client that never reads delays nobody and grows nothing. Minimum and maximum
of what was skipped go with every message, so that no peak hides.
"""

from __future__ import annotations

import asyncio
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
from service.estimation.foot.contact import UNKNOWN
from service.server.node import Estimated, ServerNode
from storage.intervals import Intervals

SUMMARY_NS = 1_000_000_000
"""A message sums up a second at most; older frames are reported as dropped."""
_NOTICES_MAX = 256

# Digits that are finer than what is measured, and no more.
_DIGITS = {"kpa": 4, "n": 4, "m": 6, "rad": 5}
_PER_TILE = ("gauge_kpa", "force_n", "force_sigma_n")
_PER_FRAME = (
    *("grf_n", "grf_sigma_n", "cop_x_m", "cop_y_m", "cop_sigma_x_m", "cop_sigma_y_m"),
    "angle_rad",
)


@dataclass(frozen=True)
class Piece:
    """Some consecutive frames of one node, summed up once for all subscribers.

    Arrays are over tiles; NaN where nothing is known.
    """

    seq_first: int
    seq_last: int
    n: int
    t_ns_first: int
    t_ns: int
    newest: Mapping[str, Any]
    gauge_min_kpa: Floats
    gauge_max_kpa: Floats
    force_min_n: Floats
    force_max_n: Floats
    grf_min_n: float
    grf_max_n: float

    def joined(self, later: Piece) -> Piece:
        """This piece and a later one as one."""
        return Piece(
            seq_first=self.seq_first,
            seq_last=later.seq_last,
            n=self.n + later.n,
            t_ns_first=self.t_ns_first,
            t_ns=later.t_ns,
            newest=later.newest,
            gauge_min_kpa=np.fmin(self.gauge_min_kpa, later.gauge_min_kpa),
            gauge_max_kpa=np.fmax(self.gauge_max_kpa, later.gauge_max_kpa),
            force_min_n=np.fmin(self.force_min_n, later.force_min_n),
            force_max_n=np.fmax(self.force_max_n, later.force_max_n),
            grf_min_n=min_of(self.grf_min_n, later.grf_min_n),
            grf_max_n=-min_of(-self.grf_max_n, -later.grf_max_n),
        )


class Subscriber:
    """What one client is still to be sent.

    Args:
        only: the node it wants to see; None: all.
    """

    def __init__(self, only: str | None = None) -> None:
        self._only = only
        self._pieces: dict[str, Piece] = {}
        self._last_seq: dict[str, tuple[str, int]] = {}
        self._dropped: dict[str, Intervals] = {}
        self._notices: deque[str] = deque(maxlen=_NOTICES_MAX)
        self._counted: dict[str, Mapping[str, Any]] = {}
        self.news = asyncio.Event()

    def notice(self, message: str) -> None:
        """A message for every client; the oldest are forgotten by one that never reads."""
        self._notices.append(message)
        self.news.set()

    def add(self, node: ServerNode, piece: Piece) -> None:
        """More frames of a node."""
        key = node.name
        if self._only not in (None, key):
            return
        boot_id, last_seq = self._last_seq.get(key, (node.boot_id, piece.seq_first - 1))
        if boot_id == node.boot_id and piece.seq_first > last_seq + 1:
            self._drop(key, last_seq + 1, piece.seq_first - 1)
        self._last_seq[key] = (node.boot_id, piece.seq_last)
        before = self._pieces.get(key)
        if before is not None:
            short = 0 <= piece.t_ns - before.t_ns_first < SUMMARY_NS
            if short and boot_id == node.boot_id:
                piece = before.joined(piece)
            else:
                self._drop(key, before.seq_first, before.seq_last)
        self._pieces[key] = piece
        self.news.set()

    def count(self, node: str, counted: Mapping[str, Mapping[str, Any]]) -> None:
        """What sessions of a node have come to, by id; of each only the newest word is told."""
        if self._only in (None, node):
            self._counted |= counted
            self.news.set()

    def answer(self, message: Mapping[str, Any]) -> None:
        """A message for this client only."""
        self.notice(dumps(message))

    def take(self, ages_ms: Mapping[str, float], encoder: Encoder) -> list[str]:
        """Everything there is to tell now, as texts.

        Args:
            ages_ms: age of the newest frame by node, where it is known.
            encoder: makes frame messages.
        """
        self.news.clear()
        texts = list(self._notices)
        self._notices.clear()
        if self._counted:
            texts.append(dumps({"type": "counted", "sessions": self._counted}))
            self._counted = {}
        for node, dropped in self._dropped.items():
            for first, last in dropped:
                message = {"type": "dropped", "node": node, "from_seq": first, "to_seq": last}
                texts.append(dumps(message))
        self._dropped.clear()
        for name, piece in self._pieces.items():
            texts.append(encoder.encode(name, piece, ages_ms.get(name)))
        self._pieces.clear()
        return texts

    def _drop(self, node: str, seq_first: int, seq_last: int) -> None:
        # What a client misses for hours is one interval, not a list that grows.
        self._dropped.setdefault(node, Intervals()).add(seq_first, seq_last)
        self.news.set()


class Encoder:
    """Frame messages as text; subscribers that are told the same share one text."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[tuple[object, ...], str]] = {}

    def encode(self, node: str, piece: Piece, age_ms: float | None) -> str:
        """One frame message."""
        age = None if age_ms is None else round(age_ms, 1)
        key = (piece.seq_first, piece.seq_last, piece.t_ns, age)
        known = self._last.get(node)
        if known is not None and known[0] == key:
            return known[1]
        text = dumps(
            {
                "type": "frame",
                "node": node,
                "seq": piece.seq_last,
                "t_ns": piece.t_ns,
                "n": piece.n,
                **piece.newest,
                "gauge_min_kpa": rounded(piece.gauge_min_kpa, "kpa"),
                "gauge_max_kpa": rounded(piece.gauge_max_kpa, "kpa"),
                "force_min_n": rounded(piece.force_min_n, "n"),
                "force_max_n": rounded(piece.force_max_n, "n"),
                "grf_min_n": one(piece.grf_min_n, "n"),
                "grf_max_n": one(piece.grf_max_n, "n"),
                "age_ms": age,
            }
        )
        self._last[node] = (key, text)
        return text


class Hub:
    """All subscribers of a server."""

    def __init__(self) -> None:
        self.encoder = Encoder()
        self._subscribers: set[Subscriber] = set()

    @property
    def subscribers(self) -> int:
        """How many there are."""
        return len(self._subscribers)

    def join(self, only: str | None = None) -> Subscriber:
        """A new subscriber, told what happens from now on, on all nodes or `only` one."""
        subscriber = Subscriber(only)
        self._subscribers.add(subscriber)
        return subscriber

    def leave(self, subscriber: Subscriber) -> None:
        """Forget a subscriber."""
        self._subscribers.discard(subscriber)

    def notice(self, message: Mapping[str, Any]) -> None:
        """Tell everybody."""
        if self._subscribers:
            text = dumps(message)
            for subscriber in self._subscribers:
                subscriber.notice(text)

    def count(self, node: str, counted: Mapping[str, Mapping[str, Any]]) -> None:
        """Tell everybody what sessions of a node have come to, by id."""
        for subscriber in self._subscribers:
            subscriber.count(node, counted)

    def publish(self, node: ServerNode, due: list[Estimated]) -> None:
        """Frames of a node with their estimates."""
        for frames, columns in due:
            node.shown_t_ns = int(frames.t_ns[-1])
            piece = sum_up(node.live.range_kpa, frames, columns)
            for subscriber in self._subscribers:
                subscriber.add(node, piece)


def sum_up(
    range_kpa: Floats | None, frames: FrameBatch, columns: Mapping[str, npt.NDArray[Any]]
) -> Piece:
    """Frames and their estimates, which may be none, as a piece.

    Args:
        range_kpa: end of each tile's calibrated range, above which it is saturated.
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
    for name in _PER_TILE:
        newest[name] = rounded(columns.get(name, unknown)[-1], name.rsplit("_", 1)[1])
    for name in _PER_FRAME:
        newest[name] = one(float(columns.get(name, unknown[:, 0])[-1]), name.rsplit("_", 1)[1])
    contact = int(columns["contact"][-1]) if "contact" in columns else UNKNOWN
    newest["contact"] = None if contact == UNKNOWN else bool(contact)
    newest["estimate_status"] = (
        int(columns["estimate_status"][-1]) if "estimate_status" in columns else 0
    )
    newest["saturated"] = (
        (columns["gauge_kpa"][-1] > range_kpa).tolist()
        if range_kpa is not None and "gauge_kpa" in columns
        else [False] * tiles
    )
    gauge_kpa = columns.get("gauge_kpa", unknown)
    force_n = columns.get("force_n", unknown)
    grf_n = columns.get("grf_n", unknown[:, 0])
    return Piece(
        seq_first=int(frames.seq[0]),
        seq_last=int(frames.seq[-1]),
        n=len(frames),
        t_ns_first=int(frames.t_ns[0]),
        t_ns=int(frames.t_ns[-1]),
        newest=newest,
        gauge_min_kpa=np.fmin.reduce(gauge_kpa, axis=0),
        gauge_max_kpa=np.fmax.reduce(gauge_kpa, axis=0),
        force_min_n=np.fmin.reduce(force_n, axis=0),
        force_max_n=np.fmax.reduce(force_n, axis=0),
        grf_min_n=float(np.fmin.reduce(grf_n)),
        grf_max_n=float(np.fmax.reduce(grf_n)),
    )


def rounded(values: npt.NDArray[Any], unit: str) -> list[float | None]:
    """Numbers for a screen; what is not finite is null."""
    return [one(value, unit) for value in values.tolist()]


def one(value: float, unit: str) -> float | None:
    """One number for a screen; what is not finite is null."""
    return round(value, _DIGITS[unit]) if math.isfinite(value) else None


def min_of(a: float, b: float) -> float:
    """The smaller of two numbers; NaN does not count as a number."""
    return b if math.isnan(a) else a if math.isnan(b) else min(a, b)


def dumps(message: Mapping[str, Any]) -> str:
    """Compact JSON; NaN has no place in it."""
    return json.dumps(message, separators=(",", ":"), allow_nan=False)
