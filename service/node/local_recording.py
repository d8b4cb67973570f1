"""Local recording of a session on the node, with or without a server.

The session is a list of intervals of the node's streams like any other, and sealed by the same
code. After a crash an unsealed session continues if the node restarts with the same session name;
otherwise it is sealed as it is.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from devices.clock import server_utc_ns
from devices.errors import FootTileError, StorageError
from devices.vitals import Vitals
from service.estimation.calibration import Calibration
from service.sessions.lifecycle import (
    Reevaluate,
    Resume,
    Sealed,
    Stop,
    apply_event,
    compute_present_ledger,
    create_session,
    split_number_in_parentheses,
)
from service.sessions.parts import NodeFacts, SessionStream
from storage.durable_files import remove_dead_process_temporaries
from storage.intervals import NO_END, Intervals
from storage.journal.node.journal import NodeJournal
from storage.journal.node.stream import NodeStream
from storage.sessions.folder import Part, Session, SessionsFolder
from storage.sessions.ledger import group_numbers_by_stream


class LocalRecording:
    """Local sessions of a node.

    Args:
        node_folder: the node's folder; sessions are in `sessions` below it.
        node_name: name of the node.
        journal: journal of the frames.
        session_name: name of the session to record; None: only seal sessions of earlier runs.
        calibration: calibration for the estimates.
        scene_content: content of the scene file.
        is_emulated: True if the array is emulated.
        report: called with messages for the user.
        get_vitals: returns the newest vitals of this machine; None: not read yet.
    """

    def __init__(
        self,
        node_folder: Path,
        node_name: str,
        journal: NodeJournal,
        *,
        session_name: str | None,
        calibration: Calibration | None,
        scene_content: Mapping[str, object],
        is_emulated: bool,
        report: Callable[[str], None],
        get_vitals: Callable[[], Vitals | None] = lambda: None,
    ) -> None:
        self._folder = SessionsFolder(node_folder / "sessions")
        self._journal = journal
        self._name = session_name
        self._calibration = calibration
        self._scene_content = scene_content
        self._emulated = is_emulated
        self._report = report
        self._get_vitals = get_vitals
        self._session: Session | None = None
        self._sealing_lock = threading.Lock()
        """Lock while sessions of earlier runs are sealed: a node may be stopped meanwhile."""
        found, self._unreadable = self._folder.load_all()
        """Unreadable sessions. They may need any frame, so all frames are retained."""
        for session_id, error in self._unreadable.items():
            report(f"session {session_id} is left out: {error}")
        for stray in self._folder.find_renamed_or_copied_sessions():
            report(f"session folder {stray.name} is left out: {stray.error}")
            if stray.may_need_frames:
                self._unreadable[stray.name] = stray.error
        self._unsealed = [s for s in found if s.state != "sealed" and s.node == node_name]
        self._update_retention()

    def add_stream(self, stream: NodeStream) -> None:
        """Add a new stream to the session, from its first frame on.

        Creates the session, or continues an interrupted one. With other tiles the session ends and
        another one begins.
        """
        if self._name is None:
            return
        session = self._session
        if session is None and (interrupted := self._find_interrupted_session()) is not None:
            self._unsealed.remove(interrupted)
            self._report(f"session {interrupted.id} ({interrupted.name}) goes on")
            session = apply_event(interrupted, Resume()).session
        if session is None:
            session = create_session(
                stream.info,
                self._name,
                Part(stream_id=stream.stream_id, seq_first=0),
                scene_content=self._scene_content,
                calibration=self._calibration,
                vitals_at_start=self._get_vitals(),
            )
        else:
            ids = session.parts[-1].stream_id, stream.stream_id
            facts = replace(self._make_facts(), stream_ids=ids, scene=stream.info.scene)
            step = apply_event(session, Reevaluate(), facts)
            session = step.session
            for continuation in step.continuations:
                self._report(f"other tiles: session {session.id} ends, and another one begins")
                self._unsealed.append(session)
                self._save(continuation)
                self._save(session)
                session = continuation
        self._session = session
        self._update_retention()
        self._save(session)

    def stop_and_seal(self) -> Session | None:
        """Seal the session and return it; None: there is none.

        Raises:
            FootTileError: it cannot be sealed; all files stay, for `foottile recover`.
        """
        session, self._session = self._session, None
        if session is None:
            return None
        sealed = self._seal(apply_event(session, Stop(), self._make_facts()).session)
        self._update_retention()
        self.seal_earlier_sessions()
        return sealed

    def seal_earlier_sessions(self) -> None:
        """Seal sessions of earlier runs; report failures and leave these sessions."""
        with self._sealing_lock:
            for session in list(self._unsealed):
                try:
                    sealed = self._seal(session)
                except FootTileError as error:
                    self._report(f"session {session.id} is not sealed: {error}")
                    continue
                state = "complete" if sealed.ledger and sealed.ledger.complete else "lossy"
                self._report(
                    f"session {session.id} ({session.name}) was left behind: sealed, {state}"
                )
                self._unsealed.remove(session)
                self._update_retention()

    def _find_interrupted_session(self) -> Session | None:
        """Find the newest interrupted session of this name that no other one continues."""
        for session in self._unsealed:
            is_its_own = self._name in (
                session.name,
                split_number_in_parentheses(session.name).given,
            )
            if is_its_own and session.state != "pending":
                return session
        return None

    def _save(self, session: Session) -> None:
        try:
            self._folder.save_session_json(session)
        except StorageError as error:  # its frames are retained nevertheless
            self._report(f"session {session.id} cannot be saved: {error}")

    def _seal(self, session: Session) -> Session:
        # Imported here, because scipy would delay a node's first frame.
        from service.sessions.inputs import make_inputs
        from service.sessions.sealing import write_sealed_files

        facts = replace(self._make_facts(), frames_to_come="none")
        session = apply_event(session, Reevaluate(), facts).session
        self._folder.save_session_json(session)
        folder = self._folder.get_path(session.id)
        remove_dead_process_temporaries(folder)
        sources = make_inputs(session, facts, load_tares=None, emulated=self._emulated)
        sealed = write_sealed_files(sources, folder, compute_present_ledger(session, facts))
        sealed = apply_event(session, Sealed(sealed)).session
        self._folder.save_session_json(sealed)
        return sealed

    def _make_facts(self) -> NodeFacts:
        """Return the facts of this node for its sessions; it needs no clock but its own."""
        streams = {stream.stream_id: stream for stream in self._journal.streams}

        def find_stream(stream_id: str) -> SessionStream | None:
            stream = streams.get(stream_id)
            return _make_session_stream(stream) if stream is not None else None

        return NodeFacts(
            now_t_ns=server_utc_ns(),
            find_stream=find_stream,
            has_reported=True,
            scene_content=self._scene_content,
            calibration=self._calibration,
            vitals=self._get_vitals(),
        )

    def _update_retention(self) -> None:
        """Make the journal retain all frames that are not sealed yet."""
        sessions = (*self._unsealed, *((self._session,) if self._session else ()))
        needed = group_numbers_by_stream(part for session in sessions for part in session.parts)
        if self._unreadable:
            needed = {
                stream.stream_id: Intervals([(0, NO_END)]) for stream in self._journal.streams
            }
        self._journal.retention_requests.set_node_session_numbers(needed)


def _make_session_stream(stream: NodeStream) -> SessionStream:
    """Describe a stream of a local session: it has ended, and no frames are missing elsewhere.

    A local session ends with its stream, not at an instant: the date may have been set meanwhile.
    """
    return SessionStream(
        stored=stream.stored,
        lost=stream.lost,
        next_seq=stream.next_seq,
        max_lost_tail_frames=stream.notes.max_lost_tail_frames,
        missed_slots=stream.missed_slots,
        info=stream.info,
        journal=stream.journal,
    )
