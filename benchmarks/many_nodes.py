"""Many nodes on one server: what a frame costs, and how old it is on a screen.

    python benchmarks/many_nodes.py [--nodes 1 8 24] [--tiles 4] [--rate-hz 541] [--seconds 20]
                                    [--viewers 1] [--no-record]
    python benchmarks/many_nodes.py --soak [--seconds 1800] [--download-mb 2000]

A real server (`foottile serve`) in a process of its own; one load process with all nodes, which
replay real messages at their pace through the node's own link (`replayed_nodes.py`); screens at
60 Hz in this process. The scene is `rolling`: its whole ladder is estimated, live, and every node
is recorded. CPU is the server's, of all its threads. Age is that of the newest estimate in a
message when it is here, less the look-ahead: the wait for the batch, the link, the step and the
screen's tick are in it. A frame is lost if the server has not acknowledged it five seconds after
the last one was taken.

`--soak` is a long run of four nodes, with 20 screens and one who downloads a big sealed session
meanwhile, at so many megabytes a second as `--download-mb-s` says; 0: as fast as it goes. What is
downloaded has the size of a session, and is noise. At the end every session is stopped and sealed,
and its ledger counted.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import multiprocessing
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import big_download
import numpy as np
import websockets.asyncio.client
from replayed_nodes import DRAIN_S, Played, Sent, played, run_load
from served import Server, served

from service.estimation import LIVE_LAG_MS
from service.protocol.link import SUBPROTOCOL

RATE_HZ = {4: 541.0, 64: 64.0}
SCREEN_HZ = 60
SETTLE_S = 2.0
READY_S = 120.0
SOAK_NODES, SOAK_SCREENS, SOAK_S, LOOK_S = 4, 20, 1800.0, 60.0


@dataclass(frozen=True)
class Options:
    """What is asked for."""

    viewers: int = 1
    seconds: float = 20.0
    look_s: float = LOOK_S
    record: bool = True
    seal: bool = False
    download_mb: float = 0.0
    download_mb_s: float = 0.0
    upload_mb: float = 0.0


@dataclass
class Screen:
    """What one screen was told."""

    messages: int = 0
    dropped: int = 0
    unknown: int = 0
    """Messages without a force: nothing was estimated."""
    ages_ms: list[float] = field(default_factory=list)

    def take(self, text: str, *, looks: bool) -> None:
        """One message; only who `looks` reads it."""
        if text.startswith('{"type":"dropped"'):
            self.dropped += 1
        if not text.startswith('{"type":"frame"'):
            return
        self.messages += 1
        if looks:
            now_ns, message = time.time_ns(), json.loads(text)
            self.ages_ms.append((now_ns - message["t_ns"]) * 1e-6 - LIVE_LAG_MS)
            self.unknown += message["grf_lower_bound_n"] is None


@dataclass(frozen=True)
class Look:
    """What the server had done at an instant."""

    wall_s: float
    cpu_s: float
    frames: int
    rss_mb: float

    @classmethod
    def at(cls, server: Server) -> Look:
        """Now; what was overtaken, and is still to come, does not count."""
        frames = sum(
            (node["last_seq"] or 0) + 1 - node["backlog_frames"] - node["lost_frames"]
            for node in server.nodes()
        )
        return cls(time.monotonic(), server.cpu_s, frames, server.rss_mb)


class Load:
    """The process with all nodes."""

    def __init__(self, what: Played, count: int, url: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._control, theirs = context.Pipe()
        self._process = context.Process(
            target=run_load, args=(what, count, url, theirs), daemon=True
        )
        self._process.start()

    def stop(self) -> Sent:
        """End it, once everything was acknowledged or five seconds have passed."""
        self._control.send(None)
        sent: Sent = self._control.recv()
        self._process.join()
        return sent


@contextlib.asynccontextmanager
async def watched(url: str, viewers: int) -> AsyncIterator[list[Screen]]:
    """So many screens; the first one looks at what it is told."""
    screens = [Screen() for _ in range(viewers)]

    async def look(socket: Any, screen: Screen) -> None:
        async for text in socket:
            screen.take(text, looks=screen is screens[0])

    async with contextlib.AsyncExitStack() as stack:
        tasks = []
        for screen in screens:
            socket = await stack.enter_async_context(
                websockets.asyncio.client.connect(
                    f"{url.replace('http', 'ws')}/api/v1/live?rate_hz={SCREEN_HZ}",
                    proxy=None,
                    compression=None,
                    max_queue=None,
                    subprotocols=[websockets.Subprotocol(SUBPROTOCOL)],
                )
            )
            tasks.append(asyncio.create_task(look(socket, screen)))
        try:
            yield screens
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


@dataclass(frozen=True)
class Found:
    """What came of one number of nodes; the rows are one for each look."""

    rows: list[str]
    screens: list[Screen]
    sent: Sent
    lost: int
    sessions: list[dict[str, Any]]
    downloaded: str


def measure(what: Played, count: int, options: Options) -> Found:
    """So many nodes on a server of their own."""
    with tempfile.TemporaryDirectory(prefix="foottile-many-") as folder:
        big = (
            big_download.big_session(Path(folder), options.download_mb)
            if options.download_mb
            else None
        )
        with served(Path(folder)) as server:
            load = Load(what, count, server.url)
            end_s = time.monotonic() + READY_S
            while sum(node["tare"] is not None for node in server.nodes()) < count:
                assert time.monotonic() < end_s, "the nodes are not tared"
                time.sleep(0.2)
            sessions = server.record() if options.record else []
            rows, screens, downloaded = asyncio.run(_watch(server, count, what, options, big))
            if options.seal:
                # While frames come: a session ends when its stream has passed its stop.
                for session in sessions:
                    server.http.post(f"/sessions/{session}/stop")
                time.sleep(SETTLE_S)
            sent = load.stop()
            lost = sum(node["lost_frames"] for node in server.nodes())
            sealed = server.sealed(sessions) if options.seal else []
    return Found(rows, screens, sent, lost, sealed, downloaded)


async def _watch(
    server: Server, count: int, what: Played, options: Options, big: str | None
) -> tuple[list[str], list[Screen], str]:
    rows, downloading = [], None
    async with watched(server.url, options.viewers) as screens:
        await asyncio.sleep(SETTLE_S)
        for screen in screens:
            screen.messages = screen.dropped = 0
        if big is not None:
            url = f"{server.url}/api/v1{big}"
            downloading = await big_download.begun(url, options.download_mb_s, options.upload_mb)
        before = await asyncio.to_thread(Look.at, server)
        end_s = time.monotonic() + options.seconds
        while time.monotonic() < end_s:
            ages_ms = screens[0].ages_ms if screens else []
            ages_ms.clear()
            await asyncio.sleep(min(options.look_s, max(0.0, end_s - time.monotonic())))
            now = await asyncio.to_thread(Look.at, server)
            rows.append(row(count, what, before, now, ages_ms))
            print(rows[-1], flush=True)
            before = now
        downloaded = await big_download.ended(downloading) if downloading is not None else ""
    return rows, screens, downloaded


def row(count: int, what: Played, before: Look, now: Look, ages_ms: list[float]) -> str:
    """One line of the table."""
    wall_s, cpu_s = now.wall_s - before.wall_s, now.cpu_s - before.cpu_s
    frames = now.frames - before.frames
    due = count * what.info.nominal_rate_hz * wall_s
    p50, p99 = np.percentile(ages_ms, (50, 99)) if ages_ms else (np.nan, np.nan)
    return (
        f"| {count} | {100 * cpu_s / wall_s:.1f} | {1e6 * cpu_s / max(1, frames):.1f} | "
        f"{100 * frames / due:.1f} | {p50:.1f} | {p99:.1f} | {now.rss_mb:.0f} |"
    )


HEAD = (
    "| nodes | server, % of a core | CPU us a frame | taken in, % of frames due | "
    "age p50 ms | p99 ms | RSS MB |\n|--:|--:|--:|--:|--:|--:|--:|"
)


def remarks(found: Found) -> str:
    """What is not in the table."""
    sent = found.sent
    told = [screen.messages for screen in found.screens]
    unknown = sum(screen.unknown for screen in found.screens)
    said = [
        f"of {sent.taken} frames {found.lost} are lost, "
        f"{sent.taken - sent.acknowledged} not acknowledged {DRAIN_S:g} s after the last",
        f"screens were told {min(told)} to {max(told)} times, and dropped "
        f"{sum(screen.dropped for screen in found.screens)} times"
        if told
        else "",
        f"{unknown} messages without a force" if unknown else "",
        f"the load gave messages to its links {sent.late_ms:.1f} ms late (p99)",
        *(f"links said {n} times: {text}" for text, n in Counter(sent.said).items()),
        found.downloaded,
    ]
    for session in found.sessions:
        said.append(
            f"session of {session['frames']} frames: "
            f"{'complete' if session['complete'] is True else 'NOT COMPLETE'}"
        )
    return "".join(f"  {text}\n" for text in said if text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--nodes", type=int, nargs="+")
    parser.add_argument("--tiles", type=int, default=4)
    parser.add_argument("--rate-hz", type=float, help="541 for four tiles, 64 for 64")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--viewers", type=int)
    parser.add_argument("--record", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--soak", action="store_true")
    parser.add_argument("--download-mb", type=float)
    parser.add_argument("--download-mb-s", type=float, default=10.0)
    parser.add_argument("--upload-mb", type=float, default=0.0, help="add a film to a session")
    a = parser.parse_args()
    rate_hz = a.rate_hz or RATE_HZ.get(a.tiles) or parser.error("say --rate-hz for so many tiles")
    seconds = a.seconds or (SOAK_S if a.soak else 20.0)
    options = Options(
        viewers=(SOAK_SCREENS if a.soak else 1) if a.viewers is None else a.viewers,
        seconds=seconds,
        look_s=LOOK_S if a.soak else seconds,
        record=a.record,
        seal=a.soak and a.record,
        download_mb=(2000.0 if a.soak else float(a.upload_mb > 0))
        if a.download_mb is None
        else a.download_mb,
        upload_mb=a.upload_mb,
        download_mb_s=a.download_mb_s,
    )
    what = played(a.tiles, rate_hz)
    print(
        f"{a.tiles} tiles at {rate_hz:g} Hz, {what.frames_a_batch:.1f} frames a message, "
        f"{options.viewers} screens\n\n{HEAD}",
        flush=True,
    )
    found = [measure(what, n, options) for n in a.nodes or ([SOAK_NODES] if a.soak else [1, 8, 24])]
    print()
    for n, each in zip(a.nodes or ([SOAK_NODES] if a.soak else [1, 8, 24]), found, strict=True):
        print(f"{n} nodes:\n{remarks(each)}", end="")


if __name__ == "__main__":
    main()
