"""Running node: acquisition process, journal on disk, local recording, and publisher."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from devices.errors import FootTileError
from service.link import Status, Wanted
from service.node.acquisition import (
    AcquisitionProcess,
    Batch,
    Failed,
    Health,
    Message,
    Started,
    Waiting,
)
from service.node.connection import hello_of
from service.node.options import NodeOptions
from service.node.publisher import Publisher
from service.node.recording import NodeRecording
from service.node.secrets import ServerSecrets
from service.node.sending import Source
from storage.journal.node.journal import NodeJournal
from storage.journal.node.stream import NodeStream
from storage.journal.node.wanted import ServerWants

_LOOK_S = 0.02
"""Poll interval while waiting for delivery."""
_DRAIN_S = 3.0
"""Timeout of delivery to the server when the node stops."""
_AWAY_LOOKS = 50
"""Polls without a link, a second in all, that end the wait for delivery."""
_PROBLEMS_MAX, _PROBLEM_LENGTH = 20, 400
"""Limits of the journal's problems in a status message; the node reports all problems locally."""
_TROUBLES_S = 0.5
"""Interval of checks for changed warnings."""
_SILENT_S = 2.0
"""Time without a batch after which acquisition counts as stalled; a batch takes 25 ms."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a node's run, for the frames of sessions.

    Attributes:
        undelivered_frames: frames on the node's disk that the server has not acknowledged.
        lost_frames: frames of sessions that are on no disk of node or server.
        recorded: id of the local session; None: no recording, or not sealed.
        is_lossy: True if that session is not complete.
    """

    undelivered_frames: int = 0
    lost_frames: int = 0
    recorded: str | None = None
    is_lossy: bool = False


async def run_node(
    options: NodeOptions, *, stop: asyncio.Event, report: Callable[[str], None]
) -> Outcome:
    """Acquire frames, journal them and publish them until `stop`.

    Args:
        options: options of the node.
        stop: ends the node in order.
        report: called with messages about link, disk and array.

    Raises:
        FootTileError: the array cannot be opened or failed for good, or another node uses the
            folder.
    """
    rig = options.rig
    journal = await asyncio.to_thread(NodeJournal, options.journal, rig.node)
    try:
        node = RunningNode(options, journal, report)
        journal.start()  # only now, when the retention for local sessions is set
        try:
            return await node.run(stop)
        finally:
            await node.close()
    finally:
        await asyncio.to_thread(journal.close)


