"""A node: acquisition in its own process, a backlog, and the publisher that empties it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count

from devices.frames import ArrayInfo
from service.acquirer import AcquisitionProcess, Batch, Failed, Health, Message, Started
from service.backlog import Backlog, make_room
from service.estimation.calibration import Calibration
from service.link import PROTOCOL, Hello, Status, StreamEnd
from service.publisher import Publisher
from service.rig import RigOptions

_LOOK_S = 0.02
_DRAIN_S = 3.0
_AWAY_LOOKS = 50


async def run_node(
    options: RigOptions,
    server: str,
    *,
    calibration: Calibration | None,
    calibration_problem: str | None,
    token: str | None,
    stop: asyncio.Event,
    report: Callable[[str], None],
) -> int:
    """Take frames and publish them until `stop`; how many frames the server never took.

    Args:
        options: the array to open.
        server: address of the server.
        calibration: of its tiles, for the server to estimate with.
        calibration_problem: why there is none.
        token: for servers that want one.
        stop: ends the node, gently.
        report: told what happens to the link.

    Raises:
        FootTileError: the array cannot be opened, or failed for good.
    """
    loop = asyncio.get_running_loop()
    messages: asyncio.Queue[Message] = asyncio.Queue()
    streams: list[_Stream] = []
    stopping = asyncio.create_task(stop.wait())
    acquisition = AcquisitionProcess(options, lambda message: _hand_over(loop, messages, message))
    publishing: asyncio.Task[None] | None = None

    def publisher(stream: _Stream) -> Publisher:
        def hello() -> Hello:
            return Hello(
                protocol=PROTOCOL,
                array_info=stream.info,
                first_seq=stream.backlog.first_seq,
                next_seq=stream.backlog.next_seq,
                scene=options.scene.model_dump(mode="json"),
                emulated=options.emulated,
                calibration=calibration,
                calibration_problem=calibration_problem,
                previous=stream.previous,
            )

        def status() -> Status:
            return Status(
                missed_slots=stream.missed_slots,
                first_seq=stream.backlog.first_seq,
                troubles=stream.health.troubles,
                counts={serial: dict(counts) for serial, counts in stream.health.counts.items()},
            )

        return Publisher(
            server, hello=hello, backlog=stream.backlog, status=status, token=token, report=report
        )

    try:
        started = await _started(messages, stopping)
        if started is None:
            return 0
        streams.append(_begin(started, None, report))
        publishing = asyncio.create_task(_publish(streams, publisher))
        publishing.add_done_callback(lambda task: _tell_failure(task, messages))
        stopping.add_done_callback(lambda _: acquisition.stop())
        while not isinstance(message := await messages.get(), Failed):
            stream = streams[-1]
            if isinstance(message, Batch):
                make_room([each.backlog for each in streams], message.batch)
                stream.backlog.append(message.batch)
                stream.missed_slots = message.missed_slots
                stream.health = message.health
                if stream.publisher is not None:
                    stream.publisher.notify()
                for news in message.news:
                    report(news)
            elif isinstance(message, Started):
                stream.has_ended = True
                streams.append(_begin(message, stream, report))
        if message.error is not None:
            raise message.error
        streams[-1].has_ended = True
        await _drain(streams)
    finally:
        stopping.cancel()
        if publishing is not None:
            publishing.cancel()
            await asyncio.gather(publishing, return_exceptions=True)
        await asyncio.to_thread(acquisition.close)
    return sum(s.backlog.next_seq - s.backlog.first_seq + s.backlog.evicted_frames for s in streams)


async def _drain(streams: list[_Stream]) -> None:
    """Give the server, if it is there, a moment to take all streams to their ends."""
    with suppress(TimeoutError):
        async with asyncio.timeout(_DRAIN_S):
            away = 0
            while any(not stream.is_delivered for stream in streams) and away < _AWAY_LOOKS:
                # Between two streams there is no connection for a moment.
                away = 0 if any(stream.is_connected for stream in streams) else away + 1
                await asyncio.sleep(_LOOK_S)


@dataclass
class _Stream:
    """One stream: it ends when the array becomes another one, and is given away to its end."""

    info: ArrayInfo
    previous: StreamEnd | None
    backlog: Backlog = field(default_factory=Backlog)
    missed_slots: int = 0
    health: Health = Health()  # noqa: RUF009  # frozen, so one for all is safe
    has_ended: bool = False
    publisher: Publisher | None = None

    @property
    def is_delivered(self) -> bool:
        """Has the server everything?"""
        return self.has_ended and self.backlog.first_seq == self.backlog.next_seq

    @property
    def is_connected(self) -> bool:
        """Is there a server that takes it now?"""
        return self.publisher is not None and self.publisher.is_connected and not self.is_delivered


def _begin(started: Started, before: _Stream | None, report: Callable[[str], None]) -> _Stream:
    info = started.info
    report(f"{len(info.tiles)} tiles at {info.nominal_rate_hz:.0f} frames/s")
    for remark in started.remarks:
        report(remark)
    previous = None
    if before is not None:
        report("the tiles are described anew: a new stream begins")
        previous = StreamEnd(boot_id=before.info.boot_id, next_seq=before.backlog.next_seq)
    return _Stream(info, previous)


async def _publish(streams: list[_Stream], publisher: Callable[[_Stream], Publisher]) -> None:
    """Publish one stream after the other, each until the server has it to its end."""
    for number in count():
        while number >= len(streams):
            await asyncio.sleep(_LOOK_S)
        stream = streams[number]
        stream.publisher = publisher(stream)
        running = asyncio.create_task(stream.publisher.run())
        try:
            while not stream.is_delivered:
                await asyncio.wait({running}, timeout=_LOOK_S)
                if running.done():
                    running.result()
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)


def _tell_failure(task: asyncio.Task[None], messages: asyncio.Queue[Message]) -> None:
    """A publisher that failed for good ends the node: better that than to go on in silence."""
    if not task.cancelled() and task.exception() is not None:
        messages.put_nowait(Failed(task.exception()))


async def _started(
    messages: asyncio.Queue[Message], stopping: asyncio.Task[bool]
) -> Started | None:
    """The array, once it is open; None if the node is stopped before."""
    first = asyncio.create_task(messages.get())
    await asyncio.wait({first, stopping}, return_when=asyncio.FIRST_COMPLETED)
    if not first.done():
        first.cancel()
        return None
    match first.result():
        case Started() as started:
            return started
        case Failed(error) if error is not None:
            raise error
        case _:
            return None


def _hand_over(
    loop: asyncio.AbstractEventLoop, messages: asyncio.Queue[Message], message: Message
) -> None:
    try:
        loop.call_soon_threadsafe(messages.put_nowait, message)
    except RuntimeError:  # the loop has ended; nobody listens any more
        return
