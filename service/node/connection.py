"""Connection of a node to a server after the handshake: messages in both directions.

The offset between the clocks of node and server is measured from the beginning.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from itertools import takewhile
from typing import Any

from websockets.asyncio.client import ClientConnection

from devices.errors import LinkError
from service.link import (
    PROBES,
    PROTOCOL,
    SILENCE_S,
    SUBPROTOCOL,
    Ack,
    Challenge,
    ClockRow,
    EarlierStream,
    FromServer,
    Hello,
    Lost,
    Probe,
    SaidByServer,
    Wanted,
    Welcome,
    heard,
    say,
    understood,
)
from service.node.options import NodeOptions
from service.node.sending import Greeted, Sending
from storage.journal.node.journal import NodeJournal
from storage.journal.node.stream import NodeStream

STATUS_EVERY_S = 1.0
"""Interval of status messages."""


class Connection:
    """Connection to a server: receives its messages, sends frames, status and clock probes.

    Args:
        link: connection after its handshake.
        delivered: called whenever the server has acknowledged frames.
    """

    def __init__(self, link: Greeted, delivered: Callable[[], None]) -> None:
        self._link = link
        self._delivered = delivered
        self._sending = Sending(link)
        self._probes = ClockProbes(link.socket, link.hello.array_info.utc_offset_ns)
        self._take_wanted(link.welcome.wanted)

    async def run(self, renewed: asyncio.Event) -> None:
        """Exchange messages until the connection breaks or `renewed` is set.

        Raises:
            LinkError, OSError, WebSocketException: the connection is broken.
        """
        await _until_one_ends(
            self._receive(),
            self._sending.run(),
            self._sending.watch(),
            self._probes.run(),
            self._tell_status(),
            renewed.wait(),
        )

    async def _receive(self) -> None:
        while True:
            message = parse(await self._link.socket.recv())
            match message:
                case Ack(boot_id=boot_id, seq_first=first, seq_last=last):
                    stream = self._link.source.streams().get(boot_id)
                    self._delivered()
                    # Acknowledged future frames cannot exist: do not delete them later.
                    if stream is not None and first < stream.next_seq:
                        last = min(last, stream.next_seq - 1)
                        stream.acknowledge(self._link.server_id, first, last)
                case Wanted():
                    self._take_wanted(message)
                case Probe():
                    self._probes.answered(message)
                case Challenge() | Welcome():
                    raise LinkError(f"the server sent {message.type} a second time")

    def _take_wanted(self, wanted: Wanted) -> None:
        earlier = (stream.array_info.boot_id for stream in self._link.hello.earlier)
        known = (*earlier, self._link.hello.array_info.boot_id)
        self._link.source.wanted(self._link.server_id, wanted, known)

    async def _tell_status(self) -> None:
        said = {stream.array_info.boot_id: stream.lost for stream in self._link.hello.earlier}
        said[self._link.hello.array_info.boot_id] = self._link.hello.lost
        while True:
            for boot_id, stream in self._link.source.streams().items():
                lost = stream.lost.as_pairs()
                if boot_id in said and lost != said[boot_id]:
                    said[boot_id] = lost
                    await self._link.socket.send(say(Lost(boot_id=boot_id, lost=lost)))
            await self._link.socket.send(say(self._link.source.status(self._sending.backlog.count)))
            await asyncio.sleep(STATUS_EVERY_S)


def parse(message: str | bytes) -> SaidByServer:
    """Verify and parse a message of a server.

    Raises:
        LinkError: it is no valid message of the protocol.
    """
    try:
        return understood(FromServer, heard(message))
    except LinkError as error:
        raise LinkError(
            f"the server sent an invalid message: {error}",
            expected=f"{SUBPROTOCOL} messages",
            remedy="Check that it is a foottile server of the same version",
        ) from error


async def _until_one_ends(*work: Coroutine[Any, Any, object]) -> None:
    """Run coroutines concurrently until one ends, cancel the others, and raise its exception.

    Without a TaskGroup: before Python 3.13 a group that ends while its owner is about to resume may
    leave the owner cancelled (CPython 117407), and a node without its link.
    """
    tasks = [asyncio.create_task(each) for each in work]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    for task in done:
        task.result()


_EARLIER_MAX = 64
"""Most earlier streams that fit into a message."""


def hello_of(options: NodeOptions, journal: NodeJournal, present: NodeStream) -> Hello:
    """Compose a node's hello; reads the journals of earlier streams.

    Raises:
        StorageError: a journal cannot be read.
    """
    next_seq = present.next_seq  # before `held`, which may grow meanwhile
    # Another stream may have begun meanwhile; it has not ended.
    others = list(takewhile(lambda stream: stream is not present, journal.streams))
    # Streams that a session waits for come first, then the newest.
    waited_for = [stream for stream in others if journal.undelivered(stream)]
    rest = [stream for stream in others if stream not in waited_for]
    chosen = (*waited_for[:_EARLIER_MAX], *rest[-_EARLIER_MAX:])[:_EARLIER_MAX]
    earlier = [stream for stream in others if stream in chosen]
    return Hello(
        protocol=PROTOCOL,
        array_info=present.info,
        held=tuple(present.held),
        next_seq=next_seq,
        t_mono_ns=time.monotonic_ns(),
        lost=present.lost.as_pairs(),
        t_ns_first=_t_ns_first(present),
        scene=options.rig.scene.model_dump(mode="json"),
        emulated=options.rig.emulated,
        calibration=options.calibration,
        calibration_problem=options.calibration_problem,
        earlier=tuple(_earlier(stream) for stream in earlier),
        has_more=len(earlier) < len(others),
    )


def _t_ns_first(stream: NodeStream) -> int:
    journal = stream.journal
    return (journal.t_ns_near(0, newest=False) if journal is not None else None) or 0


def _earlier(stream: NodeStream) -> EarlierStream:
    return EarlierStream(
        array_info=stream.info,
        held=tuple(stream.held),
        next_seq=stream.next_seq,
        lost=stream.lost.as_pairs(),
        unsynced_tail_max=stream.notes.unsynced_tail_max,
        missed_slots=stream.missed_slots,
        t_ns_first=_t_ns_first(stream),
    )


PROBE_EVERY_S = 10.0
"""Interval of clock measurements, in which two crystals of 50 ppm drift by 1 ms at most."""


class ClockProbes:
    """Measurement of the clock offset on one connection.

    Args:
        socket: the connection.
        utc_offset_ns: `t_ns` minus `t_mono_ns` of the present stream.
    """

    def __init__(self, socket: ClientConnection, utc_offset_ns: int) -> None:
        self._socket = socket
        self._utc_offset_ns = utc_offset_ns
        self._answers: asyncio.Queue[Probe] = asyncio.Queue(PROBES)

    def answered(self, probe: Probe) -> None:
        """Queue the server's answer to a probe."""
        with suppress(asyncio.QueueFull):
            self._answers.put_nowait(probe)

    async def run(self) -> None:
        """Measure the offset at intervals and send it to the server, except failed measurements."""
        number = 0
        while True:
            best: ClockRow | None = None
            for _ in range(PROBES):
                number += 1
                sent_ns = time.monotonic_ns()
                await self._socket.send(say(Probe(id=number)))
                answer = await self._answer_to(number)
                came_ns = time.monotonic_ns()
                if answer is None or answer.server_t_ns is None:
                    continue
                middle_ns = (sent_ns + came_ns) // 2
                half_ns = (came_ns - sent_ns + 1) // 2
                if best is None or half_ns < best.uncertainty_ns:
                    best = ClockRow(
                        t_mono_ns=middle_ns,
                        server_minus_node_ns=answer.server_t_ns - middle_ns - self._utc_offset_ns,
                        uncertainty_ns=half_ns,
                    )
            if best is not None:
                await self._socket.send(say(best))
            await asyncio.sleep(PROBE_EVERY_S)

    async def _answer_to(self, number: int) -> Probe | None:
        with suppress(TimeoutError):
            async with asyncio.timeout(SILENCE_S):
                while True:
                    answer = await self._answers.get()
                    if answer.id == number:  # not a late one
                        return answer
        return None
