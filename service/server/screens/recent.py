"""GRF of a node over the last minute, for a page that is opened now.

Spans with minimum and maximum, so that no peak hides. The newest ones are kept as they were
published, so that live messages continue them without a seam; older ones are merged. Memory is
bounded: 130 kB, and 50 kB for the newest.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

from service.server.screens.spans import Span

SECONDS_MAX = 60.0
APART_NS = 1_000_000_000 // 30
"""Least distance between the begins of merged spans: no plot of a minute is finer."""
_AS_TOLD_NS = 2_000_000_000
_AS_TOLD_MAX = 128
_OLDER_MAX = int(SECONDS_MAX * 1e9) // APART_NS + 2
_ROW = np.dtype(
    [
        *((name, np.int64) for name in ("seq_first", "seq", "n", "t_ns_first", "t_ns")),
        *((name, float) for name in Span._fields if name.startswith("grf_")),
    ]
)


class Recent:
    """GRF over the last minute of a node's present stream."""

    def __init__(self) -> None:
        self.boot_id = ""
        self._as_told: deque[Span] = deque()
        self._joined: Span | None = None
        """Newest merged span, to which more may be added."""
        self._older = np.zeros(_OLDER_MAX, _ROW)
        self._count = 0
        """Number of spans ever written to the ring `_merged`."""

    def add(self, boot_id: str, span: Span) -> None:
        """Add frames that are published now.

        Args:
            boot_id: stream of the frames; another one clears the history.
            span: newer than those before.
        """
        if boot_id != self.boot_id:
            self.boot_id, self._joined, self._count = boot_id, None, 0
            self._as_told.clear()
        self._as_told.append(span)
        while span.t_ns - self._as_told[0].t_ns > _AS_TOLD_NS or len(self._as_told) > _AS_TOLD_MAX:
            self._join(self._as_told.popleft())

    def rows(self, seconds: float, before_seq: int | None = None) -> npt.NDArray[np.void]:
        """Return the newest seconds, with the fields of `Span`, oldest first.

        Args:
            seconds: counted back from the newest frame.
            before_seq: only spans that end before this number.
        """
        first = max(0, self._count - _OLDER_MAX)
        older = self._older[np.arange(first, self._count) % _OLDER_MAX]
        newer = [*([] if self._joined is None else [self._joined]), *self._as_told]
        rows = np.concatenate([older, np.array(newer, _ROW)])
        if before_seq is not None:
            rows = rows[rows["seq"] < before_seq]
        if len(rows):
            rows = rows[rows["t_ns"] > rows["t_ns"][-1] - int(seconds * 1e9)]
        return rows

    def _join(self, span: Span) -> None:
        before = self._joined
        if before is not None:
            if span.t_ns_first - before.t_ns_first < APART_NS:
                self._joined = before.joined(span)
                return
            self._older[self._count % _OLDER_MAX] = before
            self._count += 1
        self._joined = span
