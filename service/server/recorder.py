"""Recording: sessions as intervals of the nodes' streams, from their start to the sealed file.

Starting and stopping only note numbers and instants; the frames are in the journals anyway. A
session that was stopped while its node was away is `pending` until the node has brought what it
took before the stop. Sealing runs in a thread and is tried again if the disk is full.
"""

from __future__ import annotations

import asyncio
import logging
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from devices.errors import (
    DamagedFramesError,
    FootTileError,
    StateError,
    StorageError,
    UnknownError,
)
from service.link import ClockRow, StreamNumbers, Wanted
from service.server import following
from service.server.node import ServerNode
from service.server.nodes import ServerNodes
from service.server.trash import Trash
from service.server_clock import utc_ns
from service.sessions.begin import begun
from service.sessions.ends import at_stop
from service.sessions.sealing import seal
from service.sessions.sources import Sources, sources_of
from service.sessions.streams import SessionStream
from storage.intervals import NO_END, Intervals, with_open_ends
from storage.sessions.events import write_events
from storage.sessions.folder import Event, Ledger, Session, SessionFolder
from storage.sessions.ledger import ledger_of
from storage.sessions.states import numbers_of, states_of

log = logging.getLogger("foottile.recorder")

_SEAL_AGAIN_S = 10.0
BEHIND_S = 2.0


