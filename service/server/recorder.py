"""Recording on a server: start, stop, abandon, delete and restore sessions, seal and report them.

Starting and stopping only store numbers and times; the frames are in the journals anyway.
`service.sessions.lifecycle` decides the next state of a session; this module saves it and acts.
Sealing runs in a thread and is retried if the disk is full.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

from devices.clock import server_utc_ns
from devices.errors import DamagedFramesError, FootTileError, StateError
from service.estimation.compilation import is_compiling
from service.protocol.link import RetentionMessage, StreamNumbers
from service.server.node import ServerNode
from service.server.nodes import NodeRegistry
from service.server.session_clocks import SessionClocks
from service.server.session_store import SessionStore, check_revision, user_fields_revision
from service.server.streams import ServerStream
from service.sessions.edges import (
    EDGE_MARKERS_MAX,
    collect_edge_markers,
    make_edge_markers,
    read_sync_section,
)
from service.sessions.inputs import SessionInputs, make_inputs
from service.sessions.lifecycle import (
    Abandon,
    Delete,
    Event,
    Reevaluate,
    Sealed,
    Step,
    Stop,
    apply_event,
    compute_present_ledger,
    create_session,
    has_unreadable_journal,
    iterate_needed_parts,
)
from service.sessions.parts import NodeFacts, compute_warm_up, find_first_seq
from service.sessions.sealing import write_sealed_files
from storage.clock.table import ClockTable, StreamClockFacts, group_rows_by_stream_in_given_order
from storage.edges import read_edges
from storage.intervals import NO_END, Intervals, to_open_pairs
from storage.sessions.folder import IdempotencyRecord, Ledger, Marker, Part, Session
from storage.sessions.ledger import group_numbers_by_stream
from storage.sessions.metadata import write_markers

log = logging.getLogger("foottile.recorder")

MAX_DELAY_S = 2.0
_RETRY_S = 10.0
_COMPILE_POLL_S = 0.1
_UNREADABLE_JOURNAL = "a journal cannot be read now, and is retried: see the server's problems"


class Recorder:
    """Recording on the nodes of a server, until the sealed file.

    Args:
        store: sessions of the server.
        nodes: nodes to record on.
        request_resend: called with a node that may still have frames that are damaged here.
        unquantized: True: estimates are not rounded.
    """

    def __init__(
        self,
        store: SessionStore,
        nodes: NodeRegistry,
        request_resend: Callable[[ServerNode], None],
        *,
        unquantized: bool = False,
    ) -> None:
        self._store = store
        self._nodes = nodes
        self._request_resend = request_resend
        self._unquantized = unquantized
        self._sealing: dict[str, asyncio.Task[None]] = {}
        self._retry_after_s: dict[str, float] = {}
        self._failures: dict[str, str] = {}
        self._edge_ids: dict[str, set[str]] = {}
        """Ids of the edges that a session being recorded has as markers."""
        self.clocks = SessionClocks(store, nodes)

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
        newest = node.last_seq, node.last_t_ns
        stream = node.present_stream
        coming = node.present_stream_lost_or_pending & stream.obtainable
        live = node.estimator.live
        seq_first = find_first_seq(stream.make_session_stream(), newest, pre_roll_s, coming)
        session = create_session(
            node.last_info,
            name,
            Part(stream_id=node.stream_id, seq_first=seq_first),
            scene_content=node.hello.scene,
            calibration=live.calibration,
            calibration_source=node.estimator.calibration_source,
            subject=subject,
            notes=notes,
            tags=tags,
            take=take,
            request=request,
            warm_up=compute_warm_up(
                node.last_info, seq_first, live.settling_time_s, live.unloaded_seq
            ),
            missed_slots_at_start=stream.missed_slots,
            vitals_at_start=node.vitals,
            clock=stream.list_clock_offsets_since(seq_first),
        )
        return self._store.save(session)

    def stop_session(self, session_id: str) -> Session:
        """Stop a session now; it is sealed as soon as all its frames are here.

        To stop a stopped session has no effect.

        Raises:
            UnknownError: no session has this id.
            StorageError: the session cannot be saved.
        """
        if self._apply(self._store.get_session(session_id), Stop()).is_changed:
            self.advance_unsealed_sessions()
        return self._store.get_session(session_id)

    def abandon_missing(self, session_id: str) -> Session:
        """Seal a pending session without its missing frames: its node never comes back.

        Raises:
            UnknownError: no session has this id.
            StateError: it is not pending.
            StorageError: the session cannot be saved.
        """
        session = self._store.get_session(session_id)
        try:
            self._apply(session, Abandon())
        except DamagedFramesError as error:  # at its end: without these frames
            self._invalidate(session, error)
            self._apply(session, Abandon())
        self._clear_failure(session_id)
        self.advance_unsealed_sessions()
        return self._store.get_session(session_id)

    def move_to_trash(self, session_id: str, *, if_revision: str | None = None) -> None:
        """Move a session to the trash.

        Args:
            session_id: id of the session.
            if_revision: expected `user_fields_revision`; None: any.

        Raises:
            UnknownError: no session has this id.
            ChangedError: its revision is another one.
            StateError: it is being recorded, or is being sealed now.
            StorageError: it cannot be moved.
        """
        session = self._store.get_session(session_id)
        check_revision(if_revision, user_fields_revision(session), f"session {session_id}")
        apply_event(session, Delete())
        if session_id in self._sealing:
            raise StateError(
                f"session {session_id} is being sealed", remedy="Delete it in some seconds"
            )
        self._store.move_to_trash(session)
        self._clear_failure(session_id)

    def restore_session(self, session_id: str) -> Session:
        """Restore a session from the trash; a pending one stays pending.

        Raises:
            UnknownError: it is not in the trash.
            StorageError: it cannot be moved.
        """
        store = self._store
        store.cache(self.clocks.add_missing_rows(store.trash.restore(session_id, store.folder)))
        self.advance_unsealed_sessions()
        store.on_change(store.get_session(session_id))
        return store.get_session(session_id)

    def extend_node_sessions(self, node: ServerNode) -> None:
        """Extend the unsealed sessions of a node into the streams that its hello lists.

        If its tiles have changed, a new session continues the recording: a file describes one
        array.

        Raises:
            StorageError: a session cannot be saved.
        """
        for session in self._store.list_unsealed(node.name):
            # The ends of the others are known: with a full disk, saving them can wait.
            if session.state != "sealing" and session.parts[-1].seq_last is None:
                self._reevaluate_session(session)

    def advance_unsealed_sessions(self) -> None:
        """Find the ends of stopped sessions, and start to seal those whose frames are all here."""
        for session in self._store.list_unsealed():
            is_due = time.monotonic() >= self._retry_after_s.get(session.id, 0.0)
            if not is_due or session.id in self._sealing:
                continue
            try:
                self._advance(session)
            except FootTileError as error:  # other sessions must not wait for this one
                log.warning("session %s: %s", session.id, error)
                self._retry_after_s[session.id] = time.monotonic() + _RETRY_S

    async def wait_until_sealed_or_timeout(self, session_id: str, timeout_s: float) -> Session:
        """Return the session once it is sealed, or its present state after `timeout_s`."""
        end = time.monotonic() + timeout_s
        while self._store.get_session(session_id).state != "sealed" and time.monotonic() < end:
            await asyncio.sleep(0.02)
        return self._store.get_session(session_id)

    async def wait_for_running_sealing(self) -> None:
        """Wait until the sessions that are being sealed are sealed; none is cancelled."""
        await asyncio.gather(*self._sealing.values(), return_exceptions=True)

    def get_ledger(self, session_id: str) -> Ledger:
        """Return the present ledger of a session: the fate of every frame.

        Raises:
            UnknownError: no session has this id.
        """
        return self.compute_ledger(self._store.get_session(session_id))

    def compute_ledger(self, session: Session) -> Ledger:
        """Return the present ledger of a session that may be in the trash."""
        return compute_present_ledger(session, self._get_facts(session.node))

    def find_problem_to_show(self, session: Session) -> str | None:
        """Return the user-visible problem of a session, if any."""
        return self._failures.get(session.id, session.problem)

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

    def find_pending_reason(
        self, session: Session, ledger: Ledger
    ) -> Literal["frames", "end"] | None:
        """Return the reason why a session is pending: missing frames, or an unknown end."""
        if session.state != "pending":
            return None
        if ledger.pending:
            return "frames"
        return "end" if session.parts[-1].seq_last is None else None

    def collect_inputs_from_journals(self, session_id: str) -> SessionInputs:
        """Collect the inputs from which a session can be sealed or exported now.

        Raises:
            UnknownError: no session has this id, or its node is unknown here.
        """
        session = self._store.get_session(session_id)
        node = self._nodes.get(session.node)
        return make_inputs(
            session,
            node.make_session_facts(),
            load_tares=lambda: node.estimator.tare_history,
            emulated=node.hello.emulated,
            default_array=node.last_info,
            unquantized=self._unquantized,
        )

    def collect_needed_frames(self, node_name: str) -> dict[str, Intervals]:
        """Return the frames that unsealed sessions of a node need in its journals, by stream id.

        A session in the trash can be restored, so its frames count as well.
        """
        node = self._nodes.find(node_name)
        if self._store.has_unreadable and node is not None:
            return {stream_id: Intervals([(0, NO_END)]) for stream_id in node.streams}
        facts = self._get_facts(node_name)
        return group_numbers_by_stream(
            part
            for session in (*self._store.list_unsealed(), *self._store.trash.list_unsealed())
            if session.node == node_name
            for part in iterate_needed_parts(session, facts)
        )

    def make_retention_request(self, node_name: str) -> RetentionMessage:
        """Return `collect_needed_frames` as the message to the node."""
        streams = tuple(
            StreamNumbers(stream_id=stream_id, numbers=to_open_pairs(numbers))
            for stream_id, numbers in sorted(self.collect_needed_frames(node_name).items())
        )
        return RetentionMessage(streams=streams, recording=bool(self.list_recording(node_name)))

    def invalidate_and_request_resend(
        self, node: ServerNode, error: DamagedFramesError, log_prefix: str
    ) -> None:
        """Invalidate frames that are damaged on disk: request them again, or count them as lost.

        Args:
            node: node of the journal.
            error: error with the frames' numbers.
            log_prefix: reader that found the damage, for the log.
        """
        folder = Path(error.where).parent
        for stream in node.streams.values():
            if stream.folder == folder:
                damaged = Intervals([(error.seq_first, error.seq_last)])
                stream.invalidate(damaged, are_corrupt=True)
                log.warning("%s: %s", log_prefix, error)
                if stream.obtainable & damaged:
                    self._request_resend(node)

    def _invalidate(self, session: Session, error: DamagedFramesError) -> None:
        self.invalidate_and_request_resend(
            self._nodes.get(session.node), error, f"session {session.id}"
        )

    def add_live_edges(self, node: ServerNode, stream: ServerStream, payload: bytes) -> None:
        """Add the edges of a stored message to the sessions being recorded, in memory.

        Subscribers get them with the next heartbeat. At sealing edges are read from the journal;
        the clock may be known better then.
        """
        sessions = [
            session
            for session in self.list_recording(node.name)
            if session.parts[-1].stream_id == stream.stream_id
            and len(session.markers) < EDGE_MARKERS_MAX
        ]
        if not sessions or not (edges := read_edges(payload, stream.decoder.schema)):
            return
        frames = stream.decoder.decode(payload)
        first, last = int(frames.seq[0]), int(frames.seq[-1])
        if stream.stored.missing_in(first, last):  # refused, or the disk is full
            return
        rows = group_rows_by_stream_in_given_order(stream.clock_offsets)
        clock = ClockTable(rows, [StreamClockFacts(stream.stream_id)], [stream.stream_id])
        for session in sessions:
            section, before = read_sync_section(session), session.parts[-1].seq_first - first
            if section is None or before >= len(frames):
                continue
            # Edges are read with a frame, so all those of later messages are behind the first.
            begin_ns = int(frames.t_mono_ns[before]) if before >= 0 else 0
            own = [edge for edge in edges if edge.t_mono_ns >= begin_ns]
            self._cache_edges(session, make_edge_markers(own, section, stream.info, clock, 0))

    async def restore_live_edges(self) -> None:
        """Add the edges in the journals to the sessions being recorded, after a restart."""
        for session in self._store.list_unsealed():
            if session.state == "recording" and read_sync_section(session) is not None:
                with suppress(FootTileError):  # no node, a damaged journal, or a deleted session
                    inputs = self.collect_inputs_from_journals(session.id)
                    found = await asyncio.to_thread(collect_edge_markers, inputs)
                    self._cache_edges(self._store.get_session(session.id), found.markers)

    def _cache_edges(self, session: Session, edges: Sequence[Marker]) -> None:
        known = self._edge_ids.get(session.id)
        if known is None:
            known = self._edge_ids[session.id] = {marker.id for marker in session.markers}
        new = [marker for marker in edges if marker.id not in known]
        if new and session.state == "recording":
            known.update(marker.id for marker in new)
            markers = (*session.markers, *new)
            self._store.cache(session.model_copy(update={"markers": markers}))

    def _clear_failure(self, session_id: str) -> None:
        """Drop the record of a failed sealing: retry at once and do not report the failure."""
        self._retry_after_s.pop(session_id, None)
        self._failures.pop(session_id, None)

    def _get_facts(self, node_name: str) -> NodeFacts:
        node = self._nodes.find(node_name)
        if node is None:
            return NodeFacts(now_t_ns=server_utc_ns(), is_running=True)
        return node.make_session_facts()

    def _apply(self, session: Session, event: Event) -> Step:
        """Apply an event to a session, and save the changed sessions.

        Raises:
            StateError: the session's state refuses the event.
            DamagedFramesError: the frames at its end are damaged.
            StorageError: a session cannot be saved.
        """
        step = apply_event(session, event, self._get_facts(session.node))
        is_continued = bool(step.continuations) and any(
            other.continues == session.id for other in self._store.iterate_newest_first()
        )
        for each in step.sessions_to_save:
            if each is step.session or not is_continued:
                self._store.save(each)
        return step

    def _reevaluate_session(self, session: Session) -> Step:
        """Follow the node's present facts; frames that are damaged are requested again."""
        try:
            return self._apply(session, Reevaluate())
        except DamagedFramesError as error:
            self._invalidate(session, error)
            return Step(session)

    def _advance(self, session: Session) -> None:
        if self._has_unreadable_journal(session):
            self._nodes.get(session.node).retry_unreadable_journals()
            if self._has_unreadable_journal(session):
                self._failures[session.id] = _UNREADABLE_JOURNAL
                self._retry_after_s[session.id] = time.monotonic() + _RETRY_S
                return
            self._failures.pop(session.id, None)
        if session.state == "recording":  # changes only at its node's hello
            return
        if session.state == "sealing" or self._reevaluate_session(session).action == "seal":
            self._sealing[session.id] = asyncio.create_task(self._seal(session.id))

    def _has_unreadable_journal(self, session: Session) -> bool:
        node = self._nodes.find(session.node)
        if node is None or not node.unreadable_streams:
            return False
        return has_unreadable_journal(session, node.make_session_facts())

    async def _seal(self, session_id: str) -> None:
        store = self._store
        while is_compiling():  # else this thread compiles, and the event loop waits
            await asyncio.sleep(_COMPILE_POLL_S)
        try:
            session = store.get_session(session_id)
            self._nodes.get(session.node)  # raises if it is unknown: nothing is known of its frames
            # The disk may have lost frames that it had accepted: the node has to send them again.
            step = self._apply(session, Reevaluate())
            if step.action != "seal":
                return
            inputs = self.collect_inputs_from_journals(session_id)
            folder, ledger = store.folder.get_path(session_id), self.get_ledger(session_id)
            sealed = await asyncio.to_thread(write_sealed_files, inputs, folder, ledger)
            step = apply_event(store.get_session(session_id), Sealed(sealed))
            if step.action == "write_markers":
                write_markers(step.session, folder)
            self._failures.pop(session_id, None)
            store.save(step.session)
        except DamagedFramesError as error:
            session = store.get_session(session_id)
            self._invalidate(session, error)
            self._apply(session, Reevaluate())
        except Exception as error:
            if not isinstance(error, FootTileError):
                log.exception("session %s: this is a bug", session_id)
            log.warning("session %s cannot be sealed: %s", session_id, error)
            self._retry_after_s[session_id] = time.monotonic() + _RETRY_S
            self._failures[session_id] = f"cannot be sealed yet, and is retried: {error}"
            store.on_change(store.get_session(session_id))
        finally:
            self._edge_ids.pop(session_id, None)
            del self._sealing[session_id]
