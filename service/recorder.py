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
from datetime import UTC, datetime

from devices.errors import FootTileError, StateError, UnknownError
from service import parts
from service.estimation.calibration import Calibration
from service.link import Hello
from service.nodes import Node, Nodes
from service.sealing import Sources, ledger_of, seal, write_events
from service.steady import utc_ns
from storage.intervals import Intervals
from storage.session import Event, Ledger, Session, SessionFolder, new_session_id

log = logging.getLogger("foottile.recorder")

_SEAL_AGAIN_S = 10.0
BEHIND_S = 2.0


class Recorder:
    """All sessions of a server.

    Args:
        folder: where they are kept.
        nodes: whose frames are recorded.
        changed: told of every session that changed.

    Raises:
        FileFormatError: a session's file is damaged.
    """

    def __init__(
        self, folder: SessionFolder, nodes: Nodes, changed: Callable[[Session], None]
    ) -> None:
        self.folder = folder
        self._nodes = nodes
        self._changed = changed
        self._sessions: dict[str, Session] = {}
        self._sealing: dict[str, asyncio.Task[None]] = {}
        self._again_after: dict[str, float] = {}
        self._not_sealed: dict[str, str] = {}
        for session_id in folder.ids():
            try:
                self._sessions[session_id] = folder.load(session_id)
            except FootTileError as error:
                log.warning("session %s is left out: %s", session_id, error)

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
            raise UnknownError(f"no session {session_id!r}")
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

        Raises:
            UnknownError: no such node.
            StateError: it is away, has sent nothing yet, or is being recorded already.
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
                f"node {node_name!r} is {behind_s:.1f} s behind: it is sending what it took while "
                "the link was down",
                remedy="Record when it has caught up, in a few seconds",
            )
        if recording := self.recording_on(node_name):
            raise StateError(
                f"node {node_name!r} is being recorded already: session {recording[0].id} "
                f"({recording[0].name})",
                remedy="Stop it first",
            )
        calibration = node.live.calibration
        now = datetime.now(UTC)
        session = Session(
            id=new_session_id(now),
            name=name,
            node=node_name,
            state="recording",
            started_t_ns=utc_ns(),
            parts=(parts.first_part(node, node.last_seq, node.last_t_ns, pre_roll_s),),
            subject=subject,
            notes=notes,
            tags=tags,
            scene=node.info.scene,
            scene_content=node.hello.scene,
            calibration=calibration.model_dump(mode="json") if calibration is not None else None,
            missed_slots_at_start=node.missed_slots,
            clock=parts.clock_rows(node),
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
        self._keep(parts.stopped(session, self._nodes.find(session.node)))
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

    def mark(self, session_id: str, label: str, t_ns: int | None) -> Event:
        """Note an event, now or at `t_ns` of the server's UTC.

        Raises:
            UnknownError: no such session.
            StorageError: it cannot be written down.
        """
        session = self.get(session_id)
        event = Event(
            id=uuid.uuid4().hex[:12], label=label, t_ns=utc_ns() if t_ns is None else t_ns
        )
        session = session.model_copy(update={"events": (*session.events, event)})
        self._keep(session)
        if session.state == "sealed":
            write_events(session, self.folder.path(session_id))
        return event

    def node_restarts(self, node: Node, hello: Hello) -> None:
        """The node is about to begin a new stream: its recording goes on in a new part.

        Frames of the old stream that were not sent are gone; how many there may have been is noted.
        If its tiles are others now, a session of its own takes up the recording: a file describes
        one array.

        Raises:
            StorageError: that cannot be written down.
        """
        for session in list(self._sessions.values()):
            open_here = session.parts[-1].boot_id == node.boot_id and session.node == node.name
            if open_here and session.state in ("recording", "pending"):
                after = parts.after_restart(session, node, hello)
                self._keep(after)
                if session.state == "recording" and after.state != "recording":
                    self._keep(parts.continued(after, hello))

    def note_clock(self, node: Node) -> None:
        """Keep a new measurement of a node's clock with its recordings."""
        for session in self.recording_on(node.name):
            clock = session.clock + parts.clock_rows(node)
            self._keep(session.model_copy(update={"clock": clock}))

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
        session = self.get(session_id)
        if session.state == "sealed" and session.ledger is not None:
            return session.ledger
        node = self._nodes.find(session.node)
        missed = node.missed_slots - session.missed_slots_at_start if node is not None else 0
        return ledger_of(
            session,
            {boot_id: journal.held for boot_id, journal in node.journals.items()} if node else {},
            open_boot_id=node.boot_id if node is not None else None,
            node_first_seq=node.node_first_seq if node is not None else 0,
            missed_slots=max(0, missed),
            finished=session.stopped_t_ns is not None,
        )

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
        session = self.get(session_id)
        node = self._nodes.get(session.node)
        first = node.journals.get(session.parts[0].boot_id)
        info = first.info if first is not None else node.info
        tares, problem = parts.tares_of(session, node, info)
        calibration = None
        if session.calibration is None:
            problem = "the node had no calibration"
        elif problem is None:
            calibration = Calibration.model_validate(session.calibration)
        return Sources(
            session=session,
            info=info,
            journals=dict(node.journals),
            calibration=calibration,
            problem=problem,
            tares=tares,
            notes={"scene": session.scene_content, "emulated": node.hello.emulated},
        )

    def needed(self, node: str) -> dict[str, Intervals]:
        """Numbers by boot_id that unsealed sessions of a node still need in its journals."""
        return parts.needed(
            s for s in self._sessions.values() if s.node == node and s.state != "sealed"
        )

    def _settle(self, session_id: str) -> None:
        session = self._sessions[session_id]
        if session.state == "pending":
            session = parts.with_end(session, self._nodes.get(session.node))
            if session is not self._sessions[session_id]:
                self._keep(session)
            unknown = session.parts[-1].seq_last is None
            if not unknown and not any(p.pending for p in self.ledger(session_id).parts):
                session = self._keep(session.model_copy(update={"state": "sealing"}))
        if session.state == "sealing" and session_id not in self._sealing:
            self._sealing[session_id] = asyncio.create_task(self._seal(session_id))

    async def _seal(self, session_id: str) -> None:
        try:
            sources = self.sources(session_id)
            ledger = self.ledger(session_id)
            sealed = await asyncio.to_thread(seal, sources, self.folder.path(session_id), ledger)
            # Name, notes and events may have changed meanwhile.
            now = self._sessions[session_id]
            people = {n: getattr(now, n) for n in ("name", "subject", "notes", "tags", "events")}
            if now.events != sealed.events:
                write_events(now, self.folder.path(session_id))
            self._not_sealed.pop(session_id, None)
            self._keep(sealed.model_copy(update=people))
        except Exception as error:
            if not isinstance(error, FootTileError):
                log.exception("session %s: this is a bug", session_id)
            log.warning("session %s cannot be sealed: %s", session_id, error)
            self._again_after[session_id] = time.monotonic() + _SEAL_AGAIN_S
            self._not_sealed[session_id] = f"cannot be sealed yet, and is tried again: {error}"
            self._changed(self._sessions[session_id])
        finally:
            del self._sealing[session_id]

    def _keep(self, session: Session) -> Session:
        self.folder.save(session)
        self._sessions[session.id] = session
        self._changed(session)
        return session
