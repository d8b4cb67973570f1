"""What bridges cost: `python benchmarks/bridges.py [--kinds foxglove,lsl] [--seconds 20]`.

A real server with one node that replays frames at their pace (`replayed_nodes.py`), a bridge, and
two readers, each a process of its own: the other side's own client, and beside it a plain client
of the server, or for MQTT a page's socket. The added delay of a frame is the instant when the other
side has it, less the instant when the plain client has it. CPU is that of all threads of the
bridge, and of the plain client. The load average is the machine's: others may be at work.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from replayed_nodes import played, run_load
from served import COMMAND, Server, cpu_s, served
from websockets.sync.client import connect
from websockets.typing import Subprotocol

READY_S, SETTLE_S = 120.0, 10.0
MQTT_PORT = 18830


# --- readers: the number of each frame, as it comes ---------------------------------------


def read_plain(url: str) -> Iterator[list[int]]:
    import foottile

    with foottile.connect(url) as server:
        for batch in server.live(policy="drop_oldest"):
            yield batch["seq"].to_numpy().tolist()


def read_page(url: str) -> Iterator[list[int]]:
    with connect(f"{url.replace('http', 'ws')}/api/v1/live?rate_hz=10", proxy=None) as socket:
        for text in socket:
            message = json.loads(text)
            if message["type"] == "frame":
                yield [message["seq"]]


def read_foxglove(url: str) -> Iterator[list[int]]:
    frames = None
    with connect(
        url, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None, proxy=None
    ) as socket:
        for message in socket:
            if isinstance(message, str):
                channels = json.loads(message).get("channels", [])
                asked = [{"id": each["id"], "channelId": each["id"]} for each in channels]
                if asked:
                    frames = next(c["id"] for c in channels if c["topic"].endswith("/frames"))
                    socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
            elif struct.unpack_from("<I", message, 1)[0] == frames:
                yield [struct.unpack_from("<Q", message, 14)[0]]  # the first field, behind its key


def read_lsl(_: str) -> Iterator[list[int]]:
    import pylsl

    pylsl.util.set_config_content("[multicast]\nResolveScope = machine\n")
    (info,) = pylsl.resolve_byprop("name", "node00 frames", timeout=60.0)
    inlet = pylsl.StreamInlet(info)
    while True:
        sample, _ = inlet.pull_sample()
        yield [int(sample[0])]


def read_mqtt(_: str) -> Iterator[list[int]]:
    import queue

    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    seqs: queue.Queue[int] = queue.Queue()
    client = Client(CallbackAPIVersion.VERSION2)
    client.on_message = lambda *args: seqs.put(json.loads(args[2].payload)["seq"])
    client.connect("127.0.0.1", MQTT_PORT)
    client.subscribe("foottile/+/summary")
    client.loop_start()
    while True:
        yield [seqs.get()]


READERS = {
    each.__name__.removeprefix("read_"): each
    for each in (read_plain, read_page, read_foxglove, read_lsl, read_mqtt)
}


def read(kind: str, url: str, seconds: float) -> None:
    """Body of a reader: print its instants by frame, and its CPU time."""
    at_s: dict[int, float] = {}
    begin_s = begin_cpu_s = 0.0
    for seqs in READERS[kind](url):
        now_s = time.monotonic()
        if not begin_s:
            begin_s, begin_cpu_s = now_s, time.process_time()
        at_s.update(dict.fromkeys(seqs, now_s))
        if now_s - begin_s > seconds:
            break
    cores = (time.process_time() - begin_cpu_s) / (now_s - begin_s)
    sys.stdout.write(json.dumps({"at_s": at_s, "cores": cores}))
    sys.stdout.flush()
    os._exit(0)  # without waiting for threads and sockets of libraries


def serve_broker() -> None:
    from amqtt.broker import Broker

    async def run() -> None:
        plugins = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
        listener = {"type": "tcp", "bind": f"127.0.0.1:{MQTT_PORT}"}
        broker = Broker({"listeners": {"default": listener}, "plugins": plugins})
        await broker.start()
        await asyncio.Event().wait()

    asyncio.run(run())


# --- one kind -----------------------------------------------------------------------------


def measure(kind: str, server: Server, seconds: float) -> dict[str, object]:
    """Run a bridge with its readers."""
    arguments = {
        "foxglove": ["--port=18765"],
        "mqtt": [f"mqtt://127.0.0.1:{MQTT_PORT}", "--rate=10"],
    }
    command = [*COMMAND, "bridge", kind, *arguments.get(kind, []), f"--server={server.url}"]
    if kind == "plain":  # two plain clients: what the machine's load alone makes
        command = [sys.executable, "-c", "import time; time.sleep(1e6)"]
    bridge = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        time.sleep(SETTLE_S)
        url = "ws://127.0.0.1:18765" if kind == "foxglove" else server.url
        plain = "page" if kind == "mqtt" else "plain"
        readers = [
            subprocess.Popen(
                [sys.executable, __file__, "--read", reader, address, f"--seconds={seconds}"],
                stdout=subprocess.PIPE,
            )
            for reader, address in ((kind, url), (plain, server.url))
        ]
        time.sleep(SETTLE_S)
        begin_s, begin_cpu_s = time.monotonic(), cpu_s(bridge.pid)
        time.sleep(seconds - SETTLE_S)
        cores = (cpu_s(bridge.pid) - begin_cpu_s) / (time.monotonic() - begin_s)
        ours, theirs = (json.loads(reader.communicate()[0]) for reader in readers)
    finally:
        bridge.terminate()
        bridge.wait(30.0)
    both = ours["at_s"].keys() & theirs["at_s"].keys()
    first, last = min(map(int, both)), max(map(int, both))
    span = [seq for seq in theirs["at_s"] if first <= int(seq) <= last]
    added_ms = [1e3 * (ours["at_s"][seq] - theirs["at_s"][seq]) for seq in both]
    p50, p99, most = np.percentile(added_ms, [50, 99, 100])
    return {
        "kind": kind,
        "frames": len(both),
        "missing": len(span) - len(both),
        "added_ms_p50_p99_max": [round(float(each), 2) for each in (p50, p99, most)],
        "bridge_cores": round(cores, 4),
        "plain_client_cores": round(theirs["cores"], 4),
        "load_average": os.getloadavg()[0],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", default="plain,foxglove,lsl,mqtt")
    parser.add_argument("--tiles", type=int, default=4)
    parser.add_argument("--rate-hz", type=float, default=544.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--read", nargs=2)
    options = parser.parse_args()
    if options.read:
        kind, url = options.read
        read(kind, url, options.seconds)
    load = played(options.tiles, options.rate_hz)
    context = multiprocessing.get_context("spawn")
    broker = context.Process(target=serve_broker, daemon=True)
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as server:
        here, there = multiprocessing.Pipe()
        node = context.Process(target=run_load, args=(load, 1, server.url, there), daemon=True)
        broker.start()
        node.start()
        end_s = time.monotonic() + READY_S
        while not any(each["connected"] and each["tare"] for each in server.nodes()):
            assert time.monotonic() < end_s, "the node does not come"
            time.sleep(0.2)
        for kind in options.kinds.split(","):
            print(json.dumps(measure(kind, server, options.seconds)), flush=True)
        here.send("stop")
        here.recv()
        node.join()
        broker.terminate()


if __name__ == "__main__":
    main()
