"""What one server process holds (nodes, recorder, subscribers, links), and does each tick."""

from __future__ import annotations

import asyncio
import fcntl
import logging
import time
from pathlib import Path
from typing import TextIO

from devices.errors import FootTileError, StorageError
from service.link import Ack, Close
from service.live import Hub
from service.nodes import Node, Nodes
from service.recorder import Recorder
from service.steady import utc_ns
from service.views import NodeView, SessionView
from storage.durable import storage_errors, write_whole
from storage.intervals import Intervals
from storage.session import Session, SessionFolder

log = logging.getLogger("foottile.server")

TICK_S = 0.2
"""How often frames are synced and acknowledged: a server that is killed has not promised more."""
_SLOW_TICK_S = 1.0
_PRUNE_EVERY_S = 30.0
_PROBE_BYTES = 64 << 10


class Link:
    """One node's connection, as far as others may use it."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.outbox: asyncio.Queue[Ack] = asyncio.Queue(64)
        self.unsynced = Intervals()
        """Frames in the journal that are not yet acknowledged."""
        self.closing: tuple[Close, str] | None = None
        self.ended = asyncio.Event()

    def end(self, code: Close, reason: str) -> None:
        """Have the connection closed."""
        self.closing = self.closing or (code, reason)
        self.ended.set()


class Server:
    """The state of a server; all of it is used from one event loop.

    Args:
        data: its data folder.

    Raises:
        StorageError: the folder cannot be written.
        FileFormatError: something in it is damaged.
    """

    def __init__(self, data: Path) -> None:
        self.data = data
        with storage_errors(data, "Choose another folder with --data"):
            data.mkdir(parents=True, exist_ok=True)
        self._lock = _locked(data)
        try:
            self.check_storage()
            self.hub = Hub()
            self.nodes = Nodes(data)
            folder = SessionFolder(data / "sessions")
            self.recorder = Recorder(folder, self.nodes, self._tell_session)
        except FootTileError:
            self._lock.close()
            raise
        self.links: dict[str, Link] = {}

    async def run(self) -> None:
        """Sync, acknowledge, settle, prune and tell, until cancelled."""
        slow_s = prune_s = 0.0
        while True:
            await asyncio.sleep(TICK_S)
            now_s = time.monotonic()
            try:
                await asyncio.gather(*(self._sync(link) for link in list(self.links.values())))
                self.recorder.settle()
                if now_s >= slow_s:
                    slow_s = now_s + _SLOW_TICK_S
                    self._heartbeat()
                if now_s >= prune_s:
                    prune_s = now_s + _PRUNE_EVERY_S
                    for node in self.nodes:
                        node.prune(self.recorder.needed(node.name))
            except FootTileError as error:
                log.warning("%s", error)
            except Exception:
                log.exception("this is a bug; the server goes on")

    async def close(self) -> None:
        """End the links and wait for what is being sealed."""
        for link in list(self.links.values()):
            link.end(Close.RESTART, "the server is going down; connect again")
        await self.recorder.close()
        for node in self.nodes:
            for journal in node.journals.values():
                try:
                    journal.close()
                except StorageError as error:
                    log.warning("%s", error)
        self._lock.close()

    def check_storage(self) -> None:
        """Whether something can be written.

        Raises:
            StorageError: it cannot.
        """
        # As much as some seconds of frames: on a full disk an empty file can still be written.
        write_whole(self.data / ".writable", bytes(_PROBE_BYTES))

    def tell_node(self, node: Node) -> None:
        """Tell every screen how a node is."""
        view = NodeView.of(node, self.recorder).model_dump(mode="json")
        self.hub.notice({"type": "node", "node": view})

    def _tell_session(self, session: Session) -> None:
        view = SessionView.of(session, self.recorder).model_dump(mode="json")
        self.hub.notice({"type": "session", "session": view})

    def _heartbeat(self) -> None:
        last = [node.last_seq for node in self.nodes if node.last_seq is not None]
        self.hub.notice(
            {
                "type": "heartbeat",
                "t_ns": utc_ns(),
                "last_seq": max(last, default=None),
                "nodes": {
                    node.name: {
                        "last_seq": node.last_seq,
                        "rate_hz": node.rate_hz,
                        "lost_frames": node.lost_frames,
                        "missed_slots": node.missed_slots,
                        "connected": node.connected,
                    }
                    for node in self.nodes
                },
            }
        )
        for session in self.recorder.all():
            if session.state in ("recording", "pending", "sealing"):
                self._tell_session(session)

    async def _sync(self, link: Link) -> None:
        """Have the journal on disk, then acknowledge what was in it before."""
        if link.node.storage_problem is not None:  # perhaps not even a journal could be begun
            await self._try_again(link)
            return
        journal = link.node.journal
        if journal is None:
            return
        waiting, link.unsynced = link.unsynced, Intervals()
        if not waiting:
            return
        try:
            await asyncio.to_thread(journal.sync)
        except StorageError as error:
            link.node.storage_problem = str(error)
            for first, last in waiting:
                link.unsynced.add(first, last)
            # The kernel may forget what it could not write: the node has to send it again.
            journal.disown(link.unsynced)
            link.unsynced = Intervals()
            return
        for first, last in waiting:
            try:
                link.outbox.put_nowait(Ack(seq_first=first, seq_last=last))
            except asyncio.QueueFull:
                link.end(Close.TOO_SLOW, "the node does not read its acknowledgements")

    async def _try_again(self, link: Link) -> None:
        """After a full disk: once it can be written again, have the node send what is missing."""
        try:
            await asyncio.to_thread(self.check_storage)
        except StorageError:
            return
        link.node.storage_problem = None
        link.end(Close.RESTART, "the server can write again; send what it lacks")


def _locked(data: Path) -> TextIO:
    """The folder's lock: two servers on one folder would each undo what the other writes."""
    with storage_errors(data):
        lock = (data / ".lock").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            lock.close()
            raise StorageError(
                "another foottile server uses this data folder",
                where=str(data),
                remedy="Stop it, or choose another folder with --data",
            ) from error
    return lock
