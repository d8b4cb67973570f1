"""Recording commands: start, stop, abandon, delete and restore sessions, and report them.

Starting and stopping only note numbers and times; the frames are in the journals anyway.
`service.server.settling` does the rest.
"""

from __future__ import annotations

import logging
from typing import Literal

from devices.errors import (
    StateError,
    StorageError,
)
from service.link import ClockRow, StreamNumbers, Wanted
from service.server import following
from service.server.book import SessionBook, expect, said_of
from service.server.following import ledger_now
from service.server.node import ServerNode
from service.server.nodes import ServerNodes
from service.server.settling import Settling
from service.server_clock import utc_ns
from service.sessions.begin import begun
from service.sessions.sources import Sources
from storage.intervals import NO_END, Intervals, with_open_ends
from storage.sessions.folder import Asked, Completeness, Ledger, Session
from storage.sessions.ledger import numbers_of

log = logging.getLogger("foottile.recorder")

BEHIND_S = 2.0
CLOCK_ROW_OFF_NS = 60_000_000_000
"""Tolerance: eight probes take up to 40 s on a very poor link."""


class Recorder:
    """Recording on the nodes of a server.

    Args:
        book: sessions of the server.
        nodes: nodes to record on.
        settling: ends and seals sessions.
    """

    def __init__(self, book: SessionBook, nodes: ServerNodes, settling: Settling) -> None:
        self._book = book
        self._nodes = nodes
        self._settling = settling
        for session in book.unsealed():
            book.note(self._with_clock(session))

    def know(self, node: ServerNode) -> None:
        """Add missing clock measurements to the sessions of a node that has connected.

        Those are missing after a first contact, and for streams into which a session was extended.
        """
        for session in self._book.unsealed(node.name):
            if session.state != "sealing":
                self._book.note(self._with_clock(session))

    def recording_on(self, node: str) -> list[Session]:
        """Return the sessions that are being recorded on a node."""
        return [s for s in self._book.unsealed(node) if s.state == "recording"]

    def start(
        self,
        node_name: str,
        name: str,
        *,
        pre_roll_s: float = 0.0,
        subject: str = "",
        notes: str = "",
        tags: tuple[str, ...] = (),
        take: str | None = None,
        asked: Asked | None = None,
    ) -> Session:
        """Start a session with the next frame, or `pre_roll_s` earlier if still stored.

        Several sessions may be recorded on one node at a time. The caller looks up an earlier
        sending of the same request: `SessionBook.begun_by`.

        Raises:
            UnknownError: no node has this name.
            StateError: it is not connected, or has sent no frame yet.
            StorageError: the session cannot be saved; nothing was started then.
        """
        node = self._nodes.get(node_name)
        if not node.connected or node.last_seq is None or node.last_t_ns is None:
            raise StateError(f"node {node_name!r} sends no frames", remedy="Connect it and retry")
        behind_s = (node.node_t_ns(utc_ns()) - node.last_t_ns) * 1e-9
        if node.clock is not None and behind_s > BEHIND_S:
            raise StateError(
                f"node {node_name!r} is {behind_s:.1f} s behind: its link is too slow",
                remedy="Retry when it has caught up",
            )
        part = following.first_part(node, node.last_seq, node.last_t_ns, pre_roll_s)
        session = begun(
            node.info,
            name,
            part,
            scene_content=node.hello.scene,
            calibration=node.estimates.live.calibration,
            calibration_source=node.estimates.calibration_source,
            subject=subject,
            notes=notes,
            tags=tags,
            take=take,
            asked=asked,
            missed_slots_at_start=node.present.missed_slots,
            clock=following.clock_at_start(node, part),
        )
        return self._book.keep(session)

    def stop(self, session_id: str) -> Session:
        """Stop a session now; it is sealed as soon as all its frames are here.

        A stopped session is unchanged: a repeated stop is the same stop.

        Raises:
            UnknownError: no session has this id.
            StorageError: the session cannot be saved.
        """
        session = self._book.get(session_id)
        if session.state != "recording":
            return session
        self._book.keep(following.stopped(session, self._nodes.find(session.node)))
        self._settling.settle()
        return self._book.get(session_id)

    def give_up(self, session_id: str) -> Session:
        """Seal a pending session without its missing frames: its node never comes back.

        Raises:
            UnknownError: no session has this id.
            StateError: it is not pending.
            StorageError: the session cannot be saved.
        """
        session = self._book.get(session_id)
        if session.state != "pending":
            raise StateError(
                f"session {session_id} is {session.state}",
                expected="a session that is pending",
                remedy="Stop it first" if session.state == "recording" else "",
            )
        node = self._nodes.find(session.node)
        if node is not None and following.is_unread(session, node):
            # Frames in an unreadable journal are abandoned; later streams have their own journals.
            self._book.keep(session.model_copy(update={"given_up": True}))
            self._settling.follow(node)
            session = self._book.get(session_id)
        self._book.keep(following.given_up(session, node))
        self._settling.forget(session_id)
        self._settling.settle()
        return self._book.get(session_id)

    def discard(self, session_id: str, *, only_if: str | None = None) -> None:
        """Move a session to the trash.

        Args:
            session_id: id of the session.
            only_if: expected `said_of`; None: any.

        Raises:
            UnknownError: no session has this id.
            ChangedError: its revision is another one.
            StateError: it is being recorded, or sealed.
            StorageError: it cannot be moved.
        """
        session = self._book.get(session_id)
        expect(only_if, said_of(session), f"session {session_id}")
        if session.state == "recording":
            raise StateError(f"session {session_id} is being recorded", remedy="Stop it first")
        if self._settling.is_sealing(session_id):
            raise StateError(
                f"session {session_id} is being sealed", remedy="Delete it in some seconds"
            )
        self._book.take_out(session)
        self._settling.forget(session_id)

    def restore(self, session_id: str) -> Session:
        """Restore a session from the trash; a pending one stays pending.

        Raises:
            UnknownError: it is not in the trash.
            StorageError: it cannot be moved.
        """
        book = self._book
        book.note(self._with_clock(book.trash.give_back(session_id, book.folder)))
        self._settling.settle()
        book.changed(book.get(session_id))
        return book.get(session_id)

    def note_clock(self, node: ServerNode, row: ClockRow, now_t_ns: int) -> None:
        """Record a measurement of a node's clock, in its stream and its sessions.

        The stream's log has it already; sessions are saved with their next change. A measurement
        whose server time is far from the present time is dropped, as is one that is far from the
        node's clock as hello stated it.
        """
        said_t_ns = row.t_mono_ns + node.info.utc_offset_ns + row.server_minus_node_ns
        if abs(said_t_ns - now_t_ns) > CLOCK_ROW_OFF_NS + row.uncertainty_ns:
            log.warning(
                "node %s: a measurement of its clock is not kept: it has this server's clock "
                "%.0f s off. Was that set just now?",
                node.name,
                (said_t_ns - now_t_ns) * 1e-9,
            )
            return
        limit = node.present.limit
        if limit is not None and not limit.is_of_clock(row.t_mono_ns, row.uncertainty_ns, now_t_ns):
            log.warning(
                "node %s: a measurement of its clock is not kept: its time is not the one that the "
                "node stated at connecting",
                node.name,
            )
            return
        try:
            node.present.note_clock(row)
        except StorageError as error:  # the measurement is used all the same
            log.warning("node %s: %s", node.name, error)
        offset = node.present.clock_rows[-1]
        for session in self._book.unsealed(node.name):
            is_its_own = any(part.boot_id == node.boot_id for part in session.parts)
            if is_its_own and session.state != "sealing":
                clock = (*session.clock, offset)
                self._book.note(session.model_copy(update={"clock": clock}))

    def ledger(self, session_id: str) -> Ledger:
        """Return the present ledger of a session: the fate of every frame.

        Raises:
            UnknownError: no session has this id.
        """
        return self.ledger_of(self._book.get(session_id))

    def ledger_of(self, session: Session) -> Ledger:
        """Return the present ledger of a session that may be in the trash."""
        return ledger_now(session, self._nodes.find(session.node))

    def completeness_of(self, session: Session) -> Completeness:
        """Return the present completeness of a session."""
        return self.ledger_of(session).completeness

    def problem_of(self, session: Session) -> str | None:
        """Return the user-visible problem of a session, if any."""
        return self._settling.problem_of(session)

    def duration_s(self, session: Session, frames: int) -> float:
        """Return the session's length: exact if sealed, else the time over which frames have come.

        It is at least the time of its frames at the nominal rate, which is the fastest.
        """
        node = self._nodes.find(session.node)
        if session.state == "sealed" or node is None:
            return session.duration_s
        seen_t_ns = node.last_seen_t_ns if frames else None
        end_t_ns = min(session.stopped_t_ns or NO_END, seen_t_ns or 0)
        lasted_s = (end_t_ns - session.started_t_ns) * 1e-9
        return max(frames / node.info.nominal_rate_hz, lasted_s)

    def waits_for(self, session: Session, ledger: Ledger) -> Literal["frames", "end"] | None:
        """Return the reason why a session is pending: missing frames, or an unknown end."""
        if session.state != "pending":
            return None
        if ledger.pending:
            return "frames"
        return "end" if session.parts[-1].seq_last is None else None

    def sources(self, session_id: str) -> Sources:
        """Collect the inputs from which a session can be sealed or exported.

        Raises:
            UnknownError: no session has this id, or its node is unknown here.
        """
        session = self._book.get(session_id)
        return self._settling.sources(session)

    def needed(self, node_name: str) -> dict[str, Intervals]:
        """Return the frames that unsealed sessions of a node need in its journals, by stream id.

        A session in the trash can be restored, so its frames count as well.
        """
        node = self._nodes.find(node_name)
        if self._book.has_unreadable and node is not None:
            return {boot_id: Intervals([(0, NO_END)]) for boot_id in node.streams}
        return numbers_of(
            part
            for session in (*self._book.unsealed(), *self._book.trash.unsealed())
            if session.node == node_name
            for part in following.parts_needed(session, node)
        )

    def wanted(self, node_name: str) -> Wanted:
        """Return `needed` as the message to the node."""
        streams = tuple(
            StreamNumbers(boot_id=boot_id, numbers=with_open_ends(numbers))
            for boot_id, numbers in sorted(self.needed(node_name).items())
        )
        return Wanted(streams=streams, recording=bool(self.recording_on(node_name)))

    def _with_clock(self, session: Session) -> Session:
        node = self._nodes.find(session.node)
        if session.state == "sealed" or node is None:
            return session
        try:
            for boot_id in dict.fromkeys(part.boot_id for part in session.parts):
                stream = node.streams.get(boot_id)
                times_ns = [row.t_mono_ns for row in session.clock if row.boot_id == boot_id]
                # A log may be long: read it only if the session lacks its newest row.
                if (
                    stream is not None
                    and stream.clock is not None
                    and (stream.clock.t_mono_ns > max(times_ns, default=-1))
                ):
                    session = session.with_clock(stream.all_clock_rows())
        except StorageError as error:  # frames matter more than clock measurements
            log.warning("session %s: %s", session.id, error)
        return session
