"""Latency, server CPU and sizes of the live path: `python benchmarks/live.py [SECONDS] [SCENE]`.

Server and node run as processes of their own, as in `foottile serve` and `foottile node`; the bus
is emulated on the real clock. Latency is from the sample instant of the newest frame of a message
to its arrival at a websocket client on this machine, so both ends share a clock. It contains the
batch (25 ms), the estimator's look-ahead (10 ms) and the pacing of the messages (33 ms).
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from served import COMMAND, Server, children, cpu_s, served
from websockets.sync.client import connect


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 30.0
    scene = sys.argv[2] if len(sys.argv) > 2 else "standing"
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as server:
        options = [f"--scene={scene}", f"--server={server.url}", f"--journal={folder}/node"]
        node = subprocess.Popen([*COMMAND, "node", *options])
        try:
            measure(server, node.pid, seconds, Path(folder))
        finally:
            node.terminate()
            node.wait(15)


def measure(server: Server, node: int, seconds: float, folder: Path) -> None:
    api = server.http
    while not any(each["tare"] for each in server.nodes()):
        time.sleep(0.2)
    name = server.nodes()[0]["node"]
    time.sleep(1.0)
    # First without any screen
    before = api.get(f"/nodes/{name}").json()
    began_s, busy_s = time.monotonic(), server.cpu_s
    time.sleep(seconds / 2)
    after = api.get(f"/nodes/{name}").json()
    unseen_s, unseen = server.cpu_s - busy_s, after["last_seq"] - before["last_seq"]
    unseen_wall_s = time.monotonic() - began_s

    session = api.post("/sessions", json={"node": name, "name": "benchmark"}).json()
    before = api.get(f"/nodes/{name}").json()
    latencies_ms, ages_ms, sizes, gaps_ms = [], [], [], []
    busy_s, own_s, acquiring_s = server.cpu_s, cpu_s(node), sum(map(cpu_s, children(node)))
    end_s = time.monotonic() + seconds
    last_ns = 0
    with connect(server.url.replace("http", "ws") + "/api/v1/live", compression=None) as socket:
        while time.monotonic() < end_s:
            text = socket.recv(timeout=5)
            now_ns = time.time_ns()
            message = json.loads(text)
            if message["type"] == "frame":
                latencies_ms.append((now_ns - message["t_ns"]) * 1e-6)
                ages_ms.append(message["age_ms"])
                sizes.append(len(text))
                gaps_ms.append((now_ns - last_ns) * 1e-6)
                last_ns = now_ns
    after = api.get(f"/nodes/{name}").json()
    frames = after["last_seq"] - before["last_seq"]
    server_s = server.cpu_s - busy_s
    own_s, acquiring_s = cpu_s(node) - own_s, sum(map(cpu_s, children(node))) - acquiring_s
    sealed = api.post(f"/sessions/{session['id']}/stop", timeout=60).json()
    journal = sum(path.stat().st_size for path in (folder / "journal").rglob("*.arrows"))
    table = np.percentile(latencies_ms, [50, 99, 100])
    print(
        f"frames: {frames} in {seconds:g} s, {frames / seconds:.1f} Hz held, "
        f"{after['lost_frames']} lost; nominal {after['nominal_rate_hz']:.1f} Hz"
    )
    print(
        f"sample to client: p50 {table[0]:.1f}, p99 {table[1]:.1f}, max {table[2]:.1f} ms "
        f"({len(latencies_ms)} messages; the server's own age_ms differs by "
        f"{np.median(np.subtract(latencies_ms, ages_ms)):.2f} ms)"
    )
    print(
        f"between messages: p50 {np.median(gaps_ms[1:]):.1f}, "
        f"p99 {np.percentile(gaps_ms[1:], 99):.1f} ms"
    )
    print(
        f"server: {1e6 * server_s / frames:.0f} us CPU a frame recording with one screen "
        f"({100 * server_s / seconds:.1f} % of a core); "
        f"{1e6 * unseen_s / unseen:.0f} us without ({100 * unseen_s / unseen_wall_s:.1f} %)"
    )
    print(
        f"node: journal and link {100 * own_s / seconds:.1f} % of a core; "
        f"acquisition, emulated world included, {100 * acquiring_s / seconds:.1f} %"
    )
    print(
        f"message {np.mean(sizes):.0f} bytes; journal {journal / after['last_seq']:.0f} B a frame; "
        f"sealed {sealed['bytes'] / sealed['frames']:.1f} B a frame of {sealed['frames']}, "
        f"state {sealed['state']}, complete {sealed['complete']}"
    )


if __name__ == "__main__":
    main()
