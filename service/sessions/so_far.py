"""Preview of unsealed sessions: each frame is estimated once, on demand.

Frames come from the journals, so a restart of the server loses nothing of a preview, and a session
without viewers costs nothing. Estimates are as live, with the tares known now. They are
provisional: further frames and tares may come, and sealing uses a longer look-ahead.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_left
from collections import OrderedDict
from pathlib import Path

from devices.errors import FootTileError, StateError
from devices.frames import FrameBatch
from service.estimation.warm import is_warming
from service.sessions.frames import Columns, raw_from
from service.sessions.milestones import Milestone, Milestones, stream_of
from service.sessions.overview import Seen
from service.sessions.sources import Sources
from storage.formats.slice import Slice
from storage.sessions.pyramid import frame_columns, on_axis
from storage.sessions.so_far import BinsSoFar, thinned

AT_ONCE_S = 0.5
"""Time budget of one update; a long session is complete after several."""
_KEPT = 4
"""Number of sessions with a preview in memory."""
_REST = 10
"""Pause after repeated work, as a multiple of its time: late frames have those behind them
estimated again."""


class SoFar:
    """Estimates of one unsealed session up to some frame.

    Args:
        sources: inputs of the session.
        folder: folder on the disk for states of estimators (`service.sessions.milestones`).
    """

    def __init__(self, sources: Sources, folder: Path) -> None:
        self.milestones = Milestones(folder)
        self._sources = sources
        self._bins = BinsSoFar()
        self._stream = stream_of(sources)
        self._at = Milestone()
        self._again = 0
        """Number of frames that will be estimated a second time."""
        self._once = 0
        """Number of frames that were fed before the last rewind."""
        self.took_s = 0.0
        """Time spent on repeated work."""
        self.is_behind = False
        """True if the journals have more frames."""

    @property
    def is_estimated(self) -> bool:
        """True if there are estimates, not only raw counts."""
        return self._stream is not None

    def is_of(self, sources: Sources) -> bool:
        """Return whether part of the preview is valid for these inputs."""
        before = self._sources
        same = sources.info == before.info and sources.calibration == before.calibration
        tares = sources.tares[: len(before.tares)]
        return same and tares == before.tares and (stream_of(sources) is None) != self.is_estimated

    def places(self, sources: Sources) -> list[Milestone]:
        """Return the checkpoints before any change: the beginning, and perhaps more."""
        checkpoints = self.milestones.all
        if not self.is_of(sources):
            return [Milestone()]
        count = bisect_left(checkpoints, True, key=lambda place: not self._is_true(place, sources))
        return list(checkpoints[: max(1, count)])

    def take(self, sources: Sources) -> None:
        """Estimate the frames that have come; `is_of` is true of `inputs`, the present ones.

        Raises:
            FootTileError: a journal is damaged, or cannot be read.
        """
        if self.is_estimated and is_warming():  # else it would compile here
            self.is_behind = True
            return
        begun_s, is_again = time.monotonic(), self._at.taken < self._once
        if self._stream is not None and sources.tares != self._sources.tares:
            on = stream_of(sources)
            if on is not None and self._at.taken:
                on.go_on(self._stream.kept())
            self._stream = on
        self._sources = sources
        self.is_behind = True
        for frames, columns in raw_from(sources, self._at.part, self._at.seq):
            if time.monotonic() - begun_s >= AT_ONCE_S:
                break
            self._feed(frames, columns)
        else:
            self.is_behind = False
        if is_again:
            self.took_s += time.monotonic() - begun_s

    def is_overtaken(self, sources: Sources) -> bool:
        """Return whether frames or tares before the present position have changed."""
        return not self._is_true(self._at, sources)

    def go_back(self, sources: Sources) -> None:
        """Drop everything after the last valid checkpoint."""
        all_, true = self.milestones.all, self.places(sources)
        kept_frames = self._bins.cut(true[-1].left)
        # Repeat one frame at least: its number shows whether the next one follows it.
        index = max(0, bisect_left(true, max(kept_frames, 1), key=lambda place: place.left) - 1)
        index, self._stream = self.milestones.stream_at(all_, index, sources)
        self.milestones.go_back(index + 1)
        place = all_[index]
        self.begin_again(self)
        self._at = Milestone(
            place.part, place.seq, place.taken, place.left, place.newest_ns, place.last
        )
        self._again = kept_frames - place.left
        self._sources = sources

    def begin_again(self, before: SoFar) -> None:
        """Start measuring repeated work, up to the position of another preview."""
        self._once, self.took_s = before._at.taken, 0.0

    def seen(self, part: Slice, points: int) -> Seen:
        """Return a slice as bins, at most four times as many as points.

        Raises:
            StateError: there is no frame yet.
            FootTileError: a journal is damaged, or cannot be read.
        """
        bins = self._bins.bins()
        if bins is None:
            raise StateError(
                f"session {self._sources.session.id} has no frames yet", remedy="Ask again"
            )
        axis = self._sources.time_axis()
        bins = on_axis(bins, axis)
        begin_ns, end_ns = int(bins["t_first_ns"][0]), int(bins["t_last_ns"].max())
        found, count = thinned(bins, *part.bounds_ns(begin_ns), 4 * points)
        return Seen(found, count * self._bins.frames_in_bin, begin_ns, end_ns, axis)

    def _feed(self, frames: FrameBatch, extra: Columns) -> None:
        position = self._at
        pieces = [(frames, extra)]
        due = iter(pieces) if self._stream is None else self._stream.run(pieces, ends=False)
        names = frame_columns(estimated=self.is_estimated)
        for estimated, columns in due:
            fields = {name: getattr(estimated, name) for name in names if name not in columns}
            fields |= {name: columns[name] for name in (*names, "part") if name in columns}
            self._again -= self._bins.feed(fields, there=self._again)
            self.milestones.note(estimated.t_ns)
            position.left += len(estimated)
            position.last = int(columns["part"][-1]), int(estimated.t_ns[-1])
        position.part, position.seq = int(extra["part"][-1]), int(frames.seq[-1]) + 1
        position.taken += len(frames)
        position.newest_ns = max(position.newest_ns, int(frames.t_ns.max()))
        if position.taken - self.milestones.all[-1].taken >= self.milestones.every:
            place = Milestone(
                position.part,
                position.seq,
                position.taken,
                position.left,
                position.newest_ns,
                position.last,
            )
            self.milestones.add(place, None if self._stream is None else self._stream.kept())

    def _is_true(self, place: Milestone, sources: Sources) -> bool:
        """Return whether nothing before a checkpoint has changed since."""
        tares = sources.tares[len(self._sources.tares) :]
        if any(tare.t_ns < place.newest_ns for tare in tares):
            return False
        stored_frames = 0
        for i, each in enumerate(sources.session.parts[: place.part + 1]):
            journal = sources.journals.get(each.boot_id)
            ends = [place.seq - 1] if i == place.part else []
            ends += [each.seq_last] if each.seq_last is not None else []
            last = min(ends, default=-1)
            if journal is not None and last >= each.seq_first:
                stored_frames += journal.held.within(each.seq_first, last).count
        return stored_frames == place.taken


class SoFars:
    """Previews of unsealed sessions; only the most recently used are kept.

    Args:
        folder: folder on the disk for states of estimators.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._of: OrderedDict[str, SoFar] = OrderedDict()
        self._again_s: dict[str, float] = {}
        self._one_at_a_time = threading.Lock()

    def taken(self, sources: Sources) -> SoFar:
        """Return a session's preview, updated with the present frames.

        Raises:
            FootTileError: a journal is damaged, or cannot be read.
        """
        with self._one_at_a_time:
            return self._taken(sources)

    def nearly(self, sources: Sources) -> SoFar:
        """Return a session's preview without waiting for a long catch-up.

        Raises:
            FootTileError: a journal is damaged, or cannot be read.
        """
        so_far = self._of.get(sources.session.id)
        return so_far if so_far is not None and so_far.is_behind else self.taken(sources)

    def forget(self, session_id: str) -> None:
        """Remove the preview of a session that is sealed or gone."""
        self._of.pop(session_id, None)
        self._again_s.pop(session_id, None)

    def _taken(self, sources: Sources) -> SoFar:
        name = sources.session.id
        so_far = self._of.get(name)
        if so_far is None:
            so_far = self._of[name] = SoFar(sources, self._folder)
        elif not so_far.is_of(sources) or so_far.is_overtaken(sources):
            if time.monotonic() < self._again_s.get(name, 0.0):
                return so_far
            if so_far.is_of(sources):
                so_far.go_back(sources)
            else:
                before, so_far = so_far, SoFar(sources, self._folder)
                so_far.begin_again(before)
                self._of[name] = so_far
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
