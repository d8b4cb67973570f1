"""Those who have no key and want in: many, slow, endless, and without end."""

from __future__ import annotations

import re
import resource
import selectors
import socket
import time
from contextlib import ExitStack, suppress
from random import Random

from service.protocol.codec import LinkCloseCode
from service.protocol.live import LIVE_PATH
from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.stage import Served, asked, recording
from tests.waiting import until

HEAD = b"GET /api/v1/health HTTP/1.1\r\nHost: localhost\r\n"
ANSWER_WITHIN_S = 2.0
_TEXT, _CLOSE = b"\x81", b"\x88"
"""How a websocket's frames begin."""
CHUNK = b"X-Filler: " + b"y" * (64 << 10) + b"\r\n"


def _want_files(n: int) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(max(soft, n), hard), hard))


@attack("connections that never finish their headers", tries=300, soak_tries=2000)
def half_open(play: Play) -> Outcome:
    """Half-open connections, all kept, against a server that may open 256 files.

    Meanwhile a node records and a screen watches. A try is one connection, with nothing, a byte or
    most of a request said. It fails if a new request is not answered within 2 s, if the recording
    lacks a frame, if node or screen are turned out, or if the log speaks of a bug or has more than
    ten lines.
    """
    outcome = Outcome()
    _want_files(play.tries + 512)
    with Served(play.folder, outcome=outcome, files_max=256) as served, ExitStack() as storm:
        lines, slowest_s, most_files = len(served.log), 0.0, 0
        connections: list[socket.socket] = []
        with recording(served, outcome):
            before_mb = served.rss_mb
            for number in range(play.tries):
                one = storm.enter_context(socket.socket())
                connections.append(one)
                one.settimeout(10.0)
                one.connect(("127.0.0.1", served.port))
                with suppress(OSError):  # it may be out already
                    one.sendall(play.random.choice([b"", b"G", HEAD, HEAD + b"X-Slow: "]))
                if number % 50 == 49:
                    began_s = time.monotonic()
                    answer = asked(served.port, HEAD + b"Connection: close\r\n\r\n")
                    slowest_s = max(slowest_s, time.monotonic() - began_s)
                    most_files = max(most_files, served.files)
                    if not answer.startswith(b"HTTP/1.1 200 "):
                        outcome.failures.append(f"not answered among {number + 1}: {answer[:80]!r}")
            grown_mb = served.rss_mb - before_mb
            for one in connections:
                outcome.saw("still waits" if _is_open(one) else "closed while others came")
        outcome.figures |= {
            "slowest answer meanwhile": f"{slowest_s:.2f} s",
            "descriptors at most": f"{most_files} of 256",
            "RSS of the server": f"{grown_mb:+.1f} MB",
            "lines in the log": str(len(served.log) - lines),
        }
        if slowest_s > ANSWER_WITHIN_S:
            outcome.failures.append(f"an answer took {slowest_s:.2f} s")
        if len(served.log) - lines > 10:
            outcome.failures.append(f"the log: {served.log[lines:][:20]}")
    return outcome