class Recorder:
    """All sessions of a server.

    Args:
        folder: where they are kept.
        trash: where those are that were deleted.
        nodes: whose frames are recorded.
        changed: told of every session that changed.
        ask_again: told of a node that may still have frames that are damaged here.

    Raises:
        FileFormatError: a session's file is damaged.
    """

    def __init__(
        self,
        folder: SessionFolder,
        trash: Trash,
        nodes: ServerNodes,
        *,
        changed: Callable[[Session], None],
        ask_again: Callable[[ServerNode], None],
    ) -> None:
        self.folder = folder
        self.trash = trash
        self._nodes = nodes
        self._changed = changed
        self._ask_again = ask_again
        self._sealing: dict[str, asyncio.Task[None]] = {}
        self._again_after: dict[str, float] = {}
        self._not_sealed: dict[str, str] = {}
        found, unreadable = folder.load_all()
        for session_id, error in unreadable.items():
            log.warning("session %s is left out: %s", session_id, error)
        self._unreadable = bool(unreadable) or trash.has_unreadable
        """Is it unknown what some session needs? Then nothing is given up."""
        self._sessions = {session.id: self._with_clock(session) for session in found}

    def all(self) -> list[Session]:
        """All sessions, newest first."""
        return sorted(self._sessions.values(), key=lambda s: (s.started_t_ns, s.id), reverse=True)

    def get(self, session_id: str) -> Session:
        """One session, with the counts of the moment.

        Raises:
            UnknownError: there is none of this id.
        """
        self.folder.path(session_id)
        if session_id not in self._sessions:
            remedy = "It is in the trash: restore it first" if session_id in self.trash else ""
            raise UnknownError(f"no session {session_id!r}", remedy=remedy)
        return self._sessions[session_id]

    def recording_on(self, node: str) -> list[Session]:
        """Sessions that are being recorded on a node."""
        return [s for s in self._sessions.values() if s.node == node and s.state == "recording"]

    def start(
        self,
        node_name: str,
        name: str,
        *,
        pre_roll_s: float = 0.0,
        subject: str = "",
        notes: str = "",
        tags: tuple[str, ...] = (),
    ) -> Session:
        """Begin a session with the next frame, or `pre_roll_s` earlier if the ring reaches so far.

        Others may be recorded on the same node at the same time.

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
            calibration=node.live.calibration,
            subject=subject,
            notes=notes,
            tags=tags,
            missed_slots_at_start=node.present.missed_slots,
            clock=following.clock_at_start(node, part),
        )
        self._keep(session)
        return session

    def stop(self, session_id: str) -> Session:
        """End a session at this instant; it is sealed as soon as all its frames are there.

        Raises:
            UnknownError: no such session.
            StateError: it was stopped before.
            StorageError: that cannot be written down.
        """
        session = self.get(session_id)
        if session.state != "recording":
            raise StateError(
                f"session {session_id} was stopped already and is {session.state}",
                expected="a session that is recording",
            )
        self._keep(following.stopped(session, self._nodes.find(session.node)))
        self.settle()
        return self._sessions[session_id]

    def change(self, session_id: str, **changes: object) -> Session:
        """Change what people say of a session: name, subject, notes, tags.

        Raises:
            UnknownError: no such session.
            StorageError: it cannot be written down.
        """
        session = self.get(session_id).model_copy(update=changes)
        self._keep(session)
        return session

    def mark(
        self, session_id: str, label: str, t_ns: int | None, event_id: str | None = None
    ) -> Event:
        """Note an event, now or at `t_ns` of the server's UTC; once, if it comes with an id.

        Raises:
            UnknownError: no such session.
            StorageError: it cannot be written down.
        """
        session = self.get(session_id)
        for known in session.events:
            if known.id == event_id:
                return known
        event = Event(
            id=event_id or uuid.uuid4().hex[:12],
            label=label,
            t_ns=utc_ns() if t_ns is None else t_ns,
        )
        session = session.model_copy(update={"events": (*session.events, event)})
        self._keep(session)
        if session.state == "sealed":
            write_events(session, self.folder.path(session_id))
        return event

    def give_up(self, session_id: str) -> Session:
        """Seal a pending session without what has not come: its node never will.

        Raises:
            UnknownError: no such session.
            StateError: it is not pending.
            StorageError: that cannot be written down.
        """
        session = self.get(session_id)
        if session.state != "pending":
            raise StateError(
                f"session {session_id} is {session.state}",
                expected="a session that is pending",
                remedy="Stop it first" if session.state == "recording" else "",
            )
        self._keep(following.given_up(session, self._nodes.find(session.node)))
        self._again_after.pop(session_id, None)
        self.settle()
        return self._sessions[session_id]

    def discard(self, session_id: str) -> None:
        """Move a session to the trash.

        Raises:
            UnknownError: no such session.
            StateError: it is being recorded, or sealed.
            StorageError: it cannot be moved.
        """
        session = self.get(session_id)
        if session.state == "recording":
            raise StateError(f"session {session_id} is being recorded", remedy="Stop it first")
        if session_id in self._sealing:
            raise StateError(
                f"session {session_id} is being sealed", remedy="Delete it in some seconds"
            )
        self.trash.take(session, self.folder)
        del self._sessions[session_id]
        self._again_after.pop(session_id, None)
        self._not_sealed.pop(session_id, None)

    def restore(self, session_id: str) -> Session:
        """Have a session back from the trash; if it was pending, it goes on to be so.

        Raises:
            UnknownError: it is not in the trash.
            StorageError: it cannot be moved.
        """
        session = self._with_clock(self.trash.give_back(session_id, self.folder))
        self._sessions[session_id] = session
        self.settle()
        self._changed(self._sessions[session_id])
        return self._sessions[session_id]

    def follow(self, node: ServerNode) -> None:
        """The node has said which streams it took: its sessions go on in them.

        If its tiles are others now, a session of its own takes up a recording: a file describes
        one array.

        Raises:
            StorageError: that cannot be written down.
        """
        for session in [s for s in self._sessions.values() if s.node == node.name]:
            if session.state in ("recording", "pending"):
                try:
                    self._follow(session)
                except DamagedFramesError as error:
                    self._disown(session, error)

    def note_clock(self, node: ServerNode, row: ClockRow) -> None:
        """Keep a new measurement of a node's clock, with its sessions too.

        It is in the stream's log; theirs are written down with the next change.
        """
        try:
            node.present.note_clock(row)
        except StorageError as error:  # it counts all the same
            log.warning("node %s: %s", node.name, error)
        offset = node.present.clock_rows[-1]
        for session in self._sessions.values():
            unsealed = session.node == node.name and session.state in ("recording", "pending")
            if unsealed and any(part.boot_id == node.boot_id for part in session.parts):
                clock = (*session.clock, offset)
                self._sessions[session.id] = session.model_copy(update={"clock": clock})

    def settle(self) -> None:
        """Find the end of stopped sessions, and seal those whose frames are all there."""
        for session_id in list(self._sessions):
            if time.monotonic() < self._again_after.get(session_id, 0.0):
                continue
            try:
                self._settle(session_id)
            except FootTileError as error:  # one that cannot be must not hold up the others
                log.warning("session %s: %s", session_id, error)
                self._again_after[session_id] = time.monotonic() + _SEAL_AGAIN_S

    async def settled(self, session_id: str, timeout_s: float) -> Session:
        """The session once it is sealed, or as it is after `timeout_s`."""
        end = time.monotonic() + timeout_s
        while self._sessions[session_id].state != "sealed" and time.monotonic() < end:
            await asyncio.sleep(0.02)
        return self._sessions[session_id]

    async def close(self) -> None:
        """Wait for what is being sealed."""
        await asyncio.gather(*self._sealing.values(), return_exceptions=True)

    def ledger(self, session_id: str) -> Ledger:
        """What became of every frame of a session, as of now.

        Raises:
            UnknownError: no such session.
        """
        return self.ledger_of(self.get(session_id))

    def ledger_of(self, session: Session) -> Ledger:
        """The same of a session that may be in the trash."""
        if session.state == "sealed" and session.ledger is not None:
            return session.ledger
        finished = session.stopped_t_ns is not None and session.parts[-1].seq_last is not None
        about, streams = self._provisional(session)
        return ledger_of(about.parts, states_of(about, streams), finished=finished)

    def problem_of(self, session: Session) -> str | None:
        """What a person should know of a session as it is now."""
        return self._not_sealed.get(session.id, session.problem)

    def duration_s(self, session: Session, frames: int) -> float:
        """How long it is: of a sealed one exactly, else by the stream's nominal rate."""
        node = self._nodes.find(session.node)
        if session.state == "sealed" or node is None:
            return session.duration_s
        return frames / node.info.nominal_rate_hz

    def sources(self, session_id: str) -> Sources:
        """What a session is made from, sealed or given away before.

        Raises:
            UnknownError: no such session.
        """
        session, streams = self._provisional(self.get(session_id))
        node = self._nodes.get(session.node)
        return sources_of(
            session,
            streams,
            tares=lambda: node.tares,
            emulated=node.hello.emulated,
            no_array=node.info,
        )

    def needed(self, node_name: str) -> dict[str, Intervals]:
        """Numbers by boot_id that sessions of a node, not sealed yet, need in its journals.

        What is in the trash can be had back, so it needs its frames as well.
        """
        node = self._nodes.find(node_name)
        if self._unreadable and node is not None:
            return {boot_id: Intervals([(0, NO_END)]) for boot_id in node.streams}
        return numbers_of(
            part
            for session in (*self._sessions.values(), *self.trash.all())
            if session.node == node_name and session.state != "sealed"
            for part in following.parts_needed(session, node)
        )

    def wanted(self, node_name: str) -> Wanted:
        """The same as the node is told it."""
        streams = tuple(
            StreamNumbers(boot_id=boot_id, numbers=with_open_ends(numbers))
            for boot_id, numbers in sorted(self.needed(node_name).items())
        )
        return Wanted(streams=streams, recording=bool(self.recording_on(node_name)))

    def _settle(self, session_id: str) -> None:
        session = self._sessions[session_id]
        try:
            if session.state == "pending":
                session = self._follow(session)
        except DamagedFramesError as error:
            self._disown(session, error)
            return
        if session.state == "pending" and self._is_all_here(session):
            session = self._keep(session.model_copy(update={"state": "sealing"}))
        if session.state == "sealing" and session_id not in self._sealing:
            self._sealing[session_id] = asyncio.create_task(self._seal(session_id))

    def _is_all_here(self, session: Session) -> bool:
        """Is nothing more to come, and what is here on the disk?"""
        if session.parts[-1].seq_last is None:
            return False
        node = self._nodes.find(session.node)
        for part in session.parts:
            stream = node.streams.get(part.boot_id) if node is not None else None
            last = NO_END if part.seq_last is None else part.seq_last
            if stream is not None and stream.unsynced.within(part.seq_first, last):
                return False
        return not any(part.pending for part in self.ledger_of(session).parts)

    def _follow(self, session: Session) -> Session:
        """The session as far as its node's streams go by now."""
        node = self._nodes.find(session.node)
        if node is None:
            return session
        followed = following.followed(session, node)
        # Those that take it up first: if the server is killed between, none is forgotten.
        if not any(known.continues == session.id for known in self._sessions.values()):
            for further in reversed(followed[1:]):
                self._keep(further)
        return session if followed[0] is session else self._keep(followed[0])

    def _disown(self, session: Session, error: DamagedFramesError) -> None:
        """Frames on the disk are not what was written: have them again, or count them as lost."""
        node, folder = self._nodes.get(session.node), Path(error.where).parent
        for stream in node.streams.values():
            if stream.folder == folder:
                damaged = Intervals([(error.seq_first, error.seq_last)])
                stream.disown(damaged, corrupt=True)
                log.warning("session %s: %s", session.id, error)
                if stream.may_come & damaged:
                    self._ask_again(node)

    async def _seal(self, session_id: str) -> None:
        try:
            sources = self.sources(session_id)
            ledger = self.ledger(session_id)
            if not self._is_all_here(self._sessions[session_id]):
                # A disk did not keep what it had taken: these frames have to come once more.
                session = self._sessions[session_id]
                self._keep(session.model_copy(update={"state": "pending"}))
                return
            sealed = await asyncio.to_thread(seal, sources, self.folder.path(session_id), ledger)
            # Name, notes and events may have changed meanwhile.
            now = self._sessions[session_id]
            people = {n: getattr(now, n) for n in ("name", "subject", "notes", "tags", "events")}
            if now.events != sealed.events:
                write_events(now, self.folder.path(session_id))
            self._not_sealed.pop(session_id, None)
            self._keep(sealed.model_copy(update=people))
        except DamagedFramesError as error:
            session = self._sessions[session_id]
            self._disown(session, error)
            self._keep(session.model_copy(update={"state": "pending"}))
        except Exception as error:
            if not isinstance(error, FootTileError):
                log.exception("session %s: this is a bug", session_id)
            log.warning("session %s cannot be sealed: %s", session_id, error)
            self._again_after[session_id] = time.monotonic() + _SEAL_AGAIN_S
            self._not_sealed[session_id] = f"cannot be sealed yet, and is tried again: {error}"
            self._changed(self._sessions[session_id])
        finally:
            del self._sealing[session_id]

    def _provisional(self, session: Session) -> tuple[Session, dict[str, SessionStream]]:
        """A session with the end that it will have nearly, and its streams."""
        streams = following.streams_of(session, self._nodes.find(session.node))
        with suppress(FootTileError):  # the frames that tell are damaged
            session = at_stop(session, streams)
        return session, streams

    def _with_clock(self, session: Session) -> Session:
        node = self._nodes.find(session.node)
        if session.state == "sealed" or node is None:
            return session
        try:
            for boot_id in dict.fromkeys(part.boot_id for part in session.parts):
                if (stream := node.streams.get(boot_id)) is not None:
                    session = session.with_clock(stream.all_clock_rows())
        except StorageError as error:  # its frames are worth more than its clock
            log.warning("session %s: %s", session.id, error)
        return session

    def _keep(self, session: Session) -> Session:
        self.folder.save(session)
        self._sessions[session.id] = session
        self._changed(session)
        return session
