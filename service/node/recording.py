"""Local recording of a session on the node, with or without a server.

The session is a list of intervals of the node's streams like any other, and sealed by the same
code. After a crash an unsealed session continues if the node restarts with the same session name;
otherwise it is sealed as it is.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path

from devices.errors import FootTileError, StorageError
from service.estimation.calibration import Calibration
from service.server_clock import utc_ns
from service.sessions.begin import begun, numbered, taken_up
from service.sessions.ends import SessionStream, at_end, broken_off
from storage.durable import remove_stale_temporaries
from storage.intervals import NO_END, Intervals
from storage.journal.node.journal import NodeJournal
from storage.journal.node.stream import NodeStream
from storage.sessions.folder import Part, Session, SessionFolder
from storage.sessions.ledger import ledger_of, numbers_of, states_of


class NodeRecording:
    """Local sessions of a node.

    Args:
        root: the node's folder; sessions are in `sessions` below it.
        node: name of the node.
        journal: journal of the frames.
        name: name of the session to record; None: only seal sessions of earlier runs.
        calibration: calibration for the estimates.
        scene_content: content of the scene file.
        emulated: True if the array is emulated.
        report: called with messages for the user.
    """

    def __init__(
        self,
        root: Path,
        node: str,
        journal: NodeJournal,
        *,
        name: str | None,
        calibration: Calibration | None,
        scene_content: Mapping[str, object],
        emulated: bool,
        report: Callable[[str], None],
    ) -> None:
        self._folder = SessionFolder(root / "sessions")
        self._journal = journal
        self._name = name
        self._calibration = calibration
        self._scene_content = scene_content
        self._emulated = emulated
        self._report = report
        self._session: Session | None = None
        self._sealing = threading.Lock()
        """Lock while sessions of earlier runs are sealed: a node may be stopped meanwhile."""
        found, self._unreadable = self._folder.load_all()
        """Unreadable sessions. They may need any frame, so all frames are retained."""
        for session_id, error in self._unreadable.items():
            report(f"session {session_id} is left out: {error}")
        for stray in self._folder.strays():
            report(f"session folder {stray.name} is left out: {stray.error}")
            if stray.may_need_frames:
                self._unreadable[stray.name] = stray.error
        self._left_over = [s for s in found if s.state != "sealed" and s.node == node]
        self._need()

    def goes_on_in(self, stream: NodeStream) -> None:
        """Add a new stream to the session, from its first frame on.

        Creates the session, or continues an interrupted one. With other tiles the session ends and
        another one begins.
        """
        if self._name is None:
            return
        session, part = self._session, Part(boot_id=stream.boot_id, seq_first=0)
        if session is None and (session := self._broken_off()) is not None:
            self._left_over.remove(session)
            self._report(f"session {session.id} ({session.name}) goes on")
        scene, calibration = self._scene_content, self._calibration
        if session is None:
            session = begun(
                stream.info, self._name, part, scene_content=scene, calibration=calibration
            )
        else:
            streams = self._described(session)
            before = streams[session.parts[-1].boot_id].info
            session = at_end(session, streams)
            if before is None or before.has_same_tiles_as(stream.info):
                session = session.model_copy(update={"parts": (*session.parts, part)})
            else:
                ended, session = taken_up(
                    session, stream.info, utc_ns(), scene_content=scene, calibration=calibration
                )
                self._report(f"other tiles: session {ended.id} ends, and another one begins")
                self._left_over.append(ended)
                self._note(ended)
        self._session = session
        self._need()
        self._note(session)

    def stop(self) -> tuple[str | None, bool]:
        """Seal the session; return its id (None without a session), and whether it is lossy.

        Raises:
            FootTileError: it cannot be sealed; all files stay, for `foottile recover`.
        """
        session, self._session = self._session, None
        if session is None:
            return None, False
        sealed = self._seal(session.model_copy(update={"stopped_t_ns": utc_ns()}))
        self._need()
        self.seal_what_was_left()
        return sealed.id, sealed.ledger is None or not sealed.ledger.complete

    def seal_what_was_left(self) -> None:
        """Seal sessions of earlier runs; report failures and leave these sessions."""
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

    def _broken_off(self) -> Session | None:
        """Find the newest interrupted session of this name that no other one continues."""
        for session in self._left_over:
            is_its_own = self._name in (session.name, numbered(session.name)[0])
            if is_its_own and session.state != "pending":
                return session
        return None

    def _note(self, session: Session) -> None:
        try:
            self._folder.save(session)
        except StorageError as error:  # its frames are retained nevertheless
            self._report(f"session {session.id} cannot be saved: {error}")

    def _seal(self, session: Session) -> Session:
        # Imported here, because scipy would delay a node's first frame.
        from service.sessions.sealing import seal
        from service.sessions.sources import sources_of

        streams = self._described(session)
        session = broken_off(session, streams).model_copy(update={"state": "sealing"})
        self._folder.save(session)
        folder = self._folder.path(session.id)
        remove_stale_temporaries(folder)
        sources = sources_of(session, streams, tares=None, emulated=self._emulated)
        ledger = ledger_of(session.parts, states_of(session, streams), finished=True)
        sealed = seal(sources, folder, ledger)
        self._folder.save(sealed)
        return sealed

    def _described(self, session: Session) -> dict[str, SessionStream]:
        """Collect the stored state of a session's streams, by boot_id."""
        known = {stream.boot_id: _described(stream) for stream in self._journal.streams}
        return {p.boot_id: known.get(p.boot_id, SessionStream()) for p in session.parts}

    def _need(self) -> None:
        """Make the journal retain all frames that are not sealed yet."""
        sessions = (*self._left_over, *((self._session,) if self._session else ()))
        needed = numbers_of(part for session in sessions for part in session.parts)
        if self._unreadable:
            needed = {stream.boot_id: Intervals([(0, NO_END)]) for stream in self._journal.streams}
        self._journal.wanted.say_local(needed)


def _described(stream: NodeStream) -> SessionStream:
    """Describe a stream of a local session: it has ended, and no frames are missing elsewhere.

    A local session ends with its stream, not at an instant: the date may have been set meanwhile.
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