def _is_open(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return True
    except OSError:
        pass
    return False


@attack("screens at once, of which most do not read", tries=60, soak_tries=1000)
def many_screens(play: Play) -> Outcome:
    """As many screens as tries, with the bound raised for them; a third of them reads.

    Meanwhile a node records. Those admitted may lag or be let go. It fails if one is refused below
    the bound, if one beyond it is let in, if the recording lacks a frame or its node is cut off.
    """
    outcome = Outcome()
    _want_files(2 * play.tries + 512)
    bound = play.tries + 8  # the screen that watches before, and requests
    options = (
        *("--max-connections", bound, "--max-connections-per-address", bound),
        *(
            "--max-messages-per-s-per-address",
            10 * bound,
            "--max-messages-per-s-in-all",
            10 * bound,
        ),
    )
    with (
        Served(play.folder, "serve", *options, outcome=outcome) as served,
        ExitStack() as screens,
        recording(served, outcome),
    ):
        before_mb = served.rss_mb
        readers = selectors.DefaultSelector()
        for number in range(play.tries):
            one = screens.enter_context(_screen(served.port))
            if (answer := _answer_to(one)) != "admitted":
                outcome.failed(f"screen {number + 1} was {answer}")
                continue
            outcome.saw("admitted")
            if number % 3 == 0:
                readers.register(one, selectors.EVENT_READ)
        end_s = time.monotonic() + min(20.0, 2.0 + play.tries / 50)
        received = 0
        while time.monotonic() < end_s:
            for key, _ in readers.select(0.2):
                with suppress(OSError):
                    received += len(key.fileobj.recv(1 << 20))  # type: ignore[union-attr]  # a socket
        readers.close()
        outcome.figures["received by those that read"] = f"{received / 1e6:.1f} MB"
        outcome.figures["RSS of the server"] = f"{served.rss_mb - before_mb:+.1f} MB"
        beyond = [screens.enter_context(_screen(served.port)) for _ in range(16)]
        refused = [_answer_to(each) for each in beyond].count("refused")
        outcome.figures["refused beyond the bound"] = f"{refused} of {len(beyond)}"
        if refused < len(beyond) - 8:
            outcome.failures.append("screens beyond the bound were let in")
        screens.close()
        until(lambda: served.http.get("/health").status_code == 200)
    return outcome


def _screen(port: int) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=10.0)
    connection.sendall(
        f"GET {LIVE_PATH}?rate_hz=5 HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\n"
        "Upgrade: websocket\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
        "Sec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    return connection


def _answer_to(connection: socket.socket) -> str:
    """One who is refused is taken in as well, and told why: what tells is the first frame."""
    said = b""
    with suppress(OSError):
        while len(said.partition(b"\r\n\r\n")[2]) < 4 and (piece := connection.recv(4096)):
            said += piece
    head, _, frame = said.partition(b"\r\n\r\n")
    if b" 101 " in head and frame[:1] == _TEXT:  # hello
        return "admitted"
    if (
        b" 101 " in head
        and frame[:1] == _CLOSE
        and frame[2:4] == LinkCloseCode.TRY_LATER.to_bytes(2)
    ):
        return "refused"
    return f"answered with {said[:200]!r}"


@attack("requests that are too long, too slow or no requests", tries=8, soak_tries=600)
def malformed(play: Play) -> Outcome:
    """Endless headers and trailers (400 MB if they were taken), stopped bodies, garbage, pipelines.

    Meanwhile a node records and a screen watches. It fails if the server takes more than 4 MB of a
    request, keeps one open for more than 5 s beyond its time, answers what is no request with
    more than a 4xx, grows by more than 30 MB, if its log speaks of a bug, or if the recording
    suffers.
    """
    outcome = Outcome()
    options = ("--header-timeout-s", 1, "--body-timeout-s", 1, "--idle-timeout-s", 1)
    with Served(play.folder, "serve", *options, outcome=outcome) as served:
        most = 0
        with recording(served, outcome):
            before_mb = served.rss_mb
            while outcome.tries < play.tries:
                kind = _KINDS[outcome.tries % len(_KINDS)]
                began_s = time.monotonic()
                took, answer = _play(served.port, kind, play.random)
                took_s = time.monotonic() - began_s
                most = max(most, took)
                statuses = [found.decode() for found in re.findall(_STATUS, answer)]
                said = ", then ".join(dict.fromkeys(statuses)) or "closed"
                # What is asked before what is no request is answered, and nothing behind it.
                refusals = statuses[statuses.count("200") if kind == "pipeline" else 0 :]
                is_wrong = len(refusals) > 1 or any(each[0] != "4" for each in refusals)
                if is_wrong or took > 4 << 20 or took_s > 6.0:
                    outcome.failed(f"{kind}: {took} bytes in {took_s:.1f} s, {said}")
                else:
                    outcome.saw(f"{kind}: {said}")
            grown_mb = served.rss_mb - before_mb
        outcome.figures["most taken of a request"] = f"{most / 1e6:.2f} MB"
        outcome.figures["RSS of the server"] = f"{grown_mb:+.1f} MB"
        if grown_mb > 30:
            outcome.failures.append(f"the server has grown by {grown_mb:.1f} MB")
    return outcome


_KINDS = (
    *("many headers", "one header", "long address", "one trailer", "slow headers", "slow body"),
    *("garbage", "pipeline"),
)
_STATUS = re.compile(rb"HTTP/1\.1 ([0-9]{3}) ")
_HANGS_UP_S = 8.0
"""Longer than the server may keep it open, so that it shows."""


def _play(port: int, kind: str, random: Random) -> tuple[int, bytes]:
    """How many bytes were taken, and the answer."""
    with socket.create_connection(("127.0.0.1", port), timeout=5.0) as one:
        match kind:
            case "many headers":
                return _endless(one, HEAD, CHUNK)
            case "one header":
                return _endless(one, HEAD + b"X-Filler: ", b"y" * (64 << 10))
            case "long address":
                return _endless(one, b"GET /", b"y" * (64 << 10))
            case "one trailer":
                head = b"POST /api/v1/sessions HTTP/1.1\r\nHost: localhost\r\n"
                head += b"Transfer-Encoding: chunked\r\n\r\n0\r\nX: "
                return _endless(one, head, b"y" * (64 << 10))
            case "slow headers":
                return _slow(one, HEAD, b"X: y\r\n")
            case "slow body":
                head = b"POST /api/v1/sessions HTTP/1.1\r\nHost: localhost\r\n"
                return _slow(one, head + b"Content-Length: 60000\r\n\r\n", b" ")
            case "garbage":
                said = random.randbytes(random.randrange(1, 5000)) + b"\r\n\r\n"
                return 0, asked(port, said, _HANGS_UP_S)
            case _:
                many = (HEAD + b"\r\n") * 200 + random.randbytes(200) + b"\r\n\r\n"
                return len(many), asked(port, many, _HANGS_UP_S)


def _endless(one: socket.socket, head: bytes, piece: bytes) -> tuple[int, bytes]:
    taken = 0
    with suppress(OSError):
        taken += one.send(head)
        while taken < 400_000_000:
            taken += one.send(piece)
    return taken, _rest(one)


def _slow(one: socket.socket, head: bytes, piece: bytes) -> tuple[int, bytes]:
    taken = one.send(head)
    end_s = time.monotonic() + 6.5
    one.settimeout(0.1)
    with suppress(ConnectionResetError, BrokenPipeError):
        while time.monotonic() < end_s:
            taken += one.send(piece)
            with suppress(TimeoutError):
                return taken, one.recv(65536)
    return taken, b""


def _rest(one: socket.socket) -> bytes:
    with suppress(OSError):
        return one.recv(65536)
    return b""
