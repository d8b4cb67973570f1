"""A link that goes away and comes back: `python benchmarks/link_cut.py [--seconds 60]`.

Server and node run as processes of their own, with a proxy between them that lets nothing through
for a while and then everything again, or only so many bytes a second. Measured: how long after the
link's return the page has a frame that was taken after it, and how long until the server has the
last frame of the backlog. The backlog's bytes over the link's spare bandwidth is what no sender can
be quicker than; it stands beside. A session and a client of every frame run meanwhile; both have to
be complete. The server's CPU time is that from the link's return until the client has caught up.
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from served import COMMAND, Server, api_of, served
from websockets.sync.client import connect

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.faults.proxy import Proxy, Quality

RATES = (None, 400_000.0, 100_000.0)
"""Bytes a second of the link: as fast as it goes; Wi-Fi at its edge; twice what the frames need."""


def main() -> None:
    parser = argparse.ArgumentParser(description="A link that goes away and comes back.")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of each cut")
    parser.add_argument("--rate", type=float, help="one cut only: silent, at this many bytes/s")
    parser.add_argument("--out", type=Path, help="write a report in markdown")
    arguments = parser.parse_args()
    rows = []
    for how in ("silent", "reset") if arguments.rate is None else ("silent",):
        for rate in RATES if arguments.rate is None else (arguments.rate,):
            rows.append(cut(how, rate, arguments.seconds))
            print(rows[-1], flush=True)
    text = report(rows, arguments.seconds)
    print(text)
    if arguments.out is not None:
        arguments.out.write_text(text)


def cut(how: str, rate: float | None, seconds: float) -> dict[str, Any]:
    """One cut; what was measured."""
    with (
        tempfile.TemporaryDirectory() as folder,
        served(Path(folder) / "data") as server,
        Proxy(int(server.url.rsplit(":", 1)[1])) as proxy,
    ):
        proxy.quality = Quality(bytes_per_s=rate)
        node = subprocess.Popen(
            [
                *(*COMMAND, "node", "--scene=standing", "--name=foot"),
                f"--server=http://127.0.0.1:{proxy.port}",
                f"--journal={folder}/node",
            ],
            stderr=subprocess.DEVNULL,
        )
        try:
            return measure(server, proxy, how, rate, seconds, Path(folder))
        finally:
            node.terminate()
            node.wait(20)


def measure(
    server: Server, proxy: Proxy, how: str, rate: float | None, seconds: float, folder: Path
) -> dict[str, Any]:
    url = server.url
    with api_of(url) as api:

        def node() -> dict[str, Any]:
            found: dict[str, Any] = api.get("/nodes/foot").json()
            return found

        while api.get("/nodes/foot").status_code != 200 or not node()["last_seq"]:
            time.sleep(0.1)
        time.sleep(2.0)
        session = api.post("/sessions", json={"node": "foot", "name": "cut"}).json()
        client_csv = folder / "frames.csv"
        with client_csv.open("w") as file:
            client = subprocess.Popen(
                [*COMMAND, "stream", "foot", "--columns=seq,grf_n", f"--server={url}"], stdout=file
            )
        while last_seq_of(client_csv) is None:
            time.sleep(0.1)
        time.sleep(2.0)
        with connect(url.replace("http", "ws") + "/api/v1/live", compression=None) as live:
            (proxy.black_hole if how == "silent" else proxy.cut)()
            end_s = time.monotonic() + seconds
            while time.monotonic() < end_s:
                try:
                    live.recv(timeout=max(0.0, end_s - time.monotonic()))
                except TimeoutError:
                    break
            back_ns, back_s, cpu_s = time.time_ns(), time.monotonic(), server.cpu_s
            proxy.mend()
            while True:
                message = json.loads(live.recv(timeout=30.0))
                if message["type"] == "frame" and message["t_ns"] >= back_ns:
                    break
            picture_s = time.monotonic() - back_s
            missing_from = message["seq"]
        frames_hz = node()["nominal_rate_hz"]
        backlog_frames = round(frames_hz * seconds)
        while True:
            ledger = api.get(f"/sessions/{session['id']}/ledger").json()
            part = ledger["parts"][0]
            if not part["pending"] and part["seq_last"] >= missing_from:
                break
            if time.monotonic() - back_s > 20.0 * seconds + 120.0:
                break
            time.sleep(0.05)
        backlog_s = time.monotonic() - back_s
        while (last_seq_of(client_csv) or 0) < missing_from and time.monotonic() - back_s < 600.0:
            time.sleep(0.05)
        cpu_s = server.cpu_s - cpu_s
        client.terminate()
        client.wait(20)
        numbers = [int(line.split(",")[0]) for line in client_csv.read_text().splitlines()[1:-1]]
        written = sum(path.stat().st_size for path in folder.glob("node/journal/*/*/*.arrows"))
        frame_bytes = written / node()["last_seq"]
        spare = None if rate is None else rate - frames_hz * frame_bytes
        api.post(f"/sessions/{session['id']}/stop")
        for _ in range(200):
            sealed = api.get(f"/sessions/{session['id']}").json()
            if sealed["state"] == "sealed":
                break
            time.sleep(0.1)
        return {
            "how": how,
            "rate": rate,
            "picture_s": picture_s,
            "backlog_frames": backlog_frames,
            "backlog_s": backlog_s,
            "least_s": None if spare is None else backlog_frames * frame_bytes / spare,
            "state": sealed["state"],
            "complete": sealed["complete"],
            "frames": sealed["frames"],
            "client_misses": sum(b != a + 1 for a, b in itertools.pairwise(numbers)),
            "cpu_s": cpu_s,
        }


def last_seq_of(client_csv: Path) -> int | None:
    """The newest number in the client's table, which may end within a line."""
    with client_csv.open("rb") as file:
        file.seek(max(0, client_csv.stat().st_size - 200))
        lines = file.read().decode().splitlines()[1:-1]
    return int(lines[-1].split(",")[0]) if lines else None


def report(rows: list[dict[str, Any]], seconds: float) -> str:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    lines = [
        f"# A link that is away for {seconds:g} s",
        "",
        f"`python benchmarks/link_cut.py --seconds {seconds:g}`, "
        f"{datetime.now(UTC):%Y-%m-%d}, commit {commit}, {platform.machine()}, "
        "an emulated foot of 4 tiles, server and node on one machine with a proxy between.",
        "",
        "A silent link lets nothing through and says nothing, as when somebody walks out of reach; "
        "a reset one ends every connection at once. Live picture: from the link's return to a "
        "frame on a screen that was taken after it; it contains the batch (25 ms), the estimator's "
        "look-ahead (10 ms) and the pacing of messages (33 ms). Least: the backlog's bytes over "
        "what the link has to spare. Gaps: jumps in the numbers that a client of every frame "
        "received. CPU: the server's, from the link's return until that client has caught up.",
        "",
        "| link | bytes/s | live picture back, s | backlog, frames | complete after, s | least, s "
        "| session | gaps of the client | server's CPU, s |",
        "|---|--:|--:|--:|--:|--:|---|--:|--:|",
    ]
    for row in rows:
        rate = "unlimited" if row["rate"] is None else f"{row['rate']:,.0f}"
        least = "-" if row["least_s"] is None else f"{row['least_s']:.1f}"
        complete = "complete" if row["complete"] is True else str(row["complete"])
        lines.append(
            f"| {row['how']} | {rate} | {row['picture_s']:.2f} | {row['backlog_frames']} | "
            f"{row['backlog_s']:.1f} | {least} | {row['state']}, {complete}, {row['frames']} "
            f"frames | {row['client_misses']} | {row['cpu_s']:.1f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
