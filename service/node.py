"""A node: acquisition in its own process, a backlog, and the publisher that empties it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from service.acquirer import AcquisitionProcess, Batch, Failed, Message, Started
from service.backlog import Backlog
from service.estimation.calibration import Calibration
from service.link import PROTOCOL, Hello, Status
from service.publisher import Publisher
from service.rig import RigOptions


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
    backlog = Backlog()
    missed_slots = 0
    stopping = asyncio.create_task(stop.wait())
    acquisition = AcquisitionProcess(options, lambda message: _hand_over(loop, messages, message))
    publishing: asyncio.Task[None] | None = None
    try:
        started = await _started(messages, stopping)
        if started is None:
            return 0
        info = started.info
        for remark in started.remarks:
            report(remark)
        report(f"{len(info.tiles)} tiles at {info.nominal_rate_hz:.0f} frames/s, {info.schedule}")
        publisher = Publisher(
            server,
            hello=lambda: Hello(
                protocol=PROTOCOL,
                array_info=info,
                first_seq=backlog.first_seq,
                next_seq=backlog.next_seq,
                scene=options.scene.model_dump(mode="json"),
                emulated=options.emulated,
                calibration=calibration,
                calibration_problem=calibration_problem,
            ),
            backlog=backlog,
            status=lambda: Status(missed_slots=missed_slots, first_seq=backlog.first_seq),
            token=token,
            report=report,
        )
        publishing = asyncio.create_task(publisher.run())
        publishing.add_done_callback(lambda task: _tell_failure(task, messages))
        stopping.add_done_callback(lambda _: acquisition.stop())
        while not isinstance(message := await messages.get(), Failed):
            if isinstance(message, Batch):
                backlog.append(message.batch)
                missed_slots = message.missed_slots
                publisher.notify()
        if message.error is not None:
            raise message.error
        await publisher.drain()
    finally:
        stopping.cancel()
        if publishing is not None:
            publishing.cancel()
            await asyncio.gather(publishing, return_exceptions=True)
        await asyncio.to_thread(acquisition.close)
    return backlog.next_seq - backlog.first_seq + backlog.evicted_frames


def _tell_failure(task: asyncio.Task[None], messages: asyncio.Queue[Message]) -> None:
    """A publisher that failed for good ends the node: better that than to go on in silence."""
    if not task.cancelled() and task.exception() is not None:
        messages.put_nowait(Failed(task.exception()))


async def _started(
    messages: asyncio.Queue[Message], stopping: asyncio.Task[bool]
) -> Started | None:
    """What the acquisition says once it has begun; None if the node is stopped before."""
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
