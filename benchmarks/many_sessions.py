"""What many sealed sessions cost a server: `python benchmarks/many_sessions.py [N ...]`.

Of a data folder with N sealed sessions and one that is recording, in CPU time of this process: the
start, a tick with a screen looking on, as share of a core, and listing all of them page by page.
A walk over all sessions would show as a tick that grows with N, and a page that does.
"""

from __future__ import annotations

import asyncio
import statistics
import sys
import tempfile
import time
from pathlib import Path

from service.api.routes.recordings.sessions import list_sessions
from service.server.server import TICK_S, Server
from storage.documents import write_checksummed_json
from storage.sessions.folder import Ledger, Part, PartLedger, Session

ROUNDS = 7
TICKS = 50
PAGE = 100
BOOT = "0" * 32


def sealed(number: int) -> Session:
    part = PartLedger(
        stream_id=BOOT,
        seq_first=0,
        seq_last=9,
        recorded=10,
        lost={},
        pending=0,
        max_lost_tail_frames=0,
    )
    return Session(
        id=f"20261122T000000Z-{number:06x}",
        name=f"walk {number}",
        node="left",
        state="sealed" if number else "recording",
        started_t_ns=10**18 + number,
        stopped_t_ns=10**18 + number + 10**10 if number else None,
        parts=(Part(stream_id=BOOT, seq_first=0, seq_last=9 if number else None),),
        scene="mud",
        ledger=Ledger(complete=True, lossy=False, missed_slots=0, parts=(part,))
        if number
        else None,
        frames=10,
        duration_s=10.0,
    )


def fill(data: Path, n: int) -> None:
    for number in range(n + 1):
        session = sealed(number)
        folder = data / "sessions" / session.id
        folder.mkdir(parents=True)
        write_checksummed_json(folder / "session.json", session.model_dump_json().encode())


class Looking:
    """A screen that takes everything at once."""

    is_writable = True

    def write_framed_unless_closed(self, framed: bytes) -> None:
        """Forget it."""


def tick(server: Server, is_slow: bool) -> None:
    """What `Server.run` does at every tick, and at every fifth, of what looks at sessions."""
    server.recorder.advance_unsealed_sessions()
    server.recorder.make_retention_request("left")
    server._notify_progress()  # noqa: SLF001  # the loop that calls it sleeps
    if is_slow:
        server._send_heartbeat()  # noqa: SLF001  # likewise


async def listed(server: Server) -> int:
    cursor, n = None, 0
    while True:
        page = await list_sessions(server, cursor=cursor, limit=PAGE, q=None)
        n += len(page.items)
        cursor = page.next_cursor
        if cursor is None:
            return n


async def measure(data: Path, n: int) -> tuple[float, float, float]:
    began_s = time.process_time()
    server = Server(data)
    start_s = time.process_time() - began_s
    ticks_s, lists_s = [], []
    screen = server.broadcaster.subscribe(Looking(), 60.0)
    for _ in range(ROUNDS):
        began_s = time.process_time()
        for number in range(TICKS):
            tick(server, number % 5 == 0)
        ticks_s.append((time.process_time() - began_s) / TICKS)
        began_s = time.process_time()
        assert await listed(server) == n + 1
        lists_s.append(time.process_time() - began_s)
    server.broadcaster.unsubscribe(screen)
    await server.close()
    return start_s, statistics.median(ticks_s), statistics.median(lists_s)


def main() -> None:
    print("| sessions | start s | tick, % of a core | all listed s | us a session |")
    print("|--:|--:|--:|--:|--:|")
    for n in [int(text) for text in sys.argv[1:]] or [1000, 10_000]:
        with tempfile.TemporaryDirectory() as folder:
            fill(Path(folder), n)
            start_s, tick_s, list_s = asyncio.run(measure(Path(folder), n))
        share = 100 * tick_s / TICK_S
        print(f"| {n} | {start_s:.2f} | {share:.2f} | {list_s:.2f} | {1e6 * list_s / n:.0f} |")


if __name__ == "__main__":
    main()
