"""Inputs of a session: array, calibration, tares, metadata, and its frames with their estimates.

The same whether a session is sealed, exported before that, recovered, or recorded on a node. A node
and `foottile recover` estimate only when they seal. Without numba and scipy frames stay raw.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from devices.arrays import Columns
from devices.errors import DamagedFramesError, FootTileError, require_extra
from devices.frames import ArrayInfo, FrameBatch
from service.estimation import OFFLINE_LAG_MS
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import Tare
from service.sessions.parts import (
    RATE_MAX_HZ,
    NodeFacts,
    SessionStream,
    close_at_likely_end,
    find_usable_warm_up,
)
from service.sessions.tares import TareHistory
from storage.clock.table import ClockTable, StreamClockFacts, group_rows_by_stream_in_given_order
from storage.intervals import NO_END
from storage.journal.journal import Journal
from storage.sessions.folder import Session
from storage.sessions.ledger import find_lost_numbers, mark_damaged_and_abandoned_lost
from storage.sessions.time_axis import NODE_AXIS, PartSpan, TimeAxis, compute_time_axis
from storage.sessions.warm_up import with_part_column


@dataclass(frozen=True)
class SessionInputs:
    """Inputs from which a session is sealed.

    Attributes:
        session: intervals, markers, clock.
        info: description of the array in its first part.
        journals: journals by stream id.
        calibration: calibration for estimates; None: raw frames only.
        problem: reason why there is none.
        tares: tares in force, oldest first; `Tare.make_lost` where one is lost.
        notes: further metadata for the file.
        unquantized: True: estimates are not rounded.
    """

    session: Session
    info: ArrayInfo
    journals: Mapping[str, Journal]
    calibration: Calibration | None
    problem: str | None
    tares: tuple[Tare, ...]
    notes: Mapping[str, object]
    unquantized: bool = False

    @property
    def stream_facts(self) -> tuple[StreamClockFacts, ...]:
        """Facts about the clocks of the session's streams."""
        stream_ids = dict.fromkeys(part.stream_id for part in self.session.parts)
        infos = {stream_id: journal.info for stream_id, journal in self.journals.items()}
        infos[self.info.stream_id] = self.info
        return tuple(
            StreamClockFacts(stream_id, info.utc_offset_ns, info.clock_set)
            if (info := infos.get(stream_id)) is not None
            else StreamClockFacts(stream_id)
            for stream_id in stream_ids
        )

    def make_clock_table(self) -> ClockTable:
        """Return the clock table of a session that is not sealed yet."""
        parts = [part.stream_id for part in self.session.parts]
        where = f"session {self.session.id}"
        rows = group_rows_by_stream_in_given_order(self.session.clock, where=where)
        return ClockTable(rows, self.stream_facts, parts, where=where)

    def compute_time_axis(self) -> TimeAxis:
        """Compute the time axis of a session that is not sealed yet, from its present frames.

        Raises:
            FootTileError: a journal is damaged, or cannot be read.
        """
        if len({part.stream_id for part in self.session.parts}) < 2:
            return NODE_AXIS
        period_ns = round(1e9 / self.info.nominal_rate_hz)
        return compute_time_axis(
            self.find_part_spans(), self.make_clock_table(), period_ns=period_ns
        )

    def find_part_spans(self) -> list[PartSpan]:
        """Return the times of the first and last stored frame of each part that has frames.

        Raises:
            FootTileError: a journal is damaged, or cannot be read.
        """
        spans = []
        for number, part in enumerate(self.session.parts):
            journal = self.journals.get(part.stream_id)
            if journal is None:
                continue
            end = NO_END if part.seq_last is None else part.seq_last
            stored = journal.stored.restricted_to(part.seq_first, end)
            if stored.first is None or stored.last is None:
                continue
            first, last = (
                FrameBatch.concatenate(list(journal.read_frames(seq, seq)))
                for seq in (stored.first, stored.last)
            )
            t_mono_ns = int(first.t_mono_ns[0]), int(last.t_mono_ns[-1])
            t_ns = int(first.t_ns[0]), int(last.t_ns[-1])
            spans.append(PartSpan(number, part.stream_id, t_mono_ns, t_ns))
        return spans


