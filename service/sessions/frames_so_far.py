"""Frames of an unsealed session with their estimates: a slice, or all.

The cost of a slice does not depend on its place, up to the newest checkpoint. A frame's estimate
does not depend on the slice: it is that of one run over all present frames.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import Any

from devices.errors import UsageError
from devices.frames import FrameBatch
from service.sessions.frames import Columns, raw_from
from service.sessions.so_far import SoFar
from service.sessions.sources import Sources
from storage.formats.export import Content, content_of
from storage.formats.slice import Slice
from storage.intervals import NO_END
from storage.schema import ROUNDED_TO
from storage.sessions.time_axis import NODE_AXIS

Pieces = Iterator[tuple[FrameBatch, Columns]]


class FramesSoFar:
    """Slice of an unsealed session.

    Args:
        so_far: preview of the session.
        sources: present inputs.
        part: time interval.

    Attributes:
        notes: file metadata of the estimates; known after `content`.
    """

    def __init__(self, so_far: SoFar, sources: Sources, part: Slice) -> None:
        self.notes: dict[str, Any] = {}
        self._milestones = so_far.milestones
        self._places = so_far.places(sources)
        self._sources = sources
        self._part = part
        self._axis = NODE_AXIS

    def content(self) -> Content:
        """Return the frames, with estimates if there are any; reads the first ones.

        Raises:
            UsageError: there are no frames.
        """
        first = next(raw_from(self._sources), None)
        if first is None:
            raise UsageError("the session has no frames")
        self._axis = self._sources.time_axis()
        span_ns = int(first[0].t_ns[0]), self._latest_ns()
        begin_ns, end_ns = self._part.bounds_ns(span_ns[0])
        legs = self._legs(begin_ns, end_ns)
        pieces = chain.from_iterable(self._run(*leg, end_ns) for leg in legs)
        some = next(pieces, None)
        if some is None:  # no frame in the interval: use the columns of the first ones
            some = next(self._run(0, 1, None))
        return content_of(chain((some,), pieces), span_ns, self._axis)

    def _legs(self, begin_ns: int | None, end_ns: int | None) -> list[tuple[int, int]]:
        """Return the ranges of checkpoints with frames of an interval; the last one is open."""
        newest = len(self._places) - 1
        wanted = [
            index
            for index, place in enumerate(self._places[:newest])
            if place.left < self._places[index + 1].left
            and self._axis.may_overlap(place.begin_ns, place.end_ns, begin_ns, end_ns)
        ]
        last = self._places[newest].last
        # Frames without an estimate are newer than the last one with one, or of a later part.
        if end_ns is None or last is None or self._is_before(*last, end_ns):
            wanted.append(newest)
        legs: list[tuple[int, int]] = []
        for index in wanted:
            begin = legs.pop()[0] if legs and legs[-1][1] == index else index
            legs.append((begin, index + 1))
        return legs

    def _run(self, begin: int, end: int, end_ns: int | None) -> Pieces:
        """Yield the frames between two checkpoints, with estimates, up to an end time."""
        places = self._places
        end_count = places[end].left if end < len(places) else NO_END
        start, stream = self._milestones.stream_at(places, begin, self._sources)
        ahead, count = places[begin].left - places[start].left, end_count - places[start].left
        pieces: Pieces = raw_from(self._sources, places[start].part, places[start].seq)
        if stream is not None:
            pieces = stream.run(pieces)
        for frames, columns in pieces:
            if stream is not None and not self.notes:
                self.notes = {ROUNDED_TO: stream.rounding.by_column()}
            rows = slice(ahead, min(count, len(frames)))
            ahead, count = max(0, ahead - len(frames)), count - len(frames)
            if rows.start < rows.stop:
                whole = rows.stop - rows.start == len(frames)
                yield (frames, columns) if whole else _cut(frames, columns, rows)
            part = int(columns["part"][-1])
            if count <= 0:
                return
            if end_ns is not None and not self._is_before(part, int(frames.t_ns[-1]), end_ns):
                return

    def _is_before(self, part: int, t_ns: int, end_ns: int) -> bool:
        """Return whether a frame, or a later one, may be before a time of the time axis."""
        return min(t_ns + self._axis.shift_ns(part), self._begins_ns(part + 1)) < end_ns

    def _begins_ns(self, number: int) -> int:
        """Return a lower bound of times in this and later parts, on the time axis."""
        begins = [
            t_ns + self._axis.shift_ns(index)
            for index, part in enumerate(self._sources.session.parts)
            if index >= number
            and (journal := self._sources.journals.get(part.boot_id)) is not None
            and (t_ns := journal.t_ns_near(part.seq_first, newest=False)) is not None
        ]
        return min(begins, default=NO_END)

    def _latest_ns(self) -> int:
        """Return the time of the newest frame on the time axis."""
        latest = -NO_END
        for number, part in enumerate(self._sources.session.parts):
            journal = self._sources.journals.get(part.boot_id)
            end = NO_END if part.seq_last is None else part.seq_last
            last = None if journal is None else journal.held.within(part.seq_first, end).last
            if journal is not None and last is not None:
                shift_ns = self._axis.shift_ns(number)
                ends_ns = (int(f.t_ns[-1]) + shift_ns for f in journal.read(last, last))
                latest = max(latest, *ends_ns)
        return latest


def _cut(frames: FrameBatch, columns: Columns, rows: slice) -> tuple[FrameBatch, Columns]:
    cut = {name: values[rows] for name, values in columns.items()}
    return frames.rows(rows.start, rows.stop), cut
