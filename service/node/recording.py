"""A session that is recorded on the node itself, with or without a server.

It is a list of intervals of the node's streams like any other session, and sealed by the same code.
One that a crash left behind goes on if a node with the same name for it is started again; otherwise
it is sealed as it is.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path

from devices.errors import FootTileError, StorageError
from service.estimation.calibration import Calibration
from service.server_clock import utc_ns
from service.sessions.ends import at_end, broken_off
from service.sessions.streams import SessionStream
from storage.durable import remove_stale_temporaries
from storage.intervals import NO_END, Intervals
from storage.journal.node_journal import NodeJournal
from storage.journal.node_stream import NodeStream
from storage.sessions.folder import Part, Session, SessionFolder, new_session_id
from storage.sessions.ledger import ledger_of
from storage.sessions.states import numbers_of, states_of


class NodeRecording:
    """The node's own sessions.

    Args:
        root: the node's folder; sessions are in `sessions` below it.
        node: its name.
        journal: where the frames are.
        name: of the session to record; None: none, but what was left behind is sealed.
        calibration: to estimate with.
        notes: for the sealed file.
        report: told what happens.
    """

    def __init__(
        self,
        root: Path,
        node: str,
        journal: NodeJournal,
        *,
        name: str | None,
        calibration: Calibration | None,
        notes: Mapping[str, object],
        report: Callable[[str], None],
    ) -> None:
        self._folder = SessionFolder(root / "sessions")
        self._node = node
        self._journal = journal
        self._name = name
        self._calibration = calibration
        self._notes = notes
        self._report = report
        self._session: Session | None = None
        self._sealing = threading.Lock()
        """Held while what was left is sealed: a node may be stopped meanwhile."""
        self._unreadable = False
        """Is there a session of which nobody knows what it needs? Then everything is kept."""
        self._left_over = self._unfinished()
        self._need()

    def goes_on_in(self, stream: NodeStream) -> None:
        """A stream has begun: it belongs to the session from its first frame on."""
        if self._name is None:
            return
        part = Part(boot_id=stream.boot_id, seq_first=0)
        session = self._session
        if session is None:
            session = next((s for s in self._left_over if s.name == self._name), None)
            if session is not None:
                self._left_over.remove(session)
                self._report(f"session {session.id} ({session.name}) goes on")
        if session is not None and self._has_other_tiles(session, stream):
            self._report(f"other tiles: session {session.id} ends, and another one begins")
            self._left_over.append(session)
            session = None
        if session is None:
            session = self._new(part, stream)
        else:
            session = at_end(session, self._described(session))
            session = session.model_copy(update={"parts": (*session.parts, part)})
        self._session = session
        self._need()
        try:
            self._folder.save(session)
        except StorageError as error:  # its frames are kept all the same, if any can be
            self._report(f"session {session.id} cannot be noted: {error}")

    def stop(self) -> tuple[str | None, bool]:
        """Seal the session; its id, None if there is none, and whether it is lossy.

        Raises:
            FootTileError: it cannot be sealed; everything stays, for `foottile recover`.
        """
        session, self._session = self._session, None
        if session is None:
            return None, False
        sealed = self._seal(session.model_copy(update={"stopped_t_ns": utc_ns()}))
        self._need()
        self.seal_what_was_left()
        return sealed.id, sealed.ledger is None or not sealed.ledger.complete

    def seal_what_was_left(self) -> None:
        """Seal sessions of earlier runs; one that cannot be is reported and stays."""
        with self._sealing:
            for session in list(self._left_over):
                try:
                    sealed = self._seal(session)
                except FootTileError as error:
                    self._report(f"session {session.id} is not sealed: {error}")
                    continue
                state = "complete" if sealed.ledger and sealed.ledger.complete else "lossy"
                self._report(
                    f"session {session.id} ({session.name}) was left behind: sealed, {state}"
                )
                self._left_over.remove(session)
                self._need()

    def _new(self, part: Part, stream: NodeStream) -> Session:
        calibration = self._calibration
        return Session(
            id=new_session_id(datetime.now(UTC)),
            name=self._name or "",
            node=self._node,
            state="recording",
            started_t_ns=utc_ns(),
            parts=(part,),
            scene=stream.info.scene,
            scene_content=dict(_object(self._notes.get("scene"))),
            calibration=calibration.model_dump(mode="json") if calibration is not None else None,
        )

    def _seal(self, session: Session) -> Session:
        # Here, because a real node need not wait for scipy before its first frame.
        from service.sessions.sealing import seal
        from service.sessions.sources import sources_of

        streams = self._described(session)
        session = broken_off(session, streams).model_copy(update={"state": "sealing"})
        self._folder.save(session)
        folder = self._folder.path(session.id)
        remove_stale_temporaries(folder)
        emulated = self._notes.get("emulated")
        sources = sources_of(session, streams, tares=None, emulated=bool(emulated))
        ledger = ledger_of(session.parts, states_of(session, streams), finished=True)
        sealed = seal(sources, folder, ledger)
        self._folder.save(sealed)
        return sealed

    def _described(self, session: Session) -> dict[str, SessionStream]:
        """What is known of a session's streams, by boot_id."""
        known = {stream.boot_id: _described(stream) for stream in self._journal.streams}
        return {p.boot_id: known.get(p.boot_id, SessionStream()) for p in session.parts}

    def _has_other_tiles(self, session: Session, stream: NodeStream) -> bool:
        before = self._described(session)[session.parts[-1].boot_id].info
        return before is not None and not before.has_same_tiles_as(stream.info)

    def _need(self) -> None:
        """Have the journal keep what is not sealed yet."""
        sessions = (*self._left_over, *((self._session,) if self._session else ()))
        needed = numbers_of(part for session in sessions for part in session.parts)
        if self._unreadable:
            needed = {stream.boot_id: Intervals([(0, NO_END)]) for stream in self._journal.streams}
        self._journal.wanted.say_local(needed)

    def _unfinished(self) -> list[Session]:
        found = []
        for session_id in self._folder.ids():
            try:
                session = self._folder.load(session_id)
            except FootTileError as error:
                self._report(f"session {session_id} is left out: {error}")
                self._unreadable = True
                continue
            if session.state != "sealed" and session.node == self._node:
                found.append(session)
        return found


def _described(stream: NodeStream) -> SessionStream:
    """What a session on the node knows of one of its streams: it has ended, and all of it is here.

    A session here ends with its stream, not by an instant: the date may have been set meanwhile.
    """
    return SessionStream(
        held=stream.stored,
        lost=stream.lost,
        next_seq=stream.next_seq,
        unsynced_tail_max=stream.notes.unsynced_tail_max,
        missed_slots=stream.missed_slots,
        info=stream.info,
        journal=stream.journal,
    )


def _object(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}
