"""What there is by now of a session that is not sealed: each frame is estimated once, on demand.

Frames come from the journals, so a restart of the server loses nothing of the picture, and nobody
who does not look costs anything. Estimates are those that sealing would make now. They are
provisional: frames may still come between them, and tares may follow.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Iterator
from itertools import takewhile

import numpy as np

from devices.errors import FootTileError, StateError
from devices.frames import FrameBatch
from service.estimation import OFFLINE_LAG_MS
from service.estimation.warm import is_warming
from service.sessions.overview import Seen
from service.sessions.pipeline import Columns, EstimateOptions, EstimateStream
from service.sessions.sources import Sources
from storage.formats.slice import Slice
from storage.sessions.pyramid import frame_columns
from storage.sessions.so_far import BinsSoFar, thinned

AT_ONCE_S = 0.5
"""So long an answer may take to catch up; a long session is there after some of them."""
_KEPT = 4
"""Sessions of which something is remembered."""
_REST = 10
"""What came too late between the others has all estimated anew, in one tenth of the time."""


class SoFar:
    """A session as far as it was estimated."""

    def __init__(self, sources: Sources) -> None:
        self._sources = sources
        self._bins = BinsSoFar()
        self._stream = _stream(sources)
        self._at = 0, 0
        """Part and number of the next frame to take."""
        self._taken = 0
        """Frames that were taken from the journals."""
        self.took_s = 0.0
        self.is_behind = False
        """Is there more in the journals?"""

    @property
    def is_estimated(self) -> bool:
        """Are there forces, or only raw counts?"""
        return self._stream is not None

    def fits(self, sources: Sources) -> bool:
        """Is what was taken still the beginning of the session?"""
        before = self._sources
        same = sources.info == before.info and sources.calibration == before.calibration
        tares = sources.tares[: len(before.tares)]
        if not same or tares != before.tares or (_stream(sources) is None) == self.is_estimated:
            return False
        return self._held_behind(sources) == self._taken

    def take(self, sources: Sources) -> None:
        """Estimate what has come since; `sources` are those of now, and `fits` is true of them.

        Raises:
            FootTileError: a journal is damaged, or cannot be read.
        """
        if self.is_estimated and is_warming():  # or it would compile here
            self.is_behind = True
            return
        begun_s = time.monotonic()
        if self._stream is not None and sources.tares != self._sources.tares:
            on = _stream(sources)
            if on is not None and self._taken:
                on.go_on(self._stream.kept())
            self._stream = on
        self._sources = sources
        pieces = takewhile(lambda _: time.monotonic() - begun_s < AT_ONCE_S, self._pieces())
        estimated = pieces if self._stream is None else self._stream.run(pieces, ends=False)
        names = frame_columns(estimated=self.is_estimated)
        for frames, columns in estimated:
            own = {name: getattr(frames, name) for name in names if name not in columns}
            self._bins.feed({**own, **{n: columns[n] for n in (*names, "part") if n in columns}})
        self.took_s += time.monotonic() - begun_s

    def seen(self, part: Slice, points: int) -> Seen:
        """Some time of it as bins, four times as many as points at most.

        Raises:
            StateError: there is no frame yet.
        """
        bins = self._bins.bins()
        if bins is None:
            raise StateError(
                f"session {self._sources.session.id} has no frames yet", remedy="Ask again"
            )
        begin_ns, end_ns = int(bins["t_first_ns"][0]), int(bins["t_last_ns"].max())
        found, count = thinned(bins, *part.bounds_ns(begin_ns), 4 * points)
        return Seen(found, count * self._bins.frames_in_bin, begin_ns, end_ns)

    def _pieces(self) -> Iterator[tuple[FrameBatch, Columns]]:
        """Frames from the journals, from where it left off."""
        number, seq = self._at
        self.is_behind = True
        for i, each in list(enumerate(self._sources.session.parts))[number:]:
            journal = self._sources.journals.get(each.boot_id)
            first = max(seq, each.seq_first) if i == number else each.seq_first
            held = None if journal is None else journal.held.last
            last = each.seq_last if each.seq_last is not None else held
            if journal is None or last is None or last < first:
                continue
            for batch in journal.read(first, last):
                if not len(batch):
                    continue
                yield batch, {"part": np.full(len(batch), i, dtype=np.uint16)}
                # Only now: a piece that there was no time for is taken the next time.
                self._at = i, int(batch.seq[-1]) + 1
                self._taken += len(batch)
        self.is_behind = False

    def _held_behind(self, sources: Sources) -> int:
        """Frames that the journals have by now of where it has been."""
        number, seq = self._at
        held = 0
        for i, each in enumerate(sources.session.parts[: number + 1]):
            journal = sources.journals.get(each.boot_id)
            ends = [seq - 1] if i == number else []
            ends += [each.seq_last] if each.seq_last is not None else []
            last = min(ends) if ends else -1
            if journal is not None and last >= each.seq_first:
                held += journal.held.within(each.seq_first, last).count
        return held


class SoFars:
    """What is remembered of sessions that are not sealed; of few, those asked for last."""

    def __init__(self) -> None:
        self._of: OrderedDict[str, SoFar] = OrderedDict()
        self._again_s: dict[str, float] = {}

    def taken(self, sources: Sources) -> SoFar:
        """A session with what has come by now.

        Raises:
            FootTileError: a journal is damaged, or cannot be read.
        """
        name = sources.session.id
        so_far = self._of.get(name)
        if so_far is None or not so_far.fits(sources):
            if so_far is not None and time.monotonic() < self._again_s.get(name, 0.0):
                return so_far
            so_far = self._of[name] = SoFar(sources)
        self._of.move_to_end(name)
        while len(self._of) > _KEPT:
            self.forget(next(iter(self._of)))
        try:
            so_far.take(sources)
        except FootTileError:
            self.forget(name)
            raise
        self._again_s[name] = time.monotonic() + _REST * so_far.took_s
        return so_far

    def forget(self, session_id: str) -> None:
        """It is sealed, or gone."""
        self._of.pop(session_id, None)
        self._again_s.pop(session_id, None)


def _stream(sources: Sources) -> EstimateStream | None:
    """None: there is nothing to estimate with yet."""
    if sources.calibration is None or not sources.tares:
        return None
    options = EstimateOptions(
        sources.calibration,
        sources.info.models,
        OFFLINE_LAG_MS,
        tares=sources.tares,
        exact=sources.exact,
    )
    try:
        return EstimateStream(sources.info, options)
    except FootTileError:  # a calibration of other tiles
        return None
