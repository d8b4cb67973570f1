"""Flooders of small frames, as a program of its own that imports next to nothing.

    python flooder.py PORT KIND

They connect again as soon as they are closed, until standard input ends. It prints a line when they
begin, and how many connections were closed for too many messages, and how many refused.
"""

# ruff: noqa: T201  # a command prints

from __future__ import annotations

import socket
import sys
import time
from collections import Counter
from contextlib import suppress
from threading import Event, Thread

FLOODERS = 8
RATE_BYTES_S = 360_000
"""Of one flooder; one alone stopped the server."""
_STEP_S = 0.02
_MASK = bytes(4)
_PING, _FIRST, _FRAGMENT = (bytes([first, 0x80]) + _MASK for first in (0x89, 0x01, 0x00))
_TEXT = b'{"type":"ping","t_ms":1}'
_MESSAGE = b"\x81" + bytes([0x80 | len(_TEXT)]) + _MASK + _TEXT
KINDS = {"pings": (b"", _PING), "fragments": (_FIRST, _FRAGMENT), "messages": (b"", _MESSAGE)}
"""What a flooder sends once, and then again and again."""
_UPGRADE = (
    b"GET /api/v1/live?rate_hz=5 HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\n"
    b"Upgrade: websocket\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    b"Sec-WebSocket-Version: 13\r\n\r\n"
)
_CLOSES = {(1008).to_bytes(2) + b"this client sends too many": "closed"}
_CLOSES[(1013).to_bytes(2) + b"There are too many"] = "refused"


def _flood(port: int, kind: str, stop: Event, ends: Counter[str]) -> None:
    first, unit = KINDS[kind]
    content = unit * (int(_STEP_S * RATE_BYTES_S) // len(unit))
    while not stop.is_set():
        received = b""
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 5.0) as one:
            one.sendall(_UPGRADE)
            received = one.recv(4096)
            one.sendall(first)
            while not stop.is_set() and not any(each in received for each in _CLOSES):
                one.settimeout(5.0)
                one.sendall(content)
                end_s = time.monotonic() + _STEP_S
                with suppress(TimeoutError):
                    while (left_s := end_s - time.monotonic()) > 0:
                        one.settimeout(left_s)
                        piece = one.recv(65536)
                        if not piece:
                            raise ConnectionResetError
                        received = received[-200:] + piece
        ends.update(word for close, word in _CLOSES.items() if close in received)


def main() -> None:
    """Flood until standard input ends."""
    port, kind = int(sys.argv[1]), sys.argv[2]
    stop, ends = Event(), Counter[str]()
    threads = [Thread(target=_flood, args=(port, kind, stop, ends)) for _ in range(FLOODERS)]
    for thread in threads:
        thread.start()
    print("flooding", flush=True)
    sys.stdin.read()
    stop.set()
    for thread in threads:
        thread.join()
    print(ends["closed"], ends["refused"], flush=True)


if __name__ == "__main__":
    main()
