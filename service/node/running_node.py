"""Running node: acquisition process, journal on disk, local recording, hello, and publisher."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Awaitable, Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

from devices.errors import FootTileError
from devices.sync_lines import RecordingLine
from devices.vitals import VITALS_INTERVAL_S, Vitals, VitalsWarnings, read_vitals
from service.estimation.calibration import Calibration
from service.node.acquisition_process import (
    AcquiredBatch,
    AcquisitionEnded,
    AcquisitionMessage,
    AcquisitionProcess,
    AcquisitionStarted,
    ArrayHealth,
    WaitingForArray,
)
from service.node.frame_sender import NodeCallbacks
from service.node.local_recording import LocalRecording
from service.node.publisher import Publisher
from service.node.server_secrets import ServerSecrets
from service.protocol.link import (
    PROTOCOL,
    EarlierStream,
    Hello,
    NodeStatus,
    RetentionMessage,
)
from service.rig.emulated_foot import RigOptions
from storage.journal.node.journal import NodeJournal
from storage.journal.node.retention import RetentionRequest
from storage.journal.node.stream import NodeStream


@dataclass(frozen=True)
class NodeOptions:
    """Options of a node.

    Attributes:
        rig_options: options of the rig.
        node_folder: the node's folder.
        server_url: address of the server; None: no server, local recording only.
        session_name: name of a session to record on the node itself; None: no recording.
        calibration: calibration of the tiles, for the server's estimates.
        calibration_problem: reason why there is no calibration.
        token: the server's token; None: the token of this user's server on this machine.
        ca_path: file or folder of CA certificates, in addition to the system's.
        find_server: returns the server's address now, in place of `server_url`, from the ids of
            servers that share a secret with this node.
    """

    rig_options: RigOptions
    node_folder: Path
    server_url: str | None
    session_name: str | None = None
    calibration: Calibration | None = None
    calibration_problem: str | None = None
    token: str | None = None
    ca_path: Path | None = None
    find_server: Callable[[Collection[str]], Awaitable[str]] | None = None


_POLL_S = 0.02
"""Poll interval while waiting for delivery."""
_DELIVERY_TIMEOUT_S = 3.0
"""Timeout of delivery to the server when the node stops."""
_POLLS_WITHOUT_LINK_MAX = 50
"""Polls without a link, a second in all, that end the wait for delivery."""
_PROBLEMS_MAX, _PROBLEM_LENGTH = 20, 400
"""Limits of the journal's problems in a status message; the node reports all problems locally."""
_WARNINGS_INTERVAL_S = 0.5
"""Interval of checks for changed warnings."""
_STALL_S = 2.0
"""Time without a batch after which acquisition counts as stalled; a batch takes 25 ms."""


@dataclass(frozen=True)
class NodeOutcome:
    """Outcome of a node's run, for the frames of sessions.

    Attributes:
        undelivered_frames: frames on the node's disk that the server has not acknowledged.
        lost_frames: frames of sessions that are on no disk of node or server.
        recorded_session_id: id of the local session; None: no recording, or not sealed.
        is_lossy: True if that session is not complete.
        not_sampled_share: share of its slots in which no frame was sampled, 0 to 1.
    """

    undelivered_frames: int = 0
    lost_frames: int = 0
    recorded_session_id: str | None = None
    is_lossy: bool = False
    not_sampled_share: float = 0.0


async def run_node(
    options: NodeOptions, *, stop: asyncio.Event, report: Callable[[str], None]
) -> NodeOutcome:
    """Acquire frames, journal them and publish them until `stop`.

    Args:
        options: options of the node.
        stop: ends the node in order.
        report: called with messages about link, disk and array.

    Raises:
        FootTileError: the array cannot be opened or failed for good, or another node uses the
            folder.
    """
    rig = options.rig_options
    journal = await asyncio.to_thread(NodeJournal, options.node_folder, rig.node_name)
    try:
        node = RunningNode(options, journal, report)
        journal.start_writer()  # only now, when the retention for local sessions is set
        try:
            return await node.run_until(stop)
        finally:
            await node.close()
    finally:
        await asyncio.to_thread(journal.end_streams_and_close)


