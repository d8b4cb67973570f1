"""From journals to a sealed session: frames with estimates in one Parquet file, and its ledger.

The same frames, with estimates made the same way, are what a session that is still recorded or
pending gives away as CSV or Arrow.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from devices.errors import FileFormatError, FootTileError
from devices.frames import FrameBatch
from service.estimation import OFFLINE_LAG_MS
from service.estimation.plan import EstimationPlan
from service.sessions.pipeline import Columns, EstimateOptions, EstimateStream, notes_of
from service.sessions.sources import Sources
from storage.clock.file import CLOCK_NAME, write_clock
from storage.sessions.content_hash import sha256_of
from storage.sessions.events import write_events
from storage.sessions.file import SessionWriter
from storage.sessions.folder import FRAMES_NAME, Ledger, Session

_GATHER_FRAMES = 4096


class SessionFrames:
    """Frames of a session, with the column `part` and, where possible, estimates.

    `plan` is there once the first frames are; without estimates it stays None, and `problem` says
    why.
    """

    def __init__(self, sources: Sources) -> None:
        self.plan: EstimationPlan | None = None
        self.problem: str | None = None
        self._sources = sources

    def __iter__(self) -> Iterator[tuple[FrameBatch, Columns]]:
        sources = self._sources
        if sources.calibration is None:
            self.problem = f"no estimates: {sources.problem}"
            yield from self._raw()
            return
        options = EstimateOptions(
            sources.calibration, sources.info.models, OFFLINE_LAG_MS, tares=sources.tares
        )
        try:
            stream = EstimateStream(sources.info, options)
            pieces = stream.run(self._raw())
            first = next(pieces, None)
        except FootTileError as error:  # no tare, or a calibration of other tiles
            self.problem = f"no estimates: {error}"
            yield from self._raw()
            return
        self.plan = stream.plan
        if first is not None:
            yield first
            yield from pieces

    def _raw(self) -> Iterator[tuple[FrameBatch, Columns]]:
        for number, part in enumerate(self._sources.session.parts):
            journal = self._sources.journals.get(part.boot_id)
            if journal is None:
                continue
            last = part.seq_last if part.seq_last is not None else journal.held.last
            if last is None:
                continue
            for batch in _gathered(journal.read(part.seq_first, last)):
                yield batch, {"part": np.full(len(batch), number, dtype=np.uint16)}


def seal(sources: Sources, folder: Path, ledger: Ledger) -> Session:
    """Write the session's files; give the session as it is then.

    Args:
        sources: what to seal; every part has an end.
        folder: the session's own.
        ledger: final.

    Raises:
        FootTileError: the disk is full, or a journal is damaged. The journals are untouched.
    """
    session = sources.session
    if not any(part.recorded for part in ledger.parts):
        update = {"state": "sealed", "ledger": ledger, "problem": "not one frame was recorded"}
        return session.model_copy(update=update)
    frames = SessionFrames(sources)
    path = folder / FRAMES_NAME
    count = duration_ns = earlier_ns = part_begin_ns = 0
    notes: dict[str, object] = {
        **sources.notes,
        "session": session.model_dump(mode="json", include=_IN_FILE),
        "ledger": ledger.model_dump(mode="json"),
    }
    last_part = -1
    with SessionWriter(path, sources.info, notes) as writer:
        for batch, columns in frames:
            if not count:
                if frames.plan is not None:
                    writer.add_notes(notes_of(frames.plan, sources.tares))
                else:
                    writer.add_notes({"estimates": frames.problem})
            writer.append(batch, columns)
            count += len(batch)
            part = int(columns["part"][0])
            if part != last_part:
                last_part, part_begin_ns = part, int(batch.t_mono_ns[0])
                earlier_ns = duration_ns
            duration_ns = earlier_ns + int(batch.t_mono_ns[-1]) - part_begin_ns
    recorded = sum(part.recorded for part in ledger.parts)
    if count != recorded:
        raise FileFormatError(
            f"{count} frames were sealed, the ledger has {recorded}", where=str(path)
        )
    write_events(session, folder)
    write_clock(folder / CLOCK_NAME, session.clock, sources.streams)
    plan = frames.plan
    return session.model_copy(
        update={
            "state": "sealed",
            "problem": "; ".join(filter(None, (session.problem, frames.problem))) or None,
            "ledger": ledger,
            "frames": count,
            "duration_s": duration_ns * 1e-9,
            "bytes": path.stat().st_size,
            "sha256": sha256_of(path),
            "calibration_id": plan.calibration.id if plan is not None else None,
            "absolute_scale": (
                None if plan is None else "assumed" if plan.assumed_scale else "measured"
            ),
        }
    )


_IN_FILE = {"id", "name", "node", "started_t_ns", "stopped_t_ns", "parts", "scene"}
"""What the sealed file says of its session; names and notes may change later and are not in it."""


def _gathered(batches: Iterator[FrameBatch]) -> Iterator[FrameBatch]:
    """Fewer and longer batches: estimates of ten rows cost nearly what those of thousands do."""
    waiting: list[FrameBatch] = []
    count = 0
    for batch in batches:
        waiting.append(batch)
        count += len(batch)
        if count >= _GATHER_FRAMES:
            yield FrameBatch.concatenate(waiting)
            waiting, count = [], 0
    if waiting:
        yield FrameBatch.concatenate(waiting)
