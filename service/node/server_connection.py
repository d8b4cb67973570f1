"""Connection of a node to a server after the handshake: messages in both directions.

The offset between the clocks of node and server is measured from the beginning.

While a link is down an attempt waits for its timeout, and the kernel repeats its first packet after
one second, three, seven: it would detect a returned link only seconds later. So a new attempt
begins each half second beside the waiting ones, and the first success wins. Earlier attempts go on,
for slow links.
"""

from __future__ import annotations

import asyncio
import random
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from urllib.parse import urlsplit, urlunsplit

from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed

from devices.errors import LinkError, UsageError
from foottile.connection import UpgradeRejection, explain_foreign_response, explain_tls
from foottile.environment import decode_zone
from service.node.frame_sender import EstablishedLink, FrameSender
from service.protocol.codec import (
    CloseConnection,
    LinkCloseCode,
    decode_link_message,
    encode_link_message,
    run_until_first_ends,
)
from service.protocol.link import (
    INGEST_PATH,
    LINK_TIMEOUT_S,
    PROBES_PER_MEASUREMENT,
    SERVER_MESSAGES,
    SUBPROTOCOL,
    Ack,
    Challenge,
    ClockProbe,
    ClockSample,
    LossReport,
    RetentionMessage,
    ServerMessage,
    Welcome,
)

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
        await run_until_first_ends(
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
                    raise LinkError(
                        f"the server sent {message.type!r} here", expected="ack, retain or probe"
                    )

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
                        encode_link_message(LossReport(stream_id=stream_id, lost=lost))
                    )
            await self._link.socket.send(
                encode_link_message(
                    self._link.callbacks.make_status(self._sender.backlog.frame_count)
                )
            )
            await asyncio.sleep(STATUS_EVERY_S)


def parse_server_message(message: str | bytes) -> ServerMessage:
    """Verify and parse a message of a server.

    Raises:
        LinkError: it is no valid message of the protocol.
    """
    try:
        return decode_link_message(SERVER_MESSAGES, message)
    except CloseConnection as error:
        raise LinkError(
            f"the server sent an invalid message: {error}",
            expected=f"{SUBPROTOCOL} messages",
            remedy="Check that it is a foottile server of the same version",
        ) from error


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
                await self._socket.send(encode_link_message(ClockProbe(id=number)))
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
                await self._socket.send(encode_link_message(best))
            await asyncio.sleep(CLOCK_INTERVAL_S)

    async def _wait_for_answer(self, number: int) -> ClockProbe | None:
        with suppress(TimeoutError):
            async with asyncio.timeout(LINK_TIMEOUT_S):
                while True:
                    answer = await self._answers.get()
                    if answer.id == number:  # not a late one
                        return answer
        return None


ATTEMPT_INTERVAL_S = 0.5
"""Interval of attempts, and so the longest delay after the link's return."""
CONNECT_TIMEOUT_S = 5.0
"""Timeout of all attempts; then the address is looked up again."""
_UNSENT_BYTES = 16 << 10
"""Limit of unsent bytes in the kernel: some messages of frames."""


def make_ingest_url(server: str) -> str:
    """Build the websocket address of a server's ingest.

    Raises:
        UsageError: `server` is no address.
    """
    expected = "one such as http://192.168.4.1:8000"
    try:
        parts = urlsplit(decode_zone(server))
        known = parts.hostname is not None and parts.port != 0
    except ValueError as error:
        raise UsageError(f"{server!r} is no server address", expected=expected) from error
    scheme = {"http": "ws", "https": "wss", "ws": "ws", "wss": "wss"}.get(parts.scheme)
    if scheme is None or not known:
        raise UsageError(f"{server!r} is no server address", expected=expected)
    return urlunsplit((scheme, parts.netloc, parts.path.rstrip("/") + INGEST_PATH, "", ""))