class RunningNode:
    """Running node: connects acquisition, journal, recording and publisher."""

    def __init__(
        self, options: NodeOptions, journal: NodeJournal, report: Callable[[str], None]
    ) -> None:
        self._options = options
        self._journal = journal
        self._report = report
        self._recording = NodeRecording(
            options.journal,
            options.rig.node,
            journal,
            name=options.record,
            calibration=options.calibration,
            scene_content=options.rig.scene.model_dump(mode="json"),
            emulated=options.rig.emulated,
            report=report,
        )
        for problem in journal.problems:
            report(problem)
        self._health = Health()
        self._present: NodeStream | None = None
        self._messages: asyncio.Queue[Message] = asyncio.Queue()
        self._heard_s = math.inf
        """Time of the last message from acquisition; infinite before the first."""
        self._publisher: Publisher | None = None
        self._publishing: asyncio.Task[None] | None = None
        self._told: tuple[str, ...] = ()
        self._is_closing = False
        loop = asyncio.get_running_loop()
        self._acquisition = AcquisitionProcess(
            replace(options.rig, streams=journal.folder),
            lambda message: _hand_over(loop, self._messages, message),
        )

    async def run(self, stop: asyncio.Event) -> Outcome:
        """Run until stopped, or until the array fails for good."""
        stopping = asyncio.create_task(stop.wait())
        tasks: list[asyncio.Task[Any]] = [stopping, asyncio.create_task(self._watch())]
        try:
            started = await self._await_array(stopping)
            if started is None:
                return Outcome()
            stopping.add_done_callback(lambda _: self._acquisition.stop())
            await self._begin(started)
            sealing = asyncio.create_task(asyncio.to_thread(self._seal_what_was_left))
            tasks.append(sealing)
            if self._options.server is not None:
                self._publish(self._options.server)
            while not isinstance(message := await self._messages.get(), Failed):
                self._heard_s = time.monotonic()
                if isinstance(message, Started):
                    self._report("the tiles have a new description: a new stream begins")
                    await self._begin(message)
                elif isinstance(message, Batch) and self._present is not None:
                    self._take(self._present, message)
            if self._present is not None:
                self._present.end()
            await self._drain()
            # A session sealed before all frames are on disk would lack those in flight.
            outcome = Outcome(is_lossy=self._options.record is not None)
            if await asyncio.to_thread(self._journal.settle):
                outcome = await asyncio.to_thread(self._outcome)
            else:
                self._report("the disk does not take the last frames: nothing is sealed yet")
            if message.error is not None:
                raise message.error
            return outcome
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _await_array(self, stopping: asyncio.Task[bool]) -> Started | None:
        """Wait until the array is open; return None if the node is stopped before."""
        reported = ""
        while True:
            message = asyncio.create_task(self._messages.get())
            await asyncio.wait({message, stopping}, return_when=asyncio.FIRST_COMPLETED)
            if not message.done():
                message.cancel()
                return None
            match message.result():
                case Started() as started:
                    return started
                case Waiting(problem):
                    if problem != reported:
                        self._report(f"waits for the array, and asks again each second: {problem}")
                    reported = problem
                case Failed(error) if error is not None:
                    raise error
                case _:
                    return None

    def _tell_failure(self, task: asyncio.Task[None]) -> None:
        """End the node if the publisher ended unexpectedly."""
        if not self._is_closing:
            error = None if task.cancelled() else task.exception()
            self._messages.put_nowait(Failed(error or FootTileError("the publisher has ended")))

    async def close(self) -> None:
        """End publisher and acquisition."""
        self._is_closing = True
        if self._publishing is not None:
            self._publishing.cancel()
            await asyncio.gather(self._publishing, return_exceptions=True)
        await asyncio.to_thread(self._acquisition.close)

    async def _begin(self, started: Started) -> None:
        info = started.info
        self._report(f"{len(info.tiles)} tiles at {info.nominal_rate_hz:.0f} frames/s")
        for remark in started.remarks:
            self._report(remark)
        self._present = self._journal.begin(info)
        await asyncio.to_thread(self._recording.goes_on_in, self._present)
        if self._publisher is not None:
            self._publisher.renew()

    def _take(self, stream: NodeStream, message: Batch) -> None:
        self._journal.put(stream, message.batch, message.missed_slots)
        self._health = message.health
        if self._publisher is not None:
            self._publisher.notify()
        for notice in message.notices:
            self._report(notice)

    def _publish(self, server: str) -> None:
        self._publisher = Publisher(
            server,
            Source(
                present=self._present_stream,
                streams=lambda: {stream.boot_id: stream for stream in self._journal.streams},
                hello=lambda: hello_of(self._options, self._journal, self._present_stream()),
                secret=ServerSecrets(self._journal.folder, self._report).share,
                status=self._status,
                wanted=self._want,
                damaged=self._journal.damaged,
            ),
            token=self._options.token,
            ca=self._options.ca,
            report=self._report,
        )
        self._publishing = asyncio.create_task(self._publisher.run())
        self._publishing.add_done_callback(self._tell_failure)

    def _present_stream(self) -> NodeStream:
        if self._present is None:
            raise RuntimeError("no stream has begun")
        return self._present

    def _status(self, backlog_frames: int) -> Status:
        return Status(
            missed_slots=self._present_stream().missed_slots,
            backlog_frames=backlog_frames,
            troubles=(
                *self._silence(),
                *self._health.troubles,
                *self._journal.troubles,
                *(problem[:_PROBLEM_LENGTH] for problem in self._journal.problems[:_PROBLEMS_MAX]),
            ),
            counts={serial: dict(counts) for serial, counts in self._health.counts.items()},
        )

    def _want(self, server_id: str, wanted: Wanted, known: tuple[str, ...]) -> None:
        streams = {stream.boot_id: stream.numbers for stream in wanted.streams}
        wants = ServerWants(streams=streams, recording=wanted.recording, known=known)
        self._journal.want(server_id, wants)

    def _silence(self) -> tuple[str, ...]:
        """Return a warning if acquisition is stalled; this process and its link go on."""
        silent_s = time.monotonic() - self._heard_s
        if silent_s < _SILENT_S:
            return ()
        return (f"acquisition is held up; no frames for {silent_s:.0f} s",)

    async def _watch(self) -> None:
        """Report stalls of acquisition and problems of the disk, and their end."""
        while True:
            await asyncio.sleep(_TROUBLES_S)
            troubles = (*self._silence(), *self._journal.troubles)
            kinds = tuple(trouble.partition(";")[0] for trouble in troubles)
            for kind in kinds:
                if kind not in self._told:
                    self._report(kind)
            for kind in self._told:
                if kind not in kinds:
                    self._report(f"no longer: {kind}")
            self._told = kinds

    async def _drain(self) -> None:
        """Wait for the server, if connected, to acknowledge all frames, within a timeout."""
        publisher = self._publisher
        if publisher is None:
            return
        with suppress(TimeoutError):
            async with asyncio.timeout(_DRAIN_S):
                away = 0
                while self._undelivered(everything=True) and away < _AWAY_LOOKS:
                    away = 0 if publisher.is_connected else away + 1
                    await asyncio.sleep(_LOOK_S)

    def _undelivered(self, *, everything: bool = False) -> int:
        streams = self._journal.streams
        if everything and self._present is not None:
            present = self._present
            behind = (present.held - present.acked).count
            return behind + sum(
                self._journal.undelivered(stream).count for stream in streams if stream != present
            )
        return sum(self._journal.undelivered(stream).count for stream in streams)

    def _seal_what_was_left(self) -> None:
        if self._journal.settle():
            self._recording.seal_what_was_left()

    def _outcome(self) -> Outcome:
        recorded, is_lossy = self._recording.stop()
        lost = 0
        for stream in self._journal.streams:
            wanted = self._journal.wanted.numbers(stream.boot_id)
            lost += sum(numbers.count for numbers in stream.lost.within(wanted).values())
        return Outcome(
            undelivered_frames=self._undelivered() if self._options.server is not None else 0,
            lost_frames=lost,
            recorded=recorded,
            is_lossy=is_lossy,
        )


def _hand_over(
    loop: asyncio.AbstractEventLoop, messages: asyncio.Queue[Message], message: Message
) -> None:
    try:
        loop.call_soon_threadsafe(messages.put_nowait, message)
    except RuntimeError:  # the event loop has ended
        return
