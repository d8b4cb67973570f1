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
from service.estimation.warm import is_warming
from service.server import following
from service.server.book import SessionBook
from service.server.following import is_all_here, is_unread, ledger_now, sources_now
from service.server.node import ServerNode
from service.server.nodes import ServerNodes
from service.sessions.sealing import seal
from service.sessions.sources import Sources
from storage.intervals import Intervals
from storage.sessions.beside import write_events
from storage.sessions.folder import Session

log = logging.getLogger("foottile.settling")

_SEAL_AGAIN_S = 10.0
_COMPILED_S = 0.1
_UNREAD = "a journal cannot be read now, and is retried: see the server's problems"


class Settling:
    """Finds the ends of sessions and seals them.

    Args:
        store: sessions to seal.
        nodes: nodes with the sessions' frames.
        request_resend: called with a node that may still have frames that are damaged here.
        exact: True: estimates are not rounded.
    """

    def __init__(
        self,
        book: SessionBook,
        nodes: ServerNodes,
        ask_again: Callable[[ServerNode], None],
        *,
        exact: bool = False,
    ) -> None:
        self._exact = exact
        self._book = book
        self._nodes = nodes
        self._ask_again = ask_again
        self._sealing: dict[str, asyncio.Task[None]] = {}
        self._again_after: dict[str, float] = {}
        self._not_sealed: dict[str, str] = {}

    def follow(self, node: ServerNode) -> None:
        """Extend the sessions of a node into the streams that its hello lists.

        If its tiles have changed, a new session continues the recording: a file describes one
        array.

        Raises:
            StorageError: a session cannot be saved.
        """
        for session in self._book.unsealed(node.name):
            if session.state != "sealing":
                try:
                    self._follow(session)
                except DamagedFramesError as error:
                    self._disown(session, error)

    def sources(self, session: Session) -> Sources:
        """Collect the inputs from which a session can be sealed or exported."""
        return sources_now(session, self._nodes.get(session.node), exact=self._exact)

    def settle(self) -> None:
        """Find the ends of stopped sessions, and seal those whose frames are all here."""
        for session in self._book.unsealed():
            if time.monotonic() < self._again_after.get(session.id, 0.0):
                continue
            try:
                self._settle(session)
            except FootTileError as error:  # other sessions must not wait for this one
                log.warning("session %s: %s", session.id, error)
                self._again_after[session.id] = time.monotonic() + _SEAL_AGAIN_S

    async def settled(self, session_id: str, timeout_s: float) -> Session:
        """Return the session once it is sealed, or its present state after `timeout_s`."""
        end = time.monotonic() + timeout_s
        while self._book.get(session_id).state != "sealed" and time.monotonic() < end:
            await asyncio.sleep(0.02)
        return self._book.get(session_id)

    async def close(self) -> None:
        """Wait for the sessions that are being sealed."""
        await asyncio.gather(*self._sealing.values(), return_exceptions=True)

    def is_sealing(self, session_id: str) -> bool:
        """Return whether a session is being sealed now."""
        return session_id in self._sealing

    def forget(self, session_id: str) -> None:
        """Drop the record of a failed sealing: retry at once and do not report the failure."""
        self._again_after.pop(session_id, None)
        self._not_sealed.pop(session_id, None)

    def problem_of(self, session: Session) -> str | None:
        """Return the user-visible problem of a session, if any."""
        return self._not_sealed.get(session.id, session.problem)

    def _settle(self, session: Session) -> None:
        node = self._nodes.find(session.node)
        if node is not None and is_unread(session, node):
            node.read_again()
            if is_unread(session, node):
                self._not_sealed[session.id] = _UNREAD
                self._again_after[session.id] = time.monotonic() + _SEAL_AGAIN_S
                return
            self._not_sealed.pop(session.id, None)
        try:
            if session.state == "pending":
                session = self._follow(session)
        except DamagedFramesError as error:
            self._disown(session, error)
            return
        if session.state == "pending" and is_all_here(session, self._nodes.find(session.node)):
            session = self._book.keep(session.model_copy(update={"state": "sealing"}))
        if session.state == "sealing" and session.id not in self._sealing:
            self._sealing[session.id] = asyncio.create_task(self._seal(session.id))

    def _follow(self, session: Session) -> Session:
        """Extend a session into its node's streams, and save the change."""
        node = self._nodes.find(session.node)
        if node is None:
            return session
        followed = following.followed(session, node)
        # Save the sessions that continue it first: if the server is killed between, none is lost.
        continuations = followed[1:]
        if continuations and not any(
            other.continues == session.id for other in self._book.newest_first()
        ):
            for each in reversed(continuations):
                self._book.keep(each)
        return session if followed[0] is session else self._book.keep(followed[0])

    def drop_damaged(self, node: ServerNode, error: DamagedFramesError, whose: str) -> None:
        """Invalidate frames that are damaged on disk: request them again, or count them as lost.

        Args:
            node: node of the journal.
            error: error with the frames' numbers.
            reader: reader that found the damage, for the log.
        """
        folder = Path(error.where).parent
        for stream in node.streams.values():
            if stream.folder == folder:
                damaged = Intervals([(error.seq_first, error.seq_last)])
                stream.disown(damaged, corrupt=True)
                log.warning("%s: %s", whose, error)
                if stream.may_come & damaged:
                    self._ask_again(node)

    def _disown(self, session: Session, error: DamagedFramesError) -> None:
        self.drop_damaged(self._nodes.get(session.node), error, f"session {session.id}")

    async def _seal(self, session_id: str) -> None:
        book = self._book
        while is_warming():  # else this thread compiles, and the event loop waits
            await asyncio.sleep(_COMPILED_S)
        try:
            session, folder = book.get(session_id), book.folder.path(session_id)
            node = self._nodes.get(session.node)
            sources, ledger = self.sources(session), ledger_now(session, node)
            if not is_all_here(session, node):
                # The disk lost frames that it had accepted: the node has to send them again.
                book.keep(session.model_copy(update={"state": "pending"}))
                return
            sealed = await asyncio.to_thread(seal, sources, folder, ledger)
            # Name, notes and events may have changed meanwhile.
            now = book.get(session_id)
            people = {n: getattr(now, n) for n in ("name", "subject", "notes", "tags", "events")}
            if now.events != sealed.events:
                write_events(now, folder)
            self._not_sealed.pop(session_id, None)
            book.keep(sealed.model_copy(update=people))
        except DamagedFramesError as error:
            session = book.get(session_id)
            self._disown(session, error)
            book.keep(session.model_copy(update={"state": "pending"}))
        except Exception as error:
            if not isinstance(error, FootTileError):
                log.exception("session %s: this is a bug", session_id)
            log.warning("session %s cannot be sealed: %s", session_id, error)
            self._again_after[session_id] = time.monotonic() + _SEAL_AGAIN_S
            self._not_sealed[session_id] = f"cannot be sealed yet, and is retried: {error}"
            book.changed(book.get(session_id))
        finally:
            del self._sealing[session_id]
