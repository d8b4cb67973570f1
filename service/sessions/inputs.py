"""Inputs of a session: frames, array, calibration, tares, metadata.

The same whether a session is sealed, exported before that, recovered, or recorded on a node.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from devices.errors import FootTileError
from devices.frames import ArrayInfo, FrameBatch
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import Tare
from service.sessions.parts import RATE_MAX_HZ, NodeFacts, SessionStream, find_likely_end
from service.sessions.tares import TareHistory
from storage.clock.table import ClockTable, StreamClockFacts, group_rows_by_stream_in_given_order
from storage.intervals import NO_END
from storage.journal.journal import Journal
from storage.sessions.folder import Session
from storage.sessions.ledger import find_lost_numbers, mark_damaged_and_abandoned_lost
from storage.sessions.time_axis import NODE_AXIS, PartSpan, TimeAxis, compute_time_axis


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
        parts = self.session.parts
        if len({part.stream_id for part in parts}) < 2:
            return NODE_AXIS
        spans = []
        for number, part in enumerate(parts):
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
        period_ns = round(1e9 / self.info.nominal_rate_hz)
        return compute_time_axis(spans, self.make_clock_table(), period_ns=period_ns)


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
    session = find_likely_end(session, node)
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
