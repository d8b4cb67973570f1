"""When the frames at the ends of what a journal holds were taken: what comes between has to fit.

Frames come newest first and from behind, so what a message has to follow, or to precede, may be far
away in the files. Only the ends of what is held count, and they are looked up once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from devices.frames import FrameBatch
from storage.frame_rules import runs_back
from storage.intervals import Intervals
from storage.wire import EncodedBatch


class Instants:
    """Of one journal.

    Args:
        look_up: node's UTC of a number that is held and ends an interval; True: its upper end.
    """

    def __init__(self, look_up: Callable[[int, bool], int | None]) -> None:
        self._look_up = look_up
        self._known: dict[tuple[int, bool], int | None] = {}
        """By number and whether it is an upper end: a batch of one frame is both."""

    def note(self, message: EncodedBatch, held: Intervals) -> None:
        """A message was written, and is among what is held."""
        known, first, last = self._known, message.seq_first, message.seq_last
        known[first, False], known[last, True] = message.t_ns_first, message.t_ns_last
        before, after = held.neighbours(first, last)
        if before == first - 1:  # joined to it: neither is an end any more
            known.pop((first - 1, True), None)
            known.pop((first, False), None)
        if after == last + 1:
            known.pop((last + 1, False), None)
            known.pop((last, True), None)

    def forget(self) -> None:
        """Some of what was held is not any more: look again."""
        self._known.clear()

    def misplaced(self, frames: FrameBatch, held: Intervals) -> str:
        """Why frames cannot stand among those that are held, in words; empty if they can.

        Args:
            frames: of one message; those that are held already do not count.
            held: numbers in the journal.
        """
        first, last = int(frames.seq[0]), int(frames.seq[-1])
        for a, b in held.missing(first, last):
            before, after = held.neighbours(a, b)
            begin_ns, end_ns = int(frames.t_ns[a - first]), int(frames.t_ns[b - first])
            before_ns = None if before is None else self._at(before, is_upper=True)
            after_ns = None if after is None else self._at(after, is_upper=False)
            spans = [
                *([] if before_ns is None else [(before_ns, before_ns, before)]),
                (begin_ns, end_ns, a),
                *([] if after_ns is None else [(after_ns, after_ns, after)]),
            ]
            begins, ends, seqs = zip(*spans, strict=True)
            back = runs_back(np.array(begins, np.int64), np.array(ends, np.int64))
            if len(back):
                return f"time runs back before frame {seqs[back[0]]}"
        return ""

    def _at(self, seq: int, *, is_upper: bool) -> int | None:
        end = seq, is_upper
        if end not in self._known:
            self._known[end] = self._look_up(*end)
        return self._known[end]