class RunningNode:
    """Running node: connects acquisition, journal, recording and publisher."""

    def __init__(
        self, options: NodeOptions, journal: NodeJournal, report: Callable[[str], None]
    ) -> None:
        self._options = options
        self._journal = journal
        self._report = report
        self._recording = LocalRecording(
            options.node_folder,
            options.rig_options.node_name,
            journal,
            session_name=options.session_name,
            calibration=options.calibration,
            scene_content=options.rig_options.scene.model_dump(mode="json"),
            is_emulated=options.rig_options.is_emulated,
            report=report,
            get_vitals=lambda: self._vitals,
        )
        for problem in journal.problems:
            report(problem)
        self._health = ArrayHealth()
        self._current_stream: NodeStream | None = None
        self._messages: asyncio.Queue[AcquisitionMessage] = asyncio.Queue()
        self._last_message_s = math.inf
        """Time of the last message from acquisition; infinite before the first."""
        self._publisher: Publisher | None = None
        self._publishing: asyncio.Task[None] | None = None
        sync = options.rig_options.scene.sync
        self._recording_line: RecordingLine | None = None
        if sync is not None and sync.output_line is not None:
            self._recording_line = RecordingLine(sync, sync.output_line)
        self._vitals: Vitals | None = None
        self._vitals_warnings: tuple[str, ...] = ()
        self._queued_bytes = 0
        """Bytes of frames since the last reading of the vitals."""
        self._reported_warnings: tuple[str, ...] = ()
        self._is_closing = False
        loop = asyncio.get_running_loop()
        self._acquisition = AcquisitionProcess(
            replace(options.rig_options, journals_folder=journal.folder),
            lambda message: _enqueue_message(loop, self._messages, message),
        )

    async def run_until(self, stop: asyncio.Event) -> NodeOutcome:
        """Run until stopped, or until the array fails for good."""
        stopping = asyncio.create_task(stop.wait())
        tasks: list[asyncio.Task[Any]] = [stopping, asyncio.create_task(self._report_warnings())]
        tasks.append(asyncio.create_task(self._watch_vitals()))
        try:
            started = await self._await_array(stopping)
            if started is None:
                return NodeOutcome()
            stopping.add_done_callback(lambda _: self._acquisition.request_stop())
            await self._begin_stream(started)
            sealing = asyncio.create_task(asyncio.to_thread(self._seal_earlier_sessions))
            tasks.append(sealing)
            if self._options.server_url is not None:
                self._start_publisher(self._options.server_url)
            while not isinstance(message := await self._messages.get(), AcquisitionEnded):
                self._last_message_s = time.monotonic()
                if isinstance(message, AcquisitionStarted):
                    self._report("the tiles have a new description: a new stream begins")
                    await self._begin_stream(message)
                elif isinstance(message, AcquiredBatch) and self._current_stream is not None:
                    self._store_batch(self._current_stream, message)
            self._drive_recording_line(is_recording=False)
            if self._current_stream is not None:
                self._current_stream.mark_ended_in_memory()
            await self._wait_for_delivery()
            # A session sealed before all frames are on disk would lack those in flight.
            outcome = NodeOutcome(is_lossy=self._options.session_name is not None)
            if await asyncio.to_thread(self._journal.wait_for_ended_streams_on_disk):
                outcome = await asyncio.to_thread(self._make_outcome)
            else:
                self._report("the disk does not take the last frames: nothing is sealed yet")
            if message.error is not None:
                raise message.error
            return outcome
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _await_array(self, stopping: asyncio.Task[bool]) -> AcquisitionStarted | None:
        """Wait until the array is open; return None if the node is stopped before."""
        reported = ""
        while True:
            message = asyncio.create_task(self._messages.get())
            await asyncio.wait({message, stopping}, return_when=asyncio.FIRST_COMPLETED)
            if not message.done():
                message.cancel()
                return None
            match message.result():
                case AcquisitionStarted() as started:
                    return started
                case WaitingForArray(problem):
                    if problem != reported:
                        self._report(f"waits for the array, and asks again each second: {problem}")
                    reported = problem
                case AcquisitionEnded(error) if error is not None:
                    raise error
                case _:
                    return None

    def _on_publisher_end(self, task: asyncio.Task[None]) -> None:
        """End the node if the publisher ended unexpectedly."""
        if not self._is_closing:
            error = None if task.cancelled() else task.exception()
            self._messages.put_nowait(
                AcquisitionEnded(error or FootTileError("the publisher has ended"))
            )

    async def close(self) -> None:
        """End publisher and acquisition."""
        self._is_closing = True
        if self._publishing is not None:
            self._publishing.cancel()
            await asyncio.gather(self._publishing, return_exceptions=True)
        await asyncio.to_thread(self._acquisition.close)
        if self._recording_line is not None:
            self._recording_line.close()

    async def _begin_stream(self, started: AcquisitionStarted) -> None:
        info = started.info
        self._report(f"{len(info.tiles)} tiles at {info.nominal_rate_hz:.0f} frames/s")
        for remark in started.startup_messages:
            self._report(remark)
        self._current_stream = self._journal.switch_to_new_stream(info)
        await asyncio.to_thread(self._recording.add_stream, self._current_stream)
        if self._options.session_name is not None:
            self._drive_recording_line(is_recording=True)
        if self._publisher is not None:
            self._publisher.reconnect_for_new_stream()

    def _store_batch(self, stream: NodeStream, message: AcquiredBatch) -> None:
        self._journal.queue_batch_and_limit_memory(
            stream, message.encoded_batch, message.missed_slots
        )
        self._health = message.health
        self._queued_bytes += len(message.encoded_batch.payload)
        if self._publisher is not None:
            self._publisher.notify_new_frames()
        for notice in message.warning_changes:
            self._report(notice)

    def _start_publisher(self, server: str) -> None:
        secrets = ServerSecrets(self._journal.folder, self._report)
        find_server = self._options.find_server

        async def find() -> str:
            assert find_server is not None  # noqa: S101  # only then it is passed on
            return await find_server(await asyncio.to_thread(secrets.list_server_ids))

        self._publisher = Publisher(
            server,
            NodeCallbacks(
                get_present_stream=self._get_present_stream,
                get_streams=lambda: {stream.stream_id: stream for stream in self._journal.streams},
                make_hello=lambda: make_hello(
                    self._options, self._journal, self._get_present_stream()
                ).model_copy(update={"vitals": self._vitals}),
                get_secret=secrets.get_or_create_secret,
                make_status=self._make_status,
                on_retention_request=self._on_retention_request,
                on_damaged_frames=self._journal.queue_invalidation,
            ),
            token=self._options.token,
            ca_path=self._options.ca_path,
            report=self._report,
            find_server=None if find_server is None else find,
        )
        self._publishing = asyncio.create_task(self._publisher.publish_forever())
        self._publishing.add_done_callback(self._on_publisher_end)

    def _get_present_stream(self) -> NodeStream:
        if self._current_stream is None:
            raise RuntimeError("no stream has begun")
        return self._current_stream

    def _make_status(self, backlog_frames: int) -> NodeStatus:
        return NodeStatus(
            missed_slots=self._get_present_stream().missed_slots,
            backlog_frames=backlog_frames,
            warnings=(
                *self._stall_warnings(),
                *self._health.warnings,
                *self._machine_warnings,
                *(problem[:_PROBLEM_LENGTH] for problem in self._journal.problems[:_PROBLEMS_MAX]),
            ),
            counts={serial: dict(counts) for serial, counts in self._health.fault_counts.items()},
            vitals=self._vitals,
        )

    async def _watch_vitals(self) -> None:
        """Read the vitals every few seconds, in a thread: a disk or a command may hang."""
        warnings, begin_s, reported = VitalsWarnings(), None, ""
        while True:
            bytes_per_s, now_s = None, time.monotonic()
            if begin_s is not None:
                bytes_per_s = self._queued_bytes / (now_s - begin_s)
            begin_s, self._queued_bytes = now_s, 0
            try:
                self._vitals = await asyncio.to_thread(
                    read_vitals, self._options.node_folder, bytes_per_s
                )
            except Exception as error:  # a machine's files may say anything; the next may be good
                self._vitals = None
                if (problem := f"the vitals of this machine cannot be read: {error}") != reported:
                    self._report(problem)
                reported = problem
            self._vitals_warnings = warnings.update(self._vitals or Vitals())
            await asyncio.sleep(VITALS_INTERVAL_S)

    def _on_retention_request(
        self, server_id: str, wanted: RetentionMessage, known: tuple[str, ...]
    ) -> None:
        streams = {stream.stream_id: stream.numbers for stream in wanted.streams}
        wants = RetentionRequest(streams=streams, recording=wanted.recording, known=known)
        self._journal.update_retention_request(server_id, wants)
        self._drive_recording_line(
            is_recording=wanted.recording or self._options.session_name is not None
        )

    def _drive_recording_line(self, *, is_recording: bool) -> None:
        """Drive the line; without a link it stays as it is, since the recording goes on."""
        if self._recording_line is not None and self._current_stream is not None:
            self._recording_line.drive(high=is_recording and not self._current_stream.has_ended)

    @property
    def _machine_warnings(self) -> tuple[str, ...]:
        """Warnings about the recording line, the vitals and the disk."""
        line = self._recording_line.warning if self._recording_line is not None else ""
        warnings = (line, *self._vitals_warnings, *self._journal.disk_refusal_warnings)
        return tuple(filter(None, warnings))

    def _stall_warnings(self) -> tuple[str, ...]:
        """Return a warning if acquisition is stalled; this process and its link go on."""
        silent_s = time.monotonic() - self._last_message_s
        if silent_s < _STALL_S:
            return ()
        return (f"acquisition is held up; no frames for {silent_s:.0f} s",)

    async def _report_warnings(self) -> None:
        """Report stalls of acquisition and problems of the disk, and their end."""
        while True:
            await asyncio.sleep(_WARNINGS_INTERVAL_S)
            warnings = (*self._stall_warnings(), *self._machine_warnings)
            kinds = tuple(warning.partition(";")[0] for warning in warnings)
            for kind in kinds:
                if kind not in self._reported_warnings:
                    self._report(kind)
            for kind in self._reported_warnings:
                if kind not in kinds:
                    self._report(f"no longer: {kind}")
            self._reported_warnings = kinds

    async def _wait_for_delivery(self) -> None:
        """Wait for the server, if connected, to acknowledge all frames, within a timeout."""
        publisher = self._publisher
        if publisher is None:
            return
        with suppress(TimeoutError):
            async with asyncio.timeout(_DELIVERY_TIMEOUT_S):
                away = 0
                while (
                    self._count_undelivered(counts_unneeded=True) and away < _POLLS_WITHOUT_LINK_MAX
                ):
                    away = 0 if publisher.is_connected else away + 1
                    await asyncio.sleep(_POLL_S)

    def _count_undelivered(self, *, counts_unneeded: bool = False) -> int:
        present = self._current_stream if counts_unneeded else None
        return sum(
            (
                stream.available - stream.acked
                if stream is present
                else self._journal.available_undelivered_numbers(stream)
            ).number_count
            for stream in self._journal.streams
        )

    def _seal_earlier_sessions(self) -> None:
        if self._journal.wait_for_ended_streams_on_disk():
            self._recording.seal_earlier_sessions()

    def _make_outcome(self) -> NodeOutcome:
        recorded = self._recording.stop_and_seal()
        ledger = None if recorded is None else recorded.ledger
        lost = 0
        for stream in self._journal.streams:
            wanted = self._journal.retention_requests.node_session_or_server_numbers_of(
                stream.stream_id
            )
            lost += sum(
                numbers.number_count for numbers in stream.lost.restricted_to(wanted).values()
            )
        return NodeOutcome(
            undelivered_frames=self._count_undelivered()
            if self._options.server_url is not None
            else 0,
            lost_frames=lost,
            recorded_session_id=None if recorded is None else recorded.id,
            is_lossy=recorded is not None and (ledger is None or not ledger.complete),
            not_sampled_share=0.0 if ledger is None else ledger.not_sampled_share,
        )


