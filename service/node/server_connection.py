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
from service.node.frame_sender import EstablishedLink, FrameSender
from service.node.options import NodeOptions
from service.protocol import (
    LINK_TIMEOUT_S,
    PROBES_PER_MEASUREMENT,
    PROTOCOL,
    SERVER_MESSAGES,
    SUBPROTOCOL,
    Ack,
    Challenge,
    ClockProbe,
    ClockSample,
    EarlierStream,
    Hello,
    LossReport,
    RetentionMessage,
    ServerMessage,
    Welcome,
    encode_message,
    parse_message,
    strip_text_crc,
)
from storage.journal.node.journal import NodeJournal
from storage.journal.node.stream import NodeStream

STATUS_EVERY_S = 1.0
"""Interval of status messages."""


class ServerConnection:
    """Connection to a server: receives its messages, sends frames, status and clock probes.

    Args:
        link: connection after its handshake.
        on_acknowledged: called whenever the server has acknowledged frames.
    """

    def __init__(self, link: EstablishedLink, on_acknowledged: Callable[[], None]) -> None:
        self._link = link
        self._on_acknowledged = on_acknowledged
        self._sender = FrameSender(link)
        self._probes = ClockOffsetMeter(link.socket, link.hello.array_info.utc_offset_ns)
        self._forward_retention_request(link.welcome.retention)

    async def exchange_messages(self, new_stream_began: asyncio.Event) -> None:
        """Exchange messages until the connection breaks or `new_stream_began` is set.

        Raises:
            LinkError, OSError, WebSocketException: the connection is broken.
        """
        await _run_until_first_ends(
            self._receive(),
            self._sender.send_frames(),
            self._sender.ping_until_timeout(),
            self._probes.measure_forever(),
            self._send_status(),
            new_stream_began.wait(),
        )

    async def _receive(self) -> None:
        while True:
            message = parse_server_message(await self._link.socket.recv())
            match message:
                case Ack(stream_id=stream_id, seq_first=first, seq_last=last):
                    stream = self._link.callbacks.get_streams().get(stream_id)
                    self._on_acknowledged()
                    # Acknowledged future frames cannot exist: do not delete them later.
                    if stream is not None and first < stream.next_seq:
                        last = min(last, stream.next_seq - 1)
                        stream.record_acknowledgement(self._link.server_id, first, last)
                case RetentionMessage():
                    self._forward_retention_request(message)
                case ClockProbe():
                    self._probes.add_answer(message)
                case Challenge() | Welcome():
                    raise LinkError(f"the server sent {message.type} a second time")

    def _forward_retention_request(self, wanted: RetentionMessage) -> None:
        earlier = (stream.array_info.stream_id for stream in self._link.hello.earlier)
        known = (*earlier, self._link.hello.array_info.stream_id)
        self._link.callbacks.on_retention_request(self._link.server_id, wanted, known)

    async def _send_status(self) -> None:
        reported = {stream.array_info.stream_id: stream.lost for stream in self._link.hello.earlier}
        reported[self._link.hello.array_info.stream_id] = self._link.hello.lost
        while True:
            for stream_id, stream in self._link.callbacks.get_streams().items():
                lost = stream.lost.to_pairs()
                if stream_id in reported and lost != reported[stream_id]:
                    reported[stream_id] = lost
                    await self._link.socket.send(
                        encode_message(LossReport(stream_id=stream_id, lost=lost))
                    )
            await self._link.socket.send(
                encode_message(self._link.callbacks.make_status(self._sender.backlog.frame_count))
            )
            await asyncio.sleep(STATUS_EVERY_S)


def parse_server_message(message: str | bytes) -> ServerMessage:
    """Verify and parse a message of a server.

    Raises:
        LinkError: it is no valid message of the protocol.
    """
    try:
        return parse_message(SERVER_MESSAGES, strip_text_crc(message))
    except LinkError as error:
        raise LinkError(
            f"the server sent an invalid message: {error}",
            expected=f"{SUBPROTOCOL} messages",
            remedy="Check that it is a foottile server of the same version",
        ) from error


async def _run_until_first_ends(*work: Coroutine[Any, Any, object]) -> None:
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


def make_hello(options: NodeOptions, journal: NodeJournal, present_stream: NodeStream) -> Hello:
    """Compose a node's hello; reads the journals of earlier streams.

    Raises:
        StorageError: a journal cannot be read.
    """
    next_seq = present_stream.next_seq  # before `held`, which may grow meanwhile
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


CLOCK_INTERVAL_S = 10.0
"""Interval of clock measurements, in which two crystals of 50 ppm drift by 1 ms at most."""


class ClockOffsetMeter:
    """Measurement of the clock offset on one connection.

    Args:
        socket: the connection.
        utc_offset_ns: `t_ns` minus `t_mono_ns` of the present stream.
    """

    def __init__(self, socket: ClientConnection, utc_offset_ns: int) -> None:
        self._socket = socket
        self._utc_offset_ns = utc_offset_ns
        self._answers: asyncio.Queue[ClockProbe] = asyncio.Queue(PROBES_PER_MEASUREMENT)

    def add_answer(self, probe: ClockProbe) -> None:
        """Queue the server's answer to a probe."""
        with suppress(asyncio.QueueFull):
            self._answers.put_nowait(probe)

    async def measure_forever(self) -> None:
        """Measure the offset at intervals and send it to the server, except failed measurements."""
        number = 0
        while True:
            best: ClockSample | None = None
            for _ in range(PROBES_PER_MEASUREMENT):
                number += 1
                sent_ns = time.monotonic_ns()
                await self._socket.send(encode_message(ClockProbe(id=number)))
                answer = await self._wait_for_answer(number)
                came_ns = time.monotonic_ns()
                if answer is None or answer.server_t_ns is None:
                    continue
                middle_ns = (sent_ns + came_ns) // 2
                half_ns = (came_ns - sent_ns + 1) // 2
                if best is None or half_ns < best.uncertainty_ns:
                    best = ClockSample(
                        t_mono_ns=middle_ns,
                        server_minus_node_ns=answer.server_t_ns - middle_ns - self._utc_offset_ns,
                        uncertainty_ns=half_ns,
                    )
            if best is not None:
                await self._socket.send(encode_message(best))
            await asyncio.sleep(CLOCK_INTERVAL_S)

    async def _wait_for_answer(self, number: int) -> ClockProbe | None:
        with suppress(TimeoutError):
            async with asyncio.timeout(LINK_TIMEOUT_S):
                while True:
                    answer = await self._answers.get()
                    if answer.id == number:  # not a late one
                        return answer
        return None
