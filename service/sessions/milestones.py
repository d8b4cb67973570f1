"""Places in a session that is not sealed from which its estimates can go on, with the same bits.

What an estimator remembers there lies in a scratch file, some ten thousand bytes every some
thousand frames; in memory is only where. So any slice costs what lies between it and the place
before it, be it at the beginning or hours later.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devices.errors import FootTileError, StorageError
from service.estimation import LIVE_LAG_MS
from service.sessions.pipeline import Columns, EstimateOptions, EstimateStream
from service.sessions.sources import Sources
from storage.schema import Array
from storage.scratch import Kept, Scratch

EVERY = 6144
"""Frames between two places at least; more by less than a piece of a journal. Those of eight tiles
are estimated in some 60 ms, with all models."""
MOST = 8192
"""Places: then every other one is forgotten, and they are twice as far apart."""
_EVER_NS = 2**63 - 1


@dataclass(slots=True)
class Milestone:
    """A place, and what is known of the frames from there on.

    Attributes:
        part: of the next frame to take.
        seq: least number it can have.
        taken: frames that were taken before.
        left: whose estimates have left by then; others wait for their look-ahead.
        newest_ns: greatest `t_ns` of those taken.
        last: part and `t_ns` of the frame that left last; None: none has.
        kept: what the estimator remembers; None: nothing yet.
        begin_ns: least `t_ns` of those that leave from here on until the next place.
        end_ns: the greatest.
    """

    part: int = 0
    seq: int = 0
    taken: int = 0
    left: int = 0
    newest_ns: int = -_EVER_NS
    last: tuple[int, int] | None = None
    kept: Kept | None = None
    begin_ns: int = _EVER_NS
    end_ns: int = -_EVER_NS


class Milestones:
    """Those of one session, in their order. One thread adds; any may read.

    Args:
        folder: on whose disk estimators' memories are.
    """

    def __init__(self, folder: Path) -> None:
        self.all: Sequence[Milestone] = (Milestone(),)
        """The first is the beginning. Never changed, but replaced."""
        self.every = EVERY
        self._scratch = Scratch(folder)

    def note(self, t_ns: Array) -> None:
        """Frames that have left since the newest place."""
        newest = self.all[-1]
        newest.begin_ns = min(newest.begin_ns, int(t_ns.min()))
        newest.end_ns = max(newest.end_ns, int(t_ns.max()))

    def add(self, place: Milestone, memory: Columns | None) -> None:
        """Another place; none, if the disk does not take what is remembered there.

        Args:
            place: behind those there are.
            memory: of the estimator; None where nothing is estimated.
        """
        if memory is not None:
            content = io.BytesIO()
            np.savez(content, allow_pickle=False, **memory)
            try:
                place.kept = self._scratch.put(content.getvalue())
            except StorageError:  # frames need the disk more
                return
        found = [*self.all, place]
        if len(found) > MOST:
            for before, after in zip(found[::2], found[1::2], strict=False):
                before.begin_ns = min(before.begin_ns, after.begin_ns)
                before.end_ns = max(before.end_ns, after.end_ns)
            found, self.every = found[::2], 2 * self.every
        self.all = tuple(found)

    def go_back(self, count: int) -> None:
        """Forget all but the first so many; of frames behind the last one nothing is known."""
        newest = self.all[count - 1]
        newest.begin_ns, newest.end_ns = _EVER_NS, -_EVER_NS
        self.all = tuple(self.all[:count])

    def stream_at(
        self, places: Sequence[Milestone], at: int, sources: Sources
    ) -> tuple[int, EstimateStream | None]:
        """An estimate that goes on from a place, or from one before it if that cannot be read.

        Args:
            places: of `all`.
            at: which of them.
            sources: of which `places` are true.

        Returns:
            From which; and the estimate, None where nothing is estimated.
        """
        stream = stream_of(sources)
        while stream is not None and (kept := places[at].kept) is not None:
            try:
                with np.load(io.BytesIO(self._scratch.get(kept)), allow_pickle=False) as memory:
                    stream.go_on(dict(memory))
            except Exception:  # damaged bytes may cause any error; the beginning has none
                at, stream = at - 1, stream_of(sources)
            else:
                break
        return at, stream


def stream_of(sources: Sources) -> EstimateStream | None:
    """As frames are estimated before they are sealed; None: there is nothing to do that with."""
    if sources.calibration is None or not sources.tares:
        return None
    options = EstimateOptions(
        sources.calibration,
        sources.info.models,
        LIVE_LAG_MS,
        tares=sources.tares,
        exact=sources.exact,
    )
    try:
        return EstimateStream(sources.info, options)
    except FootTileError:  # a calibration of other tiles
        return None