async def connect_tcp(url: str) -> socket.socket:
    """Connect a TCP socket to a server, with an attempt each half second.

    Args:
        url: the server's websocket address.

    Raises:
        OSError: the server refuses, or does not answer in time.
    """
    parts = urlsplit(url)
    host, port = parts.hostname or "", parts.port or (443 if parts.scheme == "wss" else 80)
    loop = asyncio.get_running_loop()
    end_s = loop.time() + CONNECT_TIMEOUT_S
    attempts: set[asyncio.Task[socket.socket]] = set()
    refused: OSError | None = None
    try:
        while loop.time() < end_s and refused is None:
            attempts.add(asyncio.create_task(_connect_once(host, port)))
            done, _ = await asyncio.wait(
                attempts, timeout=ATTEMPT_INTERVAL_S, return_when=asyncio.FIRST_COMPLETED
            )
            for attempt in done:
                attempts.discard(attempt)
                error = attempt.exception()
                if error is None:
                    return attempt.result()
                if not isinstance(error, OSError):
                    raise error
                refused = error
    finally:
        for attempt in attempts:
            attempt.cancel()
        for left in await asyncio.gather(*attempts, return_exceptions=True):
            if isinstance(left, socket.socket):  # two attempts succeeded at once
                left.close()
    raise refused or TimeoutError(f"no answer for {CONNECT_TIMEOUT_S:g} s")


async def _connect_once(host: str, port: int) -> socket.socket:
    loop = asyncio.get_running_loop()
    error: OSError | None = None
    for family, kind, protocol, _, address in await loop.getaddrinfo(
        host, port, type=socket.SOCK_STREAM
    ):
        connection = socket.socket(family, kind, protocol)
        try:
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if hasattr(socket, "TCP_NOTSENT_LOWAT"):
                # Newer frames cannot overtake bytes in the kernel's buffer.
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT_BYTES)
            await loop.sock_connect(connection, address)
        except OSError as refused:
            connection.close()
            error = refused
        except BaseException:
            connection.close()
            raise
        else:
            return connection
    raise error or OSError(f"{host} has no address")


BACKOFF_S = (0.1, 0.5)
"""Shortest and longest delay while the server is unreachable: live data return within a second."""
REFUSED_BACKOFF_S = (0.2, 5.0)
"""Shortest and longest delay while the server refuses the node."""


class ReconnectBackoff:
    """Exponential backoff with jitter between connections."""

    def __init__(self) -> None:
        self._bounds = BACKOFF_S
        self._wait_s = 0.0

    def reset(self) -> None:
        """Reset after acknowledged frames.

        A welcome is not enough: a node whose frames are refused would reconnect at once.
        """
        self._bounds, self._wait_s = BACKOFF_S, 0.0

    def set_delays_for(self, error: Exception) -> None:
        """Choose the delays by the error that ended an attempt or a connection."""
        bounds = REFUSED_BACKOFF_S if _is_refusal(error) else BACKOFF_S
        if bounds != self._bounds:
            self._bounds, self._wait_s = bounds, bounds[0]

    def next_delay_s(self) -> float:
        """Return the next delay: twice the previous one, with jitter so that nodes spread."""
        least, most = self._bounds
        self._wait_s = min(max(2.0 * self._wait_s, least), most)
        return self._wait_s * random.uniform(0.5, 1.0)  # noqa: S311  # no secret


def _is_refusal(error: BaseException) -> bool:
    if isinstance(error, ConnectionClosed):
        # A restarting server will be back, and damaged messages are sent again.
        soon = (LinkCloseCode.RESTART, LinkCloseCode.MALFORMED)
        return error.rcvd is not None and error.rcvd.code not in soon
    return isinstance(error, UpgradeRejection)


def explain_connection_error(error: Exception, url: str = "") -> str:
    """Explain in words why the connection to an address failed."""
    if isinstance(error, ConnectionClosed) and error.rcvd is not None:
        return error.rcvd.reason or f"closed with code {error.rcvd.code}"
    if isinstance(error, UpgradeRejection):
        return _explain_refusal(error, url)
    return explain_tls(error) or str(error) or type(error).__name__


def _explain_refusal(error: UpgradeRejection, url: str) -> str:
    foreign_response = explain_foreign_response(url, error.status, error.headers)
    if foreign_response is not None:
        return foreign_response
    if error.status == HTTPStatus.UNAUTHORIZED:
        is_wrong = b"is not the server's token" in error.body
        what = (
            "FOOTTILE_TOKEN is not the server's token" if is_wrong else "the server wants its token"
        )
        return (
            f"{what}: set FOOTTILE_TOKEN to the one that `foottile serve` shows or keeps in a file"
        )
    return f"HTTP {error.status} {error.body.decode(errors='replace')[:300]}".strip()
