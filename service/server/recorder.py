"""Recording commands: start, stop, abandon, delete and restore sessions, and report them.

Starting and stopping only note numbers and times; the frames are in the journals anyway.
`service.server.sealer` does the rest.
"""

from __future__ import annotations

import logging
from typing import Literal

from devices.errors import StateError, StorageError
from service.protocol.link import ClockSample, RetentionMessage, StreamNumbers
from service.server import session_parts
from service.server.node import ServerNode
from service.server.nodes import NodeRegistry
from service.server.sealer import SessionSealer
from service.server.session_parts import current_ledger
from service.server.session_store import SessionStore, check_revision, user_fields_revision
from service.server_clock import server_utc_ns
from service.sessions.inputs import SessionInputs
from service.sessions.parts import create_session
from storage.intervals import NO_END, Intervals, to_open_pairs
from storage.sessions.folder import IdempotencyRecord, Ledger, Session
from storage.sessions.ledger import group_numbers_by_stream

log = logging.getLogger("foottile.recorder")

MAX_DELAY_S = 2.0
CLOCK_ERROR_MAX_NS = 60_000_000_000
"""Tolerance: eight probes take up to 40 s on a very poor link."""


class Recorder:
    """Recording on the nodes of a server.

    Args:
        store: sessions of the server.
        nodes: nodes to record on.
        sealer: ends and seals sessions.
    """

    def __init__(self, store: SessionStore, nodes: NodeRegistry, sealer: SessionSealer) -> None:
        self._store = store
        self._nodes = nodes
        self._sealer = sealer
        for session in store.list_unsealed():
            store.cache(self._with_clock_offsets(session))

    def cache_missing_clock_offsets(self, node: ServerNode) -> None:
        """Add missing clock measurements to a node's unsealed sessions, in memory.

        Those are missing after a first contact, and for streams into which a session was extended.
        """
        for session in self._store.list_unsealed(node.name):
            if session.state != "sealing":
                self._store.cache(self._with_clock_offsets(session))

    def list_recording(self, node: str) -> list[Session]:
        """Return the sessions that are being recorded on a node."""
        return [s for s in self._store.list_unsealed(node) if s.state == "recording"]

    def start_session(
        self,
        node_name: str,
        name: str,
        *,
        pre_roll_s: float = 0.0,
        subject: str = "",
        notes: str = "",
        tags: tuple[str, ...] = (),
        take: str | None = None,
        request: IdempotencyRecord | None = None,
    ) -> Session:
        """Start a session with the next frame, or `pre_roll_s` earlier if still stored.

        Several sessions may be recorded on one node at a time. The caller looks up an earlier
        sending of the same request: `SessionStore.find_by_idempotency_key`.

        Raises:
            UnknownError: no node has this name.
            StateError: it is not connected, or has sent no frame yet.
            StorageError: the session cannot be saved; nothing was started then.
        """
        node = self._nodes.get(node_name)
        if not node.is_connected or node.last_seq is None or node.last_t_ns is None:
            raise StateError(f"node {node_name!r} sends no frames", remedy="Connect it and retry")
        behind_s = (node.to_node_t_ns_or_unchanged(server_utc_ns()) - node.last_t_ns) * 1e-9
        if node.clock_offset is not None and behind_s > MAX_DELAY_S:
            raise StateError(
                f"node {node_name!r} is {behind_s:.1f} s behind: its link is too slow",
                remedy="Retry when it has caught up",
            )
        part = session_parts.make_initial_part(node, node.last_seq, node.last_t_ns, pre_roll_s)
        session = create_session(
            node.last_info,
            name,
            part,
            scene_content=node.hello.scene,
            calibration=node.estimator.live.calibration,
            calibration_source=node.estimator.calibration_source,
            subject=subject,
            notes=notes,
            tags=tags,
            take=take,
            request=request,
            missed_slots_at_start=node.present_stream.missed_slots,
            clock=session_parts.list_clock_offsets_since(node.present_stream, part.seq_first),
        )
        return self._store.save(session)

    def stop_session(self, session_id: str) -> Session:
        """Stop a session now; it is sealed as soon as all its frames are here.

        A stopped session is unchanged: a repeated stop is the same stop.

        Raises:
            UnknownError: no session has this id.
            StorageError: the session cannot be saved.
        """
        session = self._store.get_session(session_id)
        if session.state != "recording":
            return session
        self._store.save(session_parts.mark_stopped(session, self._nodes.find(session.node)))
        self._sealer.advance_unsealed_sessions()
        return self._store.get_session(session_id)

    def abandon_missing(self, session_id: str) -> Session:
        """Seal a pending session without its missing frames: its node never comes back.

        Raises:
            UnknownError: no session has this id.
            StateError: it is not pending.
            StorageError: the session cannot be saved.
        """
        session = self._store.get_session(session_id)
        if session.state != "pending":
            raise StateError(
                f"session {session_id} is {session.state}",
                expected="a session that is pending",
                remedy="Stop it first" if session.state == "recording" else "",
            )
        node = self._nodes.find(session.node)
        if node is not None and session_parts.has_unreadable_journal(session, node):
            # Frames in an unreadable journal are abandoned; later streams have their own journals.
            self._store.save(session.model_copy(update={"is_abandoned": True}))
            self._sealer.extend_node_sessions(node)
            session = self._store.get_session(session_id)
        self._store.save(session_parts.abandon_missing(session, node))
        self._sealer.clear_failure(session_id)
        self._sealer.advance_unsealed_sessions()
        return self._store.get_session(session_id)

    def move_to_trash(self, session_id: str, *, if_revision: str | None = None) -> None:
        """Move a session to the trash.

        Args:
            session_id: id of the session.
            if_revision: expected `user_fields_revision`; None: any.

        Raises:
            UnknownError: no session has this id.
            ChangedError: its revision is another one.
            StateError: it is being recorded, or sealed.
            StorageError: it cannot be moved.
        """
        session = self._store.get_session(session_id)
        check_revision(if_revision, user_fields_revision(session), f"session {session_id}")
        if session.state == "recording":
            raise StateError(f"session {session_id} is being recorded", remedy="Stop it first")
        if self._sealer.is_sealing(session_id):
            raise StateError(
                f"session {session_id} is being sealed", remedy="Delete it in some seconds"
            )
        self._store.move_to_trash(session)
        self._sealer.clear_failure(session_id)

    def restore_session(self, session_id: str) -> Session:
        """Restore a session from the trash; a pending one stays pending.

        Raises:
            UnknownError: it is not in the trash.
            StorageError: it cannot be moved.
        """
        book = self._store
        book.cache(self._with_clock_offsets(book.trash.restore(session_id, book.folder)))
        self._sealer.advance_unsealed_sessions()
        book.on_change(book.get_session(session_id))
        return book.get_session(session_id)

    def record_plausible_clock_offset(
        self, node: ServerNode, row: ClockSample, now_t_ns: int
    ) -> None:
        """Record a plausible measurement of a node's clock, in its stream and its sessions.

        The stream's log has it already; sessions are saved with their next change. A measurement
        whose server time is far from the present time is dropped, as is one that is far from the
        node's clock as hello stated it.
        """
        stated_t_ns = row.t_mono_ns + node.last_info.utc_offset_ns + row.server_minus_node_ns
        if abs(stated_t_ns - now_t_ns) > CLOCK_ERROR_MAX_NS + row.uncertainty_ns:
            log.warning(
                "node %s: a measurement of its clock is not kept: it has this server's clock "
                "%.0f s off. Was that set just now?",
                node.name,
                (stated_t_ns - now_t_ns) * 1e-9,
            )
            return
        limit = node.present_stream.limit
        if limit is not None and not limit.is_near_stated_clock(
            row.t_mono_ns, row.uncertainty_ns, now_t_ns
        ):
            log.warning(
                "node %s: a measurement of its clock is not kept: its time is not the one that the "
                "node stated at connecting",
                node.name,
            )
            return
        try:
            node.present_stream.record_clock_offset(row)
        except StorageError as error:  # the measurement is used all the same
            log.warning("node %s: %s", node.name, error)
        offset = node.present_stream.clock_offsets[-1]
        for session in self._store.list_unsealed(node.name):
            is_its_own = any(part.stream_id == node.stream_id for part in session.parts)
            if is_its_own and session.state != "sealing":
                clock = (*session.clock, offset)
                self._store.cache(session.model_copy(update={"clock": clock}))

    def get_ledger(self, session_id: str) -> Ledger:
        """Return the present ledger of a session: the fate of every frame.

        Raises:
            UnknownError: no session has this id.
        """
        return self.compute_ledger(self._store.get_session(session_id))

    def compute_ledger(self, session: Session) -> Ledger:
        """Return the present ledger of a session that may be in the trash."""
        return current_ledger(session, self._nodes.find(session.node))

    def find_problem_to_show(self, session: Session) -> str | None:
        """Return the user-visible problem of a session, if any."""
        return self._sealer.find_problem_to_show(session)

    def compute_duration_s(self, session: Session, frame_count: int) -> float:
        """Return the session's length: exact if sealed, else the time over which frames have come.

        It is at least the time of its frames at the nominal rate, which is the fastest.
        """
        node = self._nodes.find(session.node)
        if session.state == "sealed" or node is None:
            return session.duration_s
        seen_t_ns = node.last_seen_t_ns if frame_count else None
        end_t_ns = min(session.stopped_t_ns or NO_END, seen_t_ns or 0)
        lasted_s = (end_t_ns - session.started_t_ns) * 1e-9
        return max(frame_count / node.last_info.nominal_rate_hz, lasted_s)

    def pending_reason(self, session: Session, ledger: Ledger) -> Literal["frames", "end"] | None:
        """Return the reason why a session is pending: missing frames, or an unknown end."""
        if session.state != "pending":
            return None
        if ledger.pending:
            return "frames"
        return "end" if session.parts[-1].seq_last is None else None

    def collect_inputs_from_journals(self, session_id: str) -> SessionInputs:
        """Collect the inputs from which a session can be sealed or exported.

        Raises:
            UnknownError: no session has this id, or its node is unknown here.
        """
        session = self._store.get_session(session_id)
        return self._sealer.collect_inputs(session)

    def needed_frames(self, node_name: str) -> dict[str, Intervals]:
        """Return the frames that unsealed sessions of a node need in its journals, by stream id.

        A session in the trash can be restored, so its frames count as well.
        """
        node = self._nodes.find(node_name)
        if self._store.has_unreadable and node is not None:
            return {stream_id: Intervals([(0, NO_END)]) for stream_id in node.streams}
        return group_numbers_by_stream(
            part
            for session in (*self._store.list_unsealed(), *self._store.trash.list_unsealed())
            if session.node == node_name
            for part in session_parts.iterate_own_and_possible_later_parts(session, node)
        )

    def make_retention_request(self, node_name: str) -> RetentionMessage:
        """Return `needed_frames` as the message to the node."""
        streams = tuple(
            StreamNumbers(stream_id=stream_id, numbers=to_open_pairs(numbers))
            for stream_id, numbers in sorted(self.needed_frames(node_name).items())
        )
        return RetentionMessage(streams=streams, recording=bool(self.list_recording(node_name)))

    def _with_clock_offsets(self, session: Session) -> Session:
        node = self._nodes.find(session.node)
        if session.state == "sealed" or node is None:
            return session
        try:
            for stream_id in dict.fromkeys(part.stream_id for part in session.parts):
                stream = node.streams.get(stream_id)
                times_ns = [row.t_mono_ns for row in session.clock if row.stream_id == stream_id]
                # A log may be long: read it only if the session lacks its newest row.
                if (
                    stream is not None
                    and stream.clock_offset is not None
                    and (stream.clock_offset.t_mono_ns > max(times_ns, default=-1))
                ):
                    session = session.with_newer_clock_rows(stream.read_clock_offsets())
        except StorageError as error:  # frames matter more than clock measurements
            log.warning("session %s: %s", session.id, error)
        return session
