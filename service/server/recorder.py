"""Recording: starts, stops, gives up, deletes and restores sessions, and reports them.

Starting and stopping only note numbers and instants; the frames are in the journals anyway.
`service.server.settling` does what follows.
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
"""Eight probes may take 40 s on a link that hardly carries anything."""


class Recorder:
    """Records on the nodes of a server.

    Args:
        book: its sessions.
        nodes: whose frames are recorded.
        settling: ends and seals sessions.
    """

    def __init__(self, book: SessionBook, nodes: ServerNodes, settling: Settling) -> None:
        self._book = book
        self._nodes = nodes
        self._settling = settling
        for session in book.unsealed():
            book.note(self._with_clock(session))

    def know(self, node: ServerNode) -> None:
        """A node has said hello: its sessions get what they lack of its clock measurements.

        They lack those of a node that was not known before, and of streams in which they went on.
        """
        for session in self._book.unsealed(node.name):
            if session.state != "sealing":
                self._book.note(self._with_clock(session))

    def recording_on(self, node: str) -> list[Session]:
        """Sessions that are being recorded on a node."""
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
        """Begin a session with the next frame, or `pre_roll_s` earlier if the ring reaches so far.

        Others may be recorded on the same node at the same time. Whether it was `asked` for before
        is for the caller to look up: `SessionBook.begun_by`.

        Raises:
            UnknownError: no such node.
            StateError: it is away, or has sent nothing yet.
            StorageError: the session cannot be written down; nothing was started then.
        """
        node = self._nodes.get(node_name)
        if not node.connected or node.last_seq is None or node.last_t_ns is None:
            raise StateError(
                f"node {node_name!r} is not sending", remedy="Record when it is connected"
            )
        behind_s = (node.node_t_ns(utc_ns()) - node.last_t_ns) * 1e-9
        if node.clock is not None and behind_s > BEHIND_S:
            raise StateError(
                f"node {node_name!r} is {behind_s:.1f} s behind: its link is too slow",
                remedy="Record when it has caught up",
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
        """End a session at this instant; it is sealed as soon as all its frames are there.

        One that was stopped before stays as it is: a stop that is sent again is the same stop.

        Raises:
            UnknownError: no such session.
            StorageError: that cannot be written down.
        """
        session = self._book.get(session_id)
        if session.state != "recording":
            return session
        self._book.keep(following.stopped(session, self._nodes.find(session.node)))
        self._settling.settle()
        return self._book.get(session_id)

    def give_up(self, session_id: str) -> Session:
        """Seal a pending session without what has not come: its node never will.

        Raises:
            UnknownError: no such session.
            StateError: it is not pending.
            StorageError: that cannot be written down.
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
            # What a journal holds that cannot be read is given up; what followed it is elsewhere.
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
            session_id: of the session.
            only_if: only if `said_of` it is still this; None: whatever it is.

        Raises:
            UnknownError: no such session.
            ChangedError: what people say of it is not this any more.
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
        """Restore a session from the trash; if it was pending, it stays pending.

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
        """Keep a new measurement of a node's clock, with its sessions too.

        The stream's log has it already; sessions are written with their next change. A row says
        what this server's own clock showed some seconds ago: one that is far from that is not kept,
        nor is one that is far from the node's clock as hello stated it.
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
        except StorageError as error:  # it counts all the same
            log.warning("node %s: %s", node.name, error)
        offset = node.present.clock_rows[-1]
        for session in self._book.unsealed(node.name):
            is_its_own = any(part.boot_id == node.boot_id for part in session.parts)
            if is_its_own and session.state != "sealing":
                clock = (*session.clock, offset)
                self._book.note(session.model_copy(update={"clock": clock}))

    def ledger(self, session_id: str) -> Ledger:
        """What became of every frame of a session, as of now.

        Raises:
            UnknownError: no such session.
        """
        return self.ledger_of(self._book.get(session_id))

    def ledger_of(self, session: Session) -> Ledger:
        """The same of a session that may be in the trash."""
        return ledger_now(session, self._nodes.find(session.node))

    def completeness_of(self, session: Session) -> Completeness:
        """What there is of a session, as of now."""
        return self.ledger_of(session).completeness

    def problem_of(self, session: Session) -> str | None:
        """What a person should know of a session as it is now."""
        return self._settling.problem_of(session)

    def duration_s(self, session: Session, frames: int) -> float:
        """Its length: exact for a sealed session, else as long as frames have come for it.

        No shorter than its frames take at the nominal rate, which is the fastest there is.
        """
        node = self._nodes.find(session.node)
        if session.state == "sealed" or node is None:
            return session.duration_s
        seen_t_ns = node.last_seen_t_ns if frames else None
        end_t_ns = min(session.stopped_t_ns or NO_END, seen_t_ns or 0)
        lasted_s = (end_t_ns - session.started_t_ns) * 1e-9
        return max(frames / node.info.nominal_rate_hz, lasted_s)

    def waits_for(self, session: Session, ledger: Ledger) -> Literal["frames", "end"] | None:
        """What a pending session waits for: frames, or only to be told that there are no more."""
        if session.state != "pending":
            return None
        if ledger.pending:
            return "frames"
        return "end" if session.parts[-1].seq_last is None else None

    def sources(self, session_id: str) -> Sources:
        """Sources that a session can be sealed or exported from.

        Raises:
            UnknownError: no such session, or its node is not known here.
        """
        session = self._book.get(session_id)
        return self._settling.sources(session)

    def needed(self, node_name: str) -> dict[str, Intervals]:
        """Numbers by boot_id that sessions of a node, not sealed yet, need in its journals.

        A session in the trash can be restored, so it needs its frames as well.
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
        """The same numbers as the message that the node gets."""
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
                known = [row.t_mono_ns for row in session.clock if row.boot_id == boot_id]
                # A log may be long: it is read for what is in it and not in the session.
                if (
                    stream is not None
                    and stream.clock is not None
                    and (stream.clock.t_mono_ns > max(known, default=-1))
                ):
                    session = session.with_clock(stream.all_clock_rows())
        except StorageError as error:  # its frames are worth more than its clock
            log.warning("session %s: %s", session.id, error)
        return session
