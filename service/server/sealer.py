"""Background sealing of sessions: follows their nodes' streams, then writes the sealed files.

A session that was stopped while its node was away is `pending` until the node has sent the frames
from before the stop. Sealing runs in a thread and is retried if the disk is full.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from pathlib import Path

from devices.errors import DamagedFramesError, FootTileError
from service.estimation.compilation import is_compiling
from service.server import session_parts
from service.server.node import ServerNode
from service.server.nodes import NodeRegistry
from service.server.session_parts import (
    current_inputs,
    current_ledger,
    has_unreadable_journal,
    is_ready_to_seal,
)
from service.server.session_store import SessionStore
from service.sessions.inputs import SessionInputs
from service.sessions.sealing import seal_session
from storage.intervals import Intervals
from storage.sessions.folder import Session
from storage.sessions.metadata import write_markers

log = logging.getLogger("foottile.settling")

_RETRY_S = 10.0
_COMPILE_POLL_S = 0.1
_UNREADABLE_JOURNAL = "a journal cannot be read now, and is retried: see the server's problems"


class SessionSealer:
    """Finds the ends of sessions and seals them.

    Args:
        store: sessions to seal.
        nodes: nodes with the sessions' frames.
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
        self._unquantized = unquantized
        self._store = store
        self._nodes = nodes
        self._request_resend = request_resend
        self._sealing: dict[str, asyncio.Task[None]] = {}
        self._retry_after_s: dict[str, float] = {}
        self._failures: dict[str, str] = {}

    def extend_node_sessions(self, node: ServerNode) -> None:
        """Extend the unsealed sessions of a node into the streams that its hello lists.

        If its tiles have changed, a new session continues the recording: a file describes one
        array.

        Raises:
            StorageError: a session cannot be saved.
        """
        for session in self._store.list_unsealed(node.name):
            if session.state != "sealing":
                try:
                    self._extend(session)
                except DamagedFramesError as error:
                    self._invalidate(session, error)

    def collect_inputs(self, session: Session) -> SessionInputs:
        """Collect the present inputs of a session; missing ones are left out (`problem`)."""
        return current_inputs(session, self._nodes.get(session.node), unquantized=self._unquantized)

    def advance_unsealed_sessions(self) -> None:
        """Find the ends of stopped sessions, and start to seal those whose frames are all here."""
        for session in self._store.list_unsealed():
            if time.monotonic() < self._retry_after_s.get(session.id, 0.0):
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

    def is_sealing(self, session_id: str) -> bool:
        """Return whether a session is being sealed now."""
        return session_id in self._sealing

    def clear_failure(self, session_id: str) -> None:
        """Drop the record of a failed sealing: retry at once and do not report the failure."""
        self._retry_after_s.pop(session_id, None)
        self._failures.pop(session_id, None)

    def find_problem_to_show(self, session: Session) -> str | None:
        """Return the user-visible problem of a session, if any."""
        return self._failures.get(session.id, session.problem)

    def _advance(self, session: Session) -> None:
        node = self._nodes.find(session.node)
        if node is not None and has_unreadable_journal(session, node):
            node.retry_unreadable_journals()
            if has_unreadable_journal(session, node):
                self._failures[session.id] = _UNREADABLE_JOURNAL
                self._retry_after_s[session.id] = time.monotonic() + _RETRY_S
                return
            self._failures.pop(session.id, None)
        try:
            if session.state == "pending":
                session = self._extend(session)
        except DamagedFramesError as error:
            self._invalidate(session, error)
            return
        if session.state == "pending" and is_ready_to_seal(session, self._nodes.find(session.node)):
            session = self._store.save(session.model_copy(update={"state": "sealing"}))
        if session.state == "sealing" and session.id not in self._sealing:
            self._sealing[session.id] = asyncio.create_task(self._seal(session.id))

    def _extend(self, session: Session) -> Session:
        """Extend a session into its node's streams, and save the change."""
        node = self._nodes.find(session.node)
        if node is None:
            return session
        followed = session_parts.extend_session_or_continue_with_other_tiles(session, node)
        # Save the sessions that continue it first: if the server is killed between, none is lost.
        continuations = followed[1:]
        if continuations and not any(
            other.continues == session.id for other in self._store.iterate_newest_first()
        ):
            for each in reversed(continuations):
                self._store.save(each)
        return session if followed[0] is session else self._store.save(followed[0])

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

    async def _seal(self, session_id: str) -> None:
        book = self._store
        while is_compiling():  # else this thread compiles, and the event loop waits
            await asyncio.sleep(_COMPILE_POLL_S)
        try:
            session, folder = book.get_session(session_id), book.folder.get_path(session_id)
            node = self._nodes.get(session.node)
            sources, ledger = self.collect_inputs(session), current_ledger(session, node)
            if not is_ready_to_seal(session, node):
                # The disk lost frames that it had accepted: the node has to send them again.
                book.save(session.model_copy(update={"state": "pending"}))
                return
            sealed = await asyncio.to_thread(seal_session, sources, folder, ledger)
            # Name, notes and events may have changed meanwhile.
            now = book.get_session(session_id)
            people = {n: getattr(now, n) for n in ("name", "subject", "notes", "tags", "markers")}
            if now.markers != sealed.markers:
                write_markers(now, folder)
            self._failures.pop(session_id, None)
            book.save(sealed.model_copy(update=people))
        except DamagedFramesError as error:
            session = book.get_session(session_id)
            self._invalidate(session, error)
            book.save(session.model_copy(update={"state": "pending"}))
        except Exception as error:
            if not isinstance(error, FootTileError):
                log.exception("session %s: this is a bug", session_id)
            log.warning("session %s cannot be sealed: %s", session_id, error)
            self._retry_after_s[session_id] = time.monotonic() + _RETRY_S
            self._failures[session_id] = f"cannot be sealed yet, and is retried: {error}"
            book.on_change(book.get_session(session_id))
        finally:
            del self._sealing[session_id]