def _enqueue_message(
    loop: asyncio.AbstractEventLoop,
    messages: asyncio.Queue[AcquisitionMessage],
    message: AcquisitionMessage,
) -> None:
    try:
        loop.call_soon_threadsafe(messages.put_nowait, message)
    except RuntimeError:  # the event loop has ended
        return


_EARLIER_MAX = 64
"""Most earlier streams that fit into a message."""


def make_hello(options: NodeOptions, journal: NodeJournal, present_stream: NodeStream) -> Hello:
    """Compose a node's hello; reads the journals of earlier streams.

    Raises:
        StorageError: a journal cannot be read.
    """
    next_seq = present_stream.next_seq  # before `stored`, which may grow meanwhile
    # Another stream may have begun meanwhile; it has not ended.
    others = list(takewhile(lambda stream: stream is not present_stream, journal.streams))
    # Streams that a session waits for come first, then the newest.
    waited_for = [stream for stream in others if journal.available_undelivered_numbers(stream)]
    rest = [stream for stream in others if stream not in waited_for]
    chosen = (*waited_for[:_EARLIER_MAX], *rest[-_EARLIER_MAX:])[:_EARLIER_MAX]
    earlier = [stream for stream in others if stream in chosen]
    return Hello(
        protocol=PROTOCOL,
        array_info=present_stream.info,
        stored=tuple(present_stream.available),
        next_seq=next_seq,
        t_mono_ns=time.monotonic_ns(),
        lost=present_stream.lost.to_pairs(),
        t_ns_first=_read_first_t_ns(present_stream),
        scene=options.rig_options.scene.model_dump(mode="json"),
        emulated=options.rig_options.is_emulated,
        calibration=options.calibration,
        calibration_problem=options.calibration_problem,
        earlier=tuple(_make_earlier_stream(stream) for stream in earlier),
        has_more=len(earlier) < len(others),
    )


def _read_first_t_ns(stream: NodeStream) -> int:
    journal = stream.journal
    return (
        journal.find_batch_t_ns_near(0, at_or_before=False) if journal is not None else None
    ) or 0


def _make_earlier_stream(stream: NodeStream) -> EarlierStream:
    return EarlierStream(
        array_info=stream.info,
        stored=tuple(stream.available),
        next_seq=stream.next_seq,
        lost=stream.lost.to_pairs(),
        max_lost_tail_frames=stream.notes.max_lost_tail_frames,
        missed_slots=stream.missed_slots,
        t_ns_first=_read_first_t_ns(stream),
    )