def make_inputs(
    session: Session,
    node: NodeFacts,
    *,
    load_tares: Callable[[], TareHistory] | None,
    emulated: bool | None,
    default_array: ArrayInfo | None = None,
    unquantized: bool = False,
) -> SessionInputs:
    """Collect the present inputs of a session, up to its likely end.

    Args:
        session: the session.
        node: facts of its node.
        load_tares: returns the tares of its node; None: there is no history.
        emulated: True: its frames are emulated; None: unknown.
        default_array: array if no stream describes one.
        unquantized: True: estimates are not rounded.
    """
    session = close_at_likely_end(session, node)
    streams = node.collect_streams(session)
    infos = [streams[part.stream_id].info for part in session.parts]
    info = next(
        (info for info in infos if info is not None), default_array or _empty_array(session)
    )
    calibration, problem = _parse_calibration(session)
    in_force: tuple[Tare, ...] = ()
    if calibration is not None and load_tares is not None:
        in_force, problem = _tares_during(session, streams, load_tares(), info)
    notes: dict[str, object] = {
        "scene": session.scene_content,
        "lost": find_lost_numbers(session.parts, mark_damaged_and_abandoned_lost(session, streams)),
    }
    if emulated is not None:
        notes["emulated"] = emulated
    if session.calibration_source != "node":
        notes["calibration_source"] = session.calibration_source
    return SessionInputs(
        session=session,
        info=info,
        journals={b: s.journal for b, s in streams.items() if s.journal is not None},
        calibration=calibration if problem is None else None,
        problem=problem,
        tares=in_force,
        notes=notes,
        unquantized=unquantized,
    )


def _parse_calibration(session: Session) -> tuple[Calibration | None, str | None]:
    if session.calibration is None:
        if session.calibration_source == "server":
            return None, "the calibration that was assigned to the node did not fit or was lost"
        return None, "the node had no calibration"
    try:
        return Calibration.model_validate(session.calibration), None
    except (FootTileError, ValueError) as error:
        return None, f"its calibration is not readable: {error}"


def _tares_during(
    session: Session, streams: Mapping[str, SessionStream], history: TareHistory, info: ArrayInfo
) -> tuple[tuple[Tare, ...], str | None]:
    """Return the tares in force during the session, by the frames' times.

    Returns:
        Tares, oldest first; none, and a reason, if all tares are of another time.
    """
    first, last = session.parts[0], session.parts[-1]
    seq_last = last.seq_last if last.seq_last is not None else NO_END
    begin_t_ns = streams[first.stream_id].find_batch_t_ns_near(first.seq_first, at_or_before=False)
    end_t_ns = streams[last.stream_id].find_batch_t_ns_near(seq_last, at_or_before=True)
    if begin_t_ns is None or end_t_ns is None:
        return (), None
    tares = history.tares_in_force_or_lost_between(info, begin_t_ns, end_t_ns)
    if not tares and not history.is_empty(info):
        return (), "all tares of the node were taken after this session"
    return tares, None


def _empty_array(session: Session) -> ArrayInfo:
    """Return the array of a session without frames."""
    return ArrayInfo(
        node=session.node,
        stream_id=session.parts[0].stream_id,
        tiles=(),
        servo=None,
        schedule="",
        nominal_rate_hz=RATE_MAX_HZ,
        utc_offset_ns=0,
        clock_set=False,
        software="",
        scene=session.scene,
        models=(),
    )


TARE_LOST = (
    "a tare is damaged and lost: where it may have been in force, forces are not known (bit 512 of "
    "estimate_flags)"
)


