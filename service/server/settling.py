"""Sessions on their way to the sealed file: followed through their node's streams, then sealed.

A session that was stopped while its node was away is `pending` until the node has brought what it
took before the stop. Sealing runs in a thread and is tried again if the disk is full.
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
_UNREAD = "a journal of it cannot be read now, and is tried again: see what the server says of it"


class Settling:
    """Sees to it that sessions end and are sealed.

    Args:
        book: the sessions.
        nodes: whose frames they are made of.
        ask_again: called with a node that may still have frames that are damaged here.
        exact: are estimates not rounded?
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
        """The node has said which streams it took: its sessions go on in them.

        If its tiles are others now, a session of its own takes up a recording: a file describes
        one array.

        Raises:
            StorageError: that cannot be written down.
        """
        for session in self._book.unsealed(node.name):
            if session.state != "sealing":
                try:
                    self._follow(session)
                except DamagedFramesError as error:
                    self._disown(session, error)

    def sources(self, session: Session) -> Sources:
        """What a session can be sealed or exported from."""
        return sources_now(session, self._nodes.get(session.node), exact=self._exact)

    def settle(self) -> None:
        """Find the end of stopped sessions, and seal those whose frames are all there."""
        for session in self._book.unsealed():
            if time.monotonic() < self._again_after.get(session.id, 0.0):
                continue
            try:
                self._settle(session)
            except FootTileError as error:  # it must not hold up the others
                log.warning("session %s: %s", session.id, error)
                self._again_after[session.id] = time.monotonic() + _SEAL_AGAIN_S

    async def settled(self, session_id: str, timeout_s: float) -> Session:
        """The session once it is sealed, or as it is after `timeout_s`."""
        end = time.monotonic() + timeout_s
        while self._book.get(session_id).state != "sealed" and time.monotonic() < end:
            await asyncio.sleep(0.02)
        return self._book.get(session_id)

    async def close(self) -> None:
        """Wait for what is being sealed."""
        await asyncio.gather(*self._sealing.values(), return_exceptions=True)

    def is_sealing(self, session_id: str) -> bool:
        """Is it being sealed now?"""
        return session_id in self._sealing

    def forget(self, session_id: str) -> None:
        """Forget that sealing failed: try again at once, and do not report the failure."""
        self._again_after.pop(session_id, None)
        self._not_sealed.pop(session_id, None)

    def problem_of(self, session: Session) -> str | None:
        """What a person should know of a session as it is now."""
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
        """The session as far as its node's streams go by now."""
        node = self._nodes.find(session.node)
        if node is None:
            return session
        followed = following.followed(session, node)
        # Save the sessions that continue it first: if the server is killed between, none is lost.
        further = followed[1:]
        if further and not any(
            known.continues == session.id for known in self._book.newest_first()
        ):
            for each in reversed(further):
                self._book.keep(each)
        return session if followed[0] is session else self._book.keep(followed[0])

    def drop_damaged(self, node: ServerNode, error: DamagedFramesError, whose: str) -> None:
        """Drop frames damaged on disk: get them from the node again, or count them as lost.

        Args:
            node: whose journal has them.
            error: which they are.
            whose: who wanted to read them, for the log.
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
        while is_warming():  # or it would compile here, and everything would wait for that
            await asyncio.sleep(_COMPILED_S)
        try:
            session, folder = book.get(session_id), book.folder.path(session_id)
            node = self._nodes.get(session.node)
            sources, ledger = self.sources(session), ledger_now(session, node)
            if not is_all_here(session, node):
                # A disk did not keep what it had taken: these frames have to come once more.
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
            self._not_sealed[session_id] = f"cannot be sealed yet, and is tried again: {error}"
            book.changed(book.get(session_id))
        finally:
            del self._sealing[session_id]
