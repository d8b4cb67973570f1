"""One server process: its nodes, recorder, subscribers and links, and its periodic tick."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from devices.errors import FootTileError, StorageError
from service.link import Close, Wanted
from service.private_paths import register_folder
from service.server.book import SessionBook, Trash, destroy
from service.server.calibrations import CalibrationBook
from service.server.data_folder import DataFolder
from service.server.fits import Fits
from service.server.full_rate.memory import Memories
from service.server.identities import NodeIdentities
from service.server.node import ServerNode
from service.server.nodes import ServerNodes
from service.server.recorder import Recorder
from service.server.screens.fan_out import Hub
from service.server.screens.views import Counted, NodeView, SessionView
from service.server.settling import Settling
from service.server.streams import ServerStream
from service.server.takes import Takes
from service.server.weighings import Weighings
from service.server_clock import utc_ns
from service.sessions.comparison_series import SeriesKept
from service.sessions.so_far import SoFars
from storage.durable import remove_stale_temporaries
from storage.intervals import Intervals
from storage.sessions.folder import Session, SessionFolder

log = logging.getLogger("foottile.server")

TICK_S = 0.2
"""Period of sync and acknowledgement."""
_SLOW_TICK_S = 1.0
_PRUNE_EVERY_S = 30.0
_PRUNE_MOST_S = 0.1
"""Time budget of deletion in one tick: sync and acknowledgement come first."""
_SAY_AGAIN_S = 60.0


class Link:
    """Connection of one node, as seen by the rest of the server."""

    def __init__(self, node: ServerNode) -> None:
        self.node = node
        self.stream: ServerStream = node.present
        """Stream of the frames that are being received."""
        self.wanted: Wanted | None = None
        """Last retention request sent to the node."""
        self.news = asyncio.Event()
        """Event: something has to be sent to the node."""
        self._acks: dict[str, Intervals] = {}
        self.closing: tuple[Close, str] | None = None
        self.ended = asyncio.Event()

    def acknowledge(self, boot_id: str, numbers: Intervals) -> None:
        """Queue an acknowledgement: these frames are on the disk."""
        self._acks[boot_id] = self._acks.get(boot_id, Intervals()) | numbers
        self.news.set()

    def acks(self) -> dict[str, Intervals]:
        """Remove and return the queued acknowledgements, by stream id."""
        acks, self._acks = self._acks, {}
        return acks

    def end(self, code: Close, reason: str) -> None:
        """Request that the connection is closed."""
        self.closing = self.closing or (code, reason)
        self.ended.set()


class Server:
    """State of a server; used from one event loop.

    Args:
        data: data folder.
        exact: True: estimates of recorded sessions are not rounded.

    Raises:
        StorageError: the folder cannot be written.
    """

    def __init__(self, data: Path, *, exact: bool = False) -> None:
        self.data = data
        register_folder(data)
        self.folder = DataFolder(data)
        self.id = self.folder.id
        """Id of the data folder: a node tracks separately what each server needs."""
        self._unkept: set[str] = set()
        """Nodes whose storage error has been reported."""
        try:
            remove_stale_temporaries(data)
            self.check_storage()
            self.hub = Hub()
            self.calibrations = CalibrationBook(data / "calibrations")
            self.frames = Memories()
            self.nodes = ServerNodes(data)
            self.identities = NodeIdentities(data)
            self.sessions = SessionBook(
                SessionFolder(data / "sessions"), Trash(data / "trash"), self._tell_session
            )
            self.settling = Settling(self.sessions, self.nodes, self._ask_again, exact=exact)
            self.recorder = Recorder(self.sessions, self.nodes, self.settling)
            self.takes = Takes(self.recorder, self.sessions, self.nodes)
            self.fits = Fits(self.sessions, self.calibrations)
            self.weighings = Weighings(
                self.sessions, self.recorder, self.settling, self.fits, self.calibrations
            )
        except FootTileError:
            self.folder.close()
            raise
        self.so_fars = SoFars(data)
        """Previews of unsealed sessions."""
        self.series = SeriesKept()
        """Cache of comparison series."""
        self.links: dict[str, Link] = {}
        self._counts: dict[str, Counted] = {}
        """Progress that subscribers were sent last, by session."""
        self._failing: dict[str, tuple[str, float]] = {}
        """Steps that failed in the last tick, with error and time of the log line."""

    async def run(self) -> None:
        """Run the tick until cancelled: sync, acknowledge, seal, delete, notify."""
        slow_s = prune_s = 0.0
        while True:
            await asyncio.sleep(TICK_S)
            now_s = time.monotonic()
            await asyncio.gather(*(self._sync(node) for node in list(self.nodes)))
            folder_is_there = False
            with self._alone("data folder"):
                await self._check_folder()
                folder_is_there = True
            if not folder_is_there:
                continue
            with self._alone("guided calibrations"):
                for node in self.nodes:
                    self.weighings.check(node, now_s)
            with self._alone("sessions"):
                self.settling.settle()
            for link in list(self.links.values()):
                self._tell_wanted(link)
            with self._alone("counts"):
                self._tell_counts()
            if now_s >= slow_s:
                slow_s = now_s + _SLOW_TICK_S
                with self._alone("heartbeat"):
                    self._heartbeat()
            if now_s >= prune_s and await self._prune():
                prune_s = now_s + _PRUNE_EVERY_S

    async def _prune(self) -> bool:
        """Delete unneeded journals; return False if the time budget ended before the work.

        One journal after the other, and other tasks run in between.
        """
        until_s = time.monotonic() + _PRUNE_MOST_S
        for node in list(self.nodes):
            with self._alone(f"node {node.name}, deleting unneeded journals"):
                while node.prune(self.recorder.needed(node.name)):
                    await asyncio.sleep(0)
                    if time.monotonic() >= until_s:
                        return False
        return True

    async def _check_folder(self) -> None:
        """Check the data folder; while it is away, report that on every node.

        Nothing is sealed or deleted then. The folder is reopened only here, when no file of the
        former one is open.

        Raises:
            StorageError: it is away.
        """
        try:
            self.folder.check()
        except StorageError as error:
            for node in list(self.nodes):
                self._cannot_keep(node, error)
                for stream in [each for each in node.streams.values() if each.is_open]:
                    stream.let_go()
                    with suppress(StorageError):
                        await asyncio.to_thread(stream.sync)
            # Not before: frames synced to the former folder must not be acknowledged.
            self.folder.take_again()

    async def close(self) -> None:
        """Close the links, cancel the calibration job, wait for running sealing."""
        for link in list(self.links.values()):
            link.end(Close.RESTART, "the server is stopping; reconnect")
        await self.weighings.close()
        await self.fits.close()
        await self.settling.close()
        for node in self.nodes:
            keep = [node.keep] if node.has_words else []
            for write in (*keep, *(stream.close for stream in node.streams.values())):
                try:
                    write()
                except StorageError as error:
                    log.warning("%s", error)
        self.folder.close()

    def check_storage(self) -> None:
        """Check that the data folder is writable.

        Raises:
            FolderGoneError: it is not in its place.
            StorageError: it is not writable.
        """
        self.folder.check_writable()

    @property
    def problems(self) -> list[str]:
        """Damage found in the data folder, and the consequence, as text."""
        return [
            *self.folder.problems,
            *self.nodes.problems,
            *self.identities.problems,
            *self.sessions.problems,
            *self.calibrations.problems,
        ]

    def accept_replacement(self, node: str, fingerprint: str) -> None:
        """Accept the machine that was refused last for a node, by a person's decision.

        Args:
            node: name of the node.
            fingerprint: fingerprint of the machine.

        Raises:
            UnknownError: no node has this name.
            StateError, ChangedError, StorageError: as `NodeIdentities.accept_replacement`.
        """
        the_node = self.nodes.find(node)
        if the_node is None and node not in self.identities.replacements:
            self.nodes.get(node)
        self.identities.accept(node, fingerprint)
        link = self.links.get(node)
        if link is not None:
            link.end(Close.WRONG_IDENTITY, "a person has accepted another machine under this name")
        if the_node is not None:
            self.tell_node(the_node)

    async def empty_trash(self) -> tuple[int, int]:
        """Delete all sessions in the trash; return the number of sessions and of bytes.

        Raises:
            StorageError: a file cannot be deleted.
        """
        doomed = self.sessions.trash.doom()
        return len(doomed), await asyncio.to_thread(destroy, doomed)

    def view_node(self, node: ServerNode) -> NodeView:
        """Return a node's present state, for answers and subscribers."""
        return NodeView.of(node, self.recorder, self.identities.replacements.get(node.name))

    def node_as_json(self, node: ServerNode) -> dict[str, Any] | None:
        """Return a node's present state as JSON; None on an error, which is logged."""
        with self._alone(f"node {node.name}, as JSON"):
            return self.view_node(node).model_dump(mode="json")
        return None

    def tell_node(self, node: ServerNode) -> None:
        """Send a node's present state to all subscribers."""
        if self.hub.subscribers and (view := self.node_as_json(node)) is not None:
            self.hub.notice({"type": "node", "node": view})

    def _tell_wanted(self, link: Link) -> None:
        """Notify a node if its retention request has changed."""
        with self._alone(f"node {link.node.name}, retention request"):
            if link.wanted is not None and self.recorder.wanted(link.node.name) != link.wanted:
                link.news.set()

    def _tell_counts(self) -> None:
        """Send the progress of unsealed sessions to subscribers, where it has changed."""
        counts: dict[str, Counted] = {}
        for session in self.sessions.unsealed() if self.hub.subscribers else ():
            if session.state in ("recording", "pending"):
                counted = counts[session.id] = Counted.of(session, self.recorder)
                if counted != self._counts.get(session.id):
                    self.hub.count(session.node, {session.id: counted.model_dump()})
        self._counts = counts

    @contextmanager
    def _alone(self, what: str) -> Iterator[None]:
        """Context manager: log an error of the block and go on; a repeated one rarely."""
        try:
            yield
        except Exception as error:
            before, said_s = self._failing.get(what, ("", 0.0))
            if str(error) != before or time.monotonic() - said_s > _SAY_AGAIN_S:
                self._failing[what] = (str(error), time.monotonic())
                if isinstance(error, FootTileError | OSError):
                    log.warning("%s: %s", what, error)
                else:
                    log.exception("%s: this is a bug; the server goes on", what)
        else:
            self._failing.pop(what, None)

    def _ask_again(self, node: ServerNode) -> None:
        link = self.links.get(node.name)
        if link is not None:
            link.end(Close.RESTART, "frames are damaged here; resend the missing ones")

    def _tell_session(self, session: Session) -> None:
        if self.hub.subscribers:
            view = SessionView.of(session, self.recorder).model_dump(mode="json")
            self.hub.notice({"type": "session", "session": view})

    def _heartbeat(self) -> None:
        if not self.hub.subscribers:
            return
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
        for session in self.sessions.unsealed():
            self._tell_session(session)

    async def _sync(self, node: ServerNode) -> None:
        """Sync a node's journals to disk, then acknowledge the frames in them."""
        with self._alone(f"node {node.name}, syncing to the disk"):
            if node.storage_problem is not None:  # perhaps not even a journal was created
                await self._try_again(node)
                return
            if node.has_words:
                try:
                    self.folder.check()
                    await asyncio.to_thread(node.keep)
                except StorageError as error:
                    self._cannot_keep(node, error)
                    return
            streams = [stream for stream in node.streams.values() if stream.has_news]
            await asyncio.gather(*(self._sync_stream(node, stream) for stream in streams))

    async def _sync_stream(self, node: ServerNode, stream: ServerStream) -> None:
        unsynced, stream.unsynced = stream.unsynced, Intervals()
        unacked, stream.owed = stream.owed, Intervals()
        try:
            await asyncio.to_thread(stream.sync)
            self.folder.check()
        except Exception as error:
            self._cannot_keep(node, error)
            # The kernel may drop pages that it could not write: the node has to send them again.
            stream.disown(stream.unsynced | unsynced)
            stream.unsynced, stream.owed = Intervals(), Intervals()
            if not isinstance(error, StorageError):
                raise
            return
        link = self.links.get(node.name)
        if link is not None and unacked:
            link.acknowledge(stream.boot_id, unacked)

    async def _try_again(self, node: ServerNode) -> None:
        """Retry after a storage error; once the disk is writable, request the missing frames."""
        try:
            await asyncio.to_thread(self.check_storage)
        except StorageError:
            return
        log.warning("node %s: the server can write again", node.name)
        node.storage_problem = None
        self._unkept.discard(node.name)
        self.tell_node(node)
        if node.name in self.links:
            self.links[node.name].end(
                Close.RESTART, "the server can write again; resend the missing frames"
            )

    def _cannot_keep(self, node: ServerNode, error: Exception) -> None:
        """Record that a node's frames cannot be stored; log and notify once."""
        node.storage_problem = str(error)
        if node.name not in self._unkept:
            self._unkept.add(node.name)
            log.warning("node %s: its frames are not stored: %s", node.name, error)
            self.tell_node(node)
