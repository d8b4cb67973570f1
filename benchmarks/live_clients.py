"""Every frame live to many programs: what is lost, how old it is, what it costs.

    python benchmarks/live_clients.py [--clients 10] [--tiles 8] [--rate-hz 544] [--seconds 30]
                                      [--columns grf_n,cop_x_m] [--stalled 1]

A real server (`foottile serve`) in a process of its own; a load process with one node, which
replays real messages at their pace (`replayed_nodes.py`); the clients in this process, each a
`foottile.connect_async(...).live(...)`, lossless; and some that connect and read nothing. The scene
is `rolling`: its whole ladder is estimated. CPU is the server's, of all its threads. Age is that of
the newest frame of a batch when a program has it, without the live look-ahead. A frame is dropped
if a client has not had it, although its numbers go beyond it.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import socket
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from replayed_nodes import played, run_load
from served import Server, cpu_s, served

import foottile
from service.estimation import LIVE_LAG_MS

SETTLE_S = 3.0
READY_S = 120.0
_UPGRADE = (
    "GET /api/v1/live?format=arrow HTTP/1.1\r\nHost: {host}\r\nConnection: Upgrade\r\n"
    "Upgrade: websocket\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    "Sec-WebSocket-Version: 13\r\n\r\n"
)


@dataclass
class Had:
    """What one client has had."""

    frames: int = 0
    first: int | None = None
    last: int = -1
    ages_ms: list[float] = field(default_factory=list)
    losses: int = 0

    @property
    def dropped(self) -> int:
        """Frames between the first and the last that it had not."""
        return 0 if self.first is None else self.last + 1 - self.first - self.frames


async def take(url: str, columns: list[str], had: Had) -> None:
    """Be one client, until cancelled."""
    async with (
        foottile.connect_async(url) as server,
        server.live("node00", columns, on_loss=lambda _: None) as live,
    ):
        async for batch in live:
            now_ns = time.time_ns()
            seq, t_ns = batch["seq"], batch["t_ns"]
            had.first = seq[0].as_py() if had.first is None else had.first
            had.last = seq[-1].as_py() or 0
            had.frames += len(batch)
            had.ages_ms.append((now_ns - (t_ns[-1].as_py() or 0)) * 1e-6 - LIVE_LAG_MS)
            had.losses = len(live.losses)


async def measured(server: Server, options: argparse.Namespace) -> dict[str, object]:
    """Clients for some seconds, after they have settled."""
    columns = [name for name in options.columns.split(",") if name]
    clients = [Had() for _ in range(options.clients)]
    tasks = [asyncio.create_task(take(server.url, columns, had)) for had in clients]
    at = urlsplit(server.url)
    stalled = [socket.create_connection((at.hostname, at.port)) for _ in range(options.stalled)]
    for each in stalled:
        each.sendall(_UPGRADE.format(host=at.netloc).encode())
    await asyncio.sleep(SETTLE_S)
    for had in clients:
        had.ages_ms.clear()
    begin_s, server_s, own_s = time.monotonic(), server.cpu_s, time.process_time()
    rss_mb = server.rss_mb
    await asyncio.sleep(options.seconds)
    took_s = time.monotonic() - begin_s
    found = {
        "server_cores": round((server.cpu_s - server_s) / took_s, 3),
        "clients_cores": round((time.process_time() - own_s) / took_s, 3),
        "rss_mb": [round(rss_mb, 1), round(server.rss_mb, 1)],
    }
    for task in tasks:
        task.cancel()
    ended = await asyncio.gather(*tasks, return_exceptions=True)
    for each in stalled:
        each.close()
    ages_ms = np.array([age_ms for had in clients for age_ms in had.ages_ms])
    quantiles = np.percentile(ages_ms, [50, 95, 99, 100]) if len(ages_ms) else np.full(4, np.nan)
    return found | {
        "frames": [had.frames for had in clients],
        "dropped": sum(had.dropped for had in clients),
        "said_lost": sum(had.losses for had in clients),
        "age_ms_p50_p95_p99_max": [round(float(q), 1) for q in quantiles],
        "errors": [repr(e) for e in ended if not isinstance(e, asyncio.CancelledError)],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clients", type=int, default=10)
    parser.add_argument("--stalled", type=int, default=1)
    parser.add_argument("--tiles", type=int, default=8)
    parser.add_argument("--rate-hz", type=float, default=544.0)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--columns", default="", help="default: all")
    options = parser.parse_args()
    load = played(options.tiles, options.rate_hz)
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as server:
        here, there = multiprocessing.Pipe()
        process = multiprocessing.get_context("spawn").Process(
            target=run_load, args=(load, 1, server.url, there)
        )
        process.start()
        end_s = time.monotonic() + READY_S
        while not any(node["connected"] and node["tare"] for node in server.nodes()):
            assert time.monotonic() < end_s, "the node does not come"
            time.sleep(0.2)
        assert process.pid is not None
        load_s, begin_s = cpu_s(process.pid), time.monotonic()
        found = asyncio.run(measured(server, options))
        load_cores = (cpu_s(process.pid) - load_s) / (time.monotonic() - begin_s)
        here.send("stop")
        sent = here.recv()
        process.join()
        found |= {"load_cores": round(load_cores, 3), "load_late_ms_p99": round(sent.late_ms, 1)}
    print(json.dumps(vars(options) | found, indent=1))


if __name__ == "__main__":
    main()
