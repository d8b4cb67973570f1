"""One server process: its nodes, recorder, subscribers and links, and its periodic tick."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from devices.clock import server_utc_ns
from devices.errors import FootTileError, StorageError
from service.protocol.codec import LinkCloseCode
from service.protocol.link import RetentionMessage
from service.protocol.live import (
    Heartbeat,
    NodeChanged,
    NodeView,
    SessionChanged,
    SessionProgress,
    TrialsChanged,
    TrialsView,
)
from service.server.broadcast.broadcaster import Broadcaster
from service.server.broadcast.views import (
    make_node_counts,
    make_node_view,
    make_session_progress,
    make_session_view,
)
from service.server.calibrations import CalibrationJobs, CalibrationStore
from service.server.data_folder import DataFolder
from service.server.live_feed.buffer import FeedBuffers
from service.server.node import ServerNode
from service.server.nodes import NodeIdentities, NodeRegistry
from service.server.recorder import Recorder
from service.server.session_store import SessionStore, Trash, delete_and_count_bytes
from service.server.streams import ServerStream
from service.server.takes import TakeRecorder
from service.server.trials import TrialRecorder
from service.server.weighings import Weighings
from service.sessions.overview import ComparisonSeriesCache
from service.sessions.preview import SessionPreviews
from service.user_folders import register_private_folder
from storage.durable_files import remove_dead_process_temporaries
from storage.intervals import Intervals
from storage.sessions.folder import Session, SessionsFolder

log = logging.getLogger("foottile.server")

TICK_S = 0.2
"""Period of sync and acknowledgement."""
_SLOW_TICK_S = 1.0
_DELETE_EVERY_S = 30.0
_DELETE_BUDGET_S = 0.1
"""Time budget of deletion in one tick: sync and acknowledgement come first."""
_LOG_AGAIN_S = 60.0


class NodeLink:
    """Connection of one node, as seen by the rest of the server."""

    def __init__(self, node: ServerNode) -> None:
        self.node = node
        self.stream: ServerStream = node.present_stream
        """Stream of the frames that are being received."""
        self.retention_request: RetentionMessage | None = None
        """Last retention request sent to the node."""
        self.has_outgoing = asyncio.Event()
        """Event: something has to be sent to the node."""
        self._acks: dict[str, Intervals] = {}
        self.close_requested = asyncio.Future[tuple[LinkCloseCode, str]]()
        """Future with the reason, once the connection has to be closed."""

    def queue_ack(self, stream_id: str, frames: Intervals) -> None:
        """Queue an acknowledgement: these frames are on the disk."""
        self._acks[stream_id] = self._acks.get(stream_id, Intervals()) | frames
        self.has_outgoing.set()

    def pop_acks(self) -> dict[str, Intervals]:
        """Remove and return the queued acknowledgements, by stream id."""
        acks, self._acks = self._acks, {}
        return acks

    def request_close(self, code: LinkCloseCode, reason: str) -> None:
        """Request that the connection is closed; the first reason counts."""
        if not self.close_requested.done():
            self.close_requested.set_result((code, reason))


class DeletedTotals(NamedTuple):
    """Number and size of the sessions that were deleted from the trash."""

    session_count: int
    size_bytes: int


class Server:
    """State of a server; used from one event loop.

    Args:
        data: data folder.
        unquantized: True: estimates of recorded sessions are not rounded.

    Raises:
        StorageError: the folder cannot be written.
    """

    def __init__(self, data: Path, *, unquantized: bool = False) -> None:
        self.data = data
        register_private_folder(data)
        self.data_folder = DataFolder(data)
        self.id = self.data_folder.id
        """Id of the data folder: a node tracks separately what each server needs."""
        self._nodes_with_storage_error: set[str] = set()
        """Nodes whose storage error has been reported."""
        try:
            remove_dead_process_temporaries(data)
            self.check_writable()
            self.broadcaster = Broadcaster()
            self.calibrations = CalibrationStore(data / "calibrations")
            self.live_feeds = FeedBuffers()
            self.nodes = NodeRegistry(data)
            self.identities = NodeIdentities(data)
            self.sessions = SessionStore(
                SessionsFolder(data / "sessions"),
                Trash(data / "trash"),
                self._notify_session_changed,
            )
            self.recorder = Recorder(
                self.sessions, self.nodes, self._request_resend, unquantized=unquantized
            )
            self.takes = TakeRecorder(self.recorder, self.sessions, self.nodes)
            self.trials = TrialRecorder(
                data / "trials.json",
                self.takes,
                self.recorder,
                self.sessions,
                self.nodes,
                self._notify_trials_changed,
            )
            self.calibration_jobs = CalibrationJobs(self.sessions, self.calibrations)
            self.weighings = Weighings(
                self.sessions, self.recorder, self.calibration_jobs, self.calibrations
            )
        except FootTileError:
            self.data_folder.release_lock()
            raise
        self.previews = SessionPreviews(data)
        """Previews of unsealed sessions."""
        self.comparison_series = ComparisonSeriesCache()
        """Cache of comparison series."""
        self.links: dict[str, NodeLink] = {}
        self.sync_count, self.sync_total_s = 0, 0.0
        """Number and total time of successful syncs of journals since the start."""
        self._last_trials: TrialsView | None = None
        """List of trials that subscribers were sent last."""
        self._last_progress: dict[str, SessionProgress] = {}
        """Progress that subscribers were sent last, by session."""
        self._failures: dict[str, tuple[str, float]] = {}
        """Steps that failed in the last tick, with error and time of the log line."""

    async def run_ticks(self) -> None:
        """Run the tick until cancelled: sync, acknowledge, seal, delete, notify."""
        slow_s = prune_s = 0.0
        while True:
            await asyncio.sleep(TICK_S)
            now_s = time.monotonic()
            await asyncio.gather(*(self._sync_node(node) for node in list(self.nodes)))
            folder_is_there = False
            with self._isolate_errors("data folder"):
                await self._check_data_folder()
                folder_is_there = True
            if not folder_is_there:
                continue
            with self._isolate_errors("guided calibrations"):
                for node in self.nodes:
                    self.weighings.fail_if_stalled_or_interrupted(node, now_s)
            with self._isolate_errors("sessions"):
                self.recorder.advance_unsealed_sessions()
            with self._isolate_errors("trials"):
                self.trials.advance()
            for link in list(self.links.values()):
                self._update_retention(link)
            with self._isolate_errors("counts"):
                self._notify_progress()
            if now_s >= slow_s:
                slow_s = now_s + _SLOW_TICK_S
                with self._isolate_errors("heartbeat"):
                    self._send_heartbeat()
            if now_s >= prune_s and await self._delete_unneeded():
                prune_s = now_s + _DELETE_EVERY_S

    async def _delete_unneeded(self) -> bool:
        """Delete unneeded journals; return False if the time budget ended before the work.

        One journal after the other, and other tasks run in between.
        """
        until_s = time.monotonic() + _DELETE_BUDGET_S
        for node in list(self.nodes):
            with self._isolate_errors(f"node {node.name}, deleting unneeded journals"):
                while node.delete_old_frames_and_up_to_one_ended_journal(
                    self.recorder.collect_needed_frames(node.name)
                ):
                    await asyncio.sleep(0)
                    if time.monotonic() >= until_s:
                        return False
        return True

    async def _check_data_folder(self) -> None:
        """Check the data folder; while it is away, report that on every node.

        Nothing is sealed or deleted then. The folder is reopened only here, when no file of the
        former one is open.

        Raises:
            StorageError: it is away.
        """
        try:
            self.data_folder.check_still_in_place()
        except StorageError as error:
            for node in list(self.nodes):
                self._on_storage_error(node, error)
                for stream in [each for each in node.streams.values() if each.has_open_files]:
                    stream.drop_unsynced()
                    with suppress(StorageError):
                        await asyncio.to_thread(stream.sync)
            # Not before: frames synced to the former folder must not be acknowledged.
            self.data_folder.relock_same_folder()

    async def close(self) -> None:
        """Close the links, cancel the calibration job, wait for running sealing."""
        for link in list(self.links.values()):
            link.request_close(LinkCloseCode.RESTART, "the server is stopping; reconnect")
        await self.weighings.close()
        await self.calibration_jobs.cancel_running_job_and_wait()
        await self.recorder.wait_for_running_sealing()
        for node in self.nodes:
            keep = [node.save_hello] if node.is_dirty else []
            for write in (*keep, *(stream.close for stream in node.streams.values())):
                try:
                    write()
                except StorageError as error:
                    log.warning("%s", error)
        self.data_folder.release_lock()

    def check_writable(self) -> None:
        """Check that the data folder is writable.

        Raises:
            FolderGoneError: it is not in its place.
            StorageError: it is not writable.
        """
        self.data_folder.check_writable()

    @property
    def file_problems(self) -> list[str]:
        """Damage found in the data folder, and the consequence, as text."""
        return [
            *self.data_folder.problems,
            *self.nodes.file_problems,
            *self.identities.problems,
            *self.sessions.problems,
            *self.calibrations.problems,
            *self.trials.file_problems,
        ]

    def accept_replacement(self, node: str, fingerprint: str) -> None:
        """Accept the machine that was refused last for a node, by a person's decision.

        Args:
            node: name of the node.
            fingerprint: fingerprint of the machine.

        Raises:
            UnknownError: no node has this name.
            StateError, ChangedError, StorageError: as `NodeIdentities.accept_last_refused_machine`.
        """
        the_node = self.nodes.find(node)
        if the_node is None and node not in self.identities.refused_machines:
            self.nodes.get(node)
        self.identities.accept_last_refused_machine(node, fingerprint)
        link = self.links.get(node)
        if link is not None:
            link.request_close(
                LinkCloseCode.WRONG_IDENTITY,
                "a person has accepted another machine under this name",
            )
        if the_node is not None:
            self.notify_node_changed(the_node)

    async def empty_trash(self) -> DeletedTotals:
        """Delete all sessions in the trash.

        Raises:
            StorageError: a file cannot be deleted.
        """
        doomed = self.sessions.trash.rename_all_for_deletion()
        size_bytes = await asyncio.to_thread(delete_and_count_bytes, doomed)
        return DeletedTotals(len(doomed), size_bytes)

    def make_node_view(self, node: ServerNode) -> NodeView:
        """Return a node's present state, for answers and subscribers."""
        return make_node_view(node, self.recorder, self.identities.refused_machines.get(node.name))

    def try_make_node_view(self, node: ServerNode) -> NodeView | None:
        """Return a node's present state; None on an error, which is logged."""
        with self._isolate_errors(f"node {node.name}, its view"):
            return self.make_node_view(node)
        return None

    def notify_node_changed(self, node: ServerNode) -> None:
        """Send a node's present state to all subscribers; an error is logged."""
        if self.broadcaster.subscriber_count:
            with self._isolate_errors(f"node {node.name}, its view"):
                self.broadcaster.queue_notice(NodeChanged(node=self.make_node_view(node)))

    def notify_nodes_changed(self, sessions: Iterable[Session]) -> None:
        """Send the present state of the nodes of sessions to all subscribers."""
        for session in sessions:
            node = self.nodes.find(session.node)  # its folder may be gone
            if node is not None:
                self.notify_node_changed(node)

    def _update_retention(self, link: NodeLink) -> None:
        """Notify a node if its retention request has changed."""
        with self._isolate_errors(f"node {link.node.name}, retention request"):
            if (
                link.retention_request is not None
                and self.recorder.make_retention_request(link.node.name) != link.retention_request
            ):
                link.has_outgoing.set()

    def _notify_progress(self) -> None:
        """Send the progress of unsealed sessions to subscribers, where it has changed."""
        counts: dict[str, SessionProgress] = {}
        for session in self.sessions.list_unsealed() if self.broadcaster.subscriber_count else ():
            if session.state in ("recording", "pending"):
                counted = counts[session.id] = make_session_progress(session, self.recorder)
                if counted != self._last_progress.get(session.id):
                    self.broadcaster.queue_progress(session.node, {session.id: counted})
        self._last_progress = counts

    @contextmanager
    def _isolate_errors(self, step: str) -> Iterator[None]:
        """Context manager: log an error of the block and go on; a repeated one rarely."""
        try:
            yield
        except Exception as error:
            before, logged_s = self._failures.get(step, ("", 0.0))
            if str(error) != before or time.monotonic() - logged_s > _LOG_AGAIN_S:
                self._failures[step] = (str(error), time.monotonic())
                if isinstance(error, FootTileError | OSError):
                    log.warning("%s: %s", step, error)
                else:
                    log.exception("%s: this is a bug; the server goes on", step)
        else:
            self._failures.pop(step, None)

    def _request_resend(self, node: ServerNode) -> None:
        link = self.links.get(node.name)
        if link is not None:
            link.request_close(
                LinkCloseCode.RESTART, "frames are damaged here; resend the missing ones"
            )

    def _notify_session_changed(self, session: Session) -> None:
        if self.broadcaster.subscriber_count:
            with self._isolate_errors(f"session {session.id}, its view"):
                view = make_session_view(session, self.recorder)
                self.broadcaster.queue_notice(SessionChanged(session=view))

    def _notify_trials_changed(self, sessions: Sequence[Session] = ()) -> None:
        """Send the list of trials, and the nodes of started or stopped sessions, to subscribers."""
        self.notify_nodes_changed(sessions)
        if self.broadcaster.subscriber_count:
            with self._isolate_errors("list of trials, its view"):
                view = self.trials.make_view()
                if view != self._last_trials:
                    self._last_trials = view
                    self.broadcaster.queue_notice(TrialsChanged(trials=view))

    def _send_heartbeat(self) -> None:
        if not self.broadcaster.subscriber_count:
            return
        last = [node.last_seq for node in self.nodes if node.last_seq is not None]
        self.broadcaster.queue_notice(
            Heartbeat(
                t_ns=server_utc_ns(),
                last_seq=max(last, default=None),
                nodes={node.name: make_node_counts(node) for node in self.nodes},
            )
        )
        for session in self.sessions.list_unsealed():
            self._notify_session_changed(session)
        self._notify_trials_changed()  # their states are those of their sessions

    async def _sync_node(self, node: ServerNode) -> None:
        """Sync a node's journals to disk, then acknowledge the frames in them."""
        with self._isolate_errors(f"node {node.name}, syncing to the disk"):
            if node.storage_problem is not None:  # perhaps not even a journal was created
                await self._retry_storage(node)
                return
            if node.is_dirty:
                try:
                    self.data_folder.check_still_in_place()
                    await asyncio.to_thread(node.save_hello)
                except StorageError as error:
                    self._on_storage_error(node, error)
                    return
            streams = [stream for stream in node.streams.values() if stream.needs_sync_or_ack]
            await asyncio.gather(*(self._sync_stream(node, stream) for stream in streams))

    async def _sync_stream(self, node: ServerNode, stream: ServerStream) -> None:
        unsynced, stream.unsynced = stream.unsynced, Intervals()
        unacked, stream.unacked = stream.unacked, Intervals()
        began_s = time.monotonic()
        try:
            await asyncio.to_thread(stream.sync)
            self.data_folder.check_still_in_place()
        except Exception as error:
            self._on_storage_error(node, error)
            # The kernel may drop pages that it could not write: the node has to send them again.
            stream.invalidate(stream.unsynced | unsynced)
            stream.unsynced, stream.unacked = Intervals(), Intervals()
            if not isinstance(error, StorageError):
                raise
            return
        self.sync_count += 1
        self.sync_total_s += time.monotonic() - began_s
        link = self.links.get(node.name)
        if link is not None and unacked:
            link.queue_ack(stream.stream_id, unacked)

    async def _retry_storage(self, node: ServerNode) -> None:
        """Retry after a storage error; once the disk is writable, request the missing frames."""
        try:
            await asyncio.to_thread(self.check_writable)
        except StorageError:
            return
        log.warning("node %s: the server can write again", node.name)
        node.storage_problem = None
        self._nodes_with_storage_error.discard(node.name)
        self.notify_node_changed(node)
        if node.name in self.links:
            self.links[node.name].request_close(
                LinkCloseCode.RESTART, "the server can write again; resend the missing frames"
            )

    def _on_storage_error(self, node: ServerNode, error: Exception) -> None:
        """Record that a node's frames cannot be stored; log and notify once."""
        node.storage_problem = str(error)
        if node.name not in self._nodes_with_storage_error:
            self._nodes_with_storage_error.add(node.name)
            log.warning("node %s: its frames are not stored: %s", node.name, error)
            self.notify_node_changed(node)
