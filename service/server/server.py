"""One server process: its nodes, recorder, subscribers and links, and its tick."""

from __future__ import annotations

import asyncio
import logging
import re
import time
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from devices.errors import FootTileError, StorageError
from service.link import Close, Wanted
from service.server.book import SessionBook, Trash, destroy
from service.server.live import Hub
from service.server.node import ServerNode
from service.server.nodes import ServerNodes
from service.server.recorder import Recorder
from service.server.settling import Settling
from service.server.streams import ServerStream
from service.server.views import NodeView, SessionView
from service.server_clock import utc_ns
from storage.durable import (
    locked,
    make_folder,
    remove_stale_temporaries,
    storage_errors,
    write_whole,
)
from storage.intervals import Intervals
from storage.sessions.folder import Session, SessionFolder

log = logging.getLogger("foottile.server")

TICK_S = 0.2
"""How often frames are synced and acknowledged: a server that is killed has not promised more."""
_SLOW_TICK_S = 1.0
_PRUNE_EVERY_S = 30.0
_PROBE_BYTES = 64 << 10
_SERVER_ID = re.compile(r"[0-9a-f]{32}")


class Link:
    """One node's connection, as far as others may use it."""

    def __init__(self, node: ServerNode) -> None:
        self.node = node
        self.stream: ServerStream = node.present
        """Whose frames come."""
        self.wanted: Wanted | None = None
        """What sessions need, as the node was told last."""
        self.news = asyncio.Event()
        """Set when there is something to tell the node."""
        self._acks: dict[str, Intervals] = {}
        self.closing: tuple[Close, str] | None = None
        self.ended = asyncio.Event()

    def acknowledge(self, boot_id: str, numbers: Intervals) -> None:
        """Tell the node that these frames are on the disk."""
        self._acks[boot_id] = self._acks.get(boot_id, Intervals()) | numbers
        self.news.set()

    def acks(self) -> dict[str, Intervals]:
        """Take the acknowledgements that wait to be sent; each is returned once."""
        acks, self._acks = self._acks, {}
        return acks

    def end(self, code: Close, reason: str) -> None:
        """Ask for the connection to be closed."""
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
            make_folder(data)
        self._lock = ExitStack()
        self._lock.enter_context(
            locked(
                data,
                refusal="another foottile server uses this data folder",
                remedy="Stop it, or choose another folder with --data",
            )
        )
        try:
            remove_stale_temporaries(data)
            self.check_storage()
            self.id = _id_of(data)
            """Name of this data folder: a node keeps what this server needs apart from others."""
            self.hub = Hub()
            self.nodes = ServerNodes(data)
            self.sessions = SessionBook(
                SessionFolder(data / "sessions"), Trash(data / "trash"), self._tell_session
            )
            self.settling = Settling(self.sessions, self.nodes, self._ask_again)
            self.recorder = Recorder(self.sessions, self.nodes, self.settling)
        except FootTileError:
            self._lock.close()
            raise
        self.links: dict[str, Link] = {}
        self._failing: dict[str, str] = {}
        """What has failed in the last tick, and how."""

    async def run(self) -> None:
        """Sync, acknowledge, settle, prune and tell, until cancelled."""
        slow_s = prune_s = 0.0
        while True:
            await asyncio.sleep(TICK_S)
            now_s = time.monotonic()
            await asyncio.gather(*(self._sync(node) for node in list(self.nodes)))
            with self._alone("sessions"):
                self.settling.settle()
            for link in list(self.links.values()):
                self._tell_wanted(link)
            if now_s >= slow_s:
                slow_s = now_s + _SLOW_TICK_S
                with self._alone("heartbeat"):
                    self._heartbeat()
            if now_s >= prune_s:
                prune_s = now_s + _PRUNE_EVERY_S
                for node in list(self.nodes):
                    with self._alone(f"node {node.name}, deleting what nobody needs"):
                        node.prune(self.recorder.needed(node.name))

    async def close(self) -> None:
        """End the links and wait for what is being sealed."""
        for link in list(self.links.values()):
            link.end(Close.RESTART, "the server is going down; connect again")
        await self.settling.close()
        for node in self.nodes:
            for stream in node.streams.values():
                try:
                    stream.close()
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

    async def empty_trash(self) -> tuple[int, int]:
        """Delete what is in the trash for good; return the number of sessions and of bytes.

        Raises:
            StorageError: one of them cannot be deleted.
        """
        doomed = self.sessions.trash.doom()
        return len(doomed), await asyncio.to_thread(destroy, doomed)

    def node_as_json(self, node: ServerNode) -> dict[str, Any] | None:
        """How a node is, for screens; None if that cannot be said, which is said in the log."""
        with self._alone(f"node {node.name}, as screens see it"):
            return NodeView.of(node, self.recorder).model_dump(mode="json")
        return None

    def tell_node(self, node: ServerNode) -> None:
        """Tell every screen how a node is."""
        if (view := self.node_as_json(node)) is not None:
            self.hub.notice({"type": "node", "node": view})

    def _tell_wanted(self, link: Link) -> None:
        """Tell a node what sessions need, if that has changed."""
        with self._alone(f"node {link.node.name}, what sessions need of it"):
            if link.wanted is not None and self.recorder.wanted(link.node.name) != link.wanted:
                link.news.set()

    @contextmanager
    def _alone(self, what: str) -> Iterator[None]:
        """Whatever fails here ends nothing else; it is said when it begins, not at every tick."""
        try:
            yield
        except Exception as error:
            if self._failing.get(what) != str(error):
                self._failing[what] = str(error)
                if isinstance(error, FootTileError):
                    log.warning("%s: %s", what, error)
                else:
                    log.exception("%s: this is a bug; the server goes on", what)
        else:
            self._failing.pop(what, None)

    def _ask_again(self, node: ServerNode) -> None:
        link = self.links.get(node.name)
        if link is not None:
            link.end(Close.RESTART, "frames are damaged here; send what the server lacks")

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
                        "lost_frames": sum(node.lost.values()),
                        "backlog_frames": node.backlog_frames,
                        "missed_slots": node.present.missed_slots,
                        "connected": node.connected,
                    }
                    for node in self.nodes
                },
            }
        )
        for session in self.sessions:
            if session.state in ("recording", "pending", "sealing"):
                self._tell_session(session)

    async def _sync(self, node: ServerNode) -> None:
        """Sync a node's journals to disk, then acknowledge the frames that were in them before."""
        with self._alone(f"node {node.name}, bringing its frames to the disk"):
            if node.storage_problem is not None:  # perhaps not even a journal could be begun
                await self._try_again(node)
                return
            streams = [stream for stream in node.streams.values() if stream.has_news]
            await asyncio.gather(*(self._sync_stream(node, stream) for stream in streams))

    async def _sync_stream(self, node: ServerNode, stream: ServerStream) -> None:
        unsynced, stream.unsynced = stream.unsynced, Intervals()
        owed, stream.owed = stream.owed, Intervals()
        try:
            await asyncio.to_thread(stream.sync)
        except StorageError as error:
            node.storage_problem = str(error)
            # The kernel may forget what it could not write: the node has to send it again.
            stream.disown(stream.unsynced | unsynced)
            stream.unsynced, stream.owed = Intervals(), Intervals()
            return
        link = self.links.get(node.name)
        if link is not None and owed:
            link.acknowledge(stream.boot_id, owed)

    async def _try_again(self, node: ServerNode) -> None:
        """After a full disk: once it can be written again, ask the node for what is missing."""
        try:
            await asyncio.to_thread(self.check_storage)
        except StorageError:
            return
        node.storage_problem = None
        if node.name in self.links:
            self.links[node.name].end(
                Close.RESTART, "the server can write again; send what it lacks"
            )


def _id_of(data: Path) -> str:
    path = data / "server_id"
    with storage_errors(path):
        kept = path.read_text("utf-8", "replace").strip() if path.exists() else ""
    if not _SERVER_ID.fullmatch(kept):
        kept = uuid.uuid4().hex
        write_whole(path, kept.encode() + b"\n")
    return kept