class SessionFrames:
    """Frames of a session, with the column `part` and, where possible, estimates.

    After the first frames, `notes` has the file's metadata of the estimates, and `problem` the
    reason why there are none, or not for all frames.

    Args:
        inputs: inputs of the session.
        warm_up: frames before the first one, for the models' history.
    """

    def __init__(self, inputs: SessionInputs, warm_up: Iterable[FrameBatch] = ()) -> None:
        self.notes: dict[str, Any] = {}
        self.problem: str | None = None
        self._inputs = inputs
        self._warm_up = warm_up

    def __iter__(self) -> Iterator[tuple[FrameBatch, Columns]]:
        if self._inputs.calibration is None:
            self._note_no_estimates(self._inputs.problem)
            yield from iterate_raw_frames_with_part(self._inputs)
            return
        try:
            pieces = self._iterate_estimated()
            first = next(pieces, None)
        except FootTileError as error:  # no tare, a calibration of other tiles, no estimator
            self._note_no_estimates(error)
            yield from iterate_raw_frames_with_part(self._inputs)
            return
        if first is not None:
            yield first
            yield from pieces

    def _iterate_estimated(self) -> Iterator[tuple[FrameBatch, Columns]]:
        sources = self._inputs
        with require_extra("server", "the estimator", remedy=_REMEDY):
            from service.sessions.estimate_stream import (
                EstimateOptions,
                EstimateStream,
                make_estimate_metadata,
            )
        assert sources.calibration is not None  # noqa: S101  # or there is nothing to estimate with
        options = EstimateOptions(
            sources.calibration,
            sources.info.models,
            OFFLINE_LAG_MS,
            tares=sources.tares,
            unquantized=sources.unquantized,
        )
        stream = EstimateStream(sources.info, options)
        for frames, columns in stream.estimate_batches(
            iterate_raw_frames_with_part(sources), warm_up=map(with_part_column, self._warm_up)
        ):
            if not self.notes and stream.plan is not None:
                self.notes = make_estimate_metadata(stream.plan, stream.rounding, sources.tares)
                if any(tare.is_lost for tare in sources.tares):
                    self.problem = TARE_LOST
            yield frames, columns

    def _note_no_estimates(self, reason: object) -> None:
        """Note why there are no estimates, and what `foottile estimate` needs to add them."""
        calibration, tares = self._inputs.calibration, self._inputs.tares
        self.problem = f"no estimates: {reason}"
        self.notes = {"estimates": self.problem}
        if calibration is not None:
            self.notes["calibration"] = calibration.model_dump(mode="json")
        if tares:
            self.notes["tares"] = [tare.as_dict() for tare in tares]


def iterate_warm_up(inputs: SessionInputs) -> Iterator[FrameBatch]:
    """Yield the frames just before the session's first part that are stored and undamaged.

    Raises:
        StorageError: the journal cannot be read.
    """
    if (before := find_usable_warm_up(inputs.session)) is None:
        return
    journal, seq, last = inputs.journals.get(before.stream_id), before.seq_first, before.seq_last
    while journal is not None and last is not None and seq <= last:
        try:
            for frames in journal.read_frames(seq, last):
                if len(frames):
                    yield frames
                    seq = int(frames.seq[-1]) + 1
        except DamagedFramesError as error:  # nobody waits for these: the others do
            seq = error.seq_last + 1
        else:
            return


def iterate_raw_frames_with_part(
    inputs: SessionInputs, first_part: int = 0, first_seq: int = 0
) -> Iterator[tuple[FrameBatch, Columns]]:
    """Yield frames from the journals in order, with the column `part` only.

    Args:
        inputs: inputs of the session.
        first_part: number of the first part.
        first_seq: frames of this part before this number are left out.
    """
    for i, part in list(enumerate(inputs.session.parts))[first_part:]:
        journal = inputs.journals.get(part.stream_id)
        first = max(first_seq, part.seq_first) if i == first_part else part.seq_first
        last = journal.stored.last if journal is not None else None
        last = part.seq_last if part.seq_last is not None else last
        if journal is None or last is None or last < first:
            continue
        for batch in journal.read_frames(first, last):
            if len(batch):
                yield batch, {"part": np.full(len(batch), i, dtype=np.uint16)}


_REMEDY = "`foottile estimate` adds them where foottile[server] is installed"
