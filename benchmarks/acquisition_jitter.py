"""Pace of acquisition in a thread beside a busy event loop, and in a process of its own.

    python benchmarks/acquisition_jitter.py [SECONDS]

Both take frames of the scene `standing` at 250 Hz from the emulated bus on the real clock, while
an asyncio loop in the main process serves fifty clients that want JSON thirty times a second. The
period error is the distance of two frames' instants minus 4 ms.
"""

from __future__ import annotations

import asyncio
import json
import queue
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np

from devices.scene import load_scene
from service.acquirer import AcquisitionProcess, Batch, Failed, Message, Started
from service.rig import Rig, RigOptions
from storage.schema import wire_schema
from storage.wire import decode

RATE_HZ = 250.0
CLIENTS = 50


def options() -> RigOptions:
    scene = load_scene("standing").model_copy(update={"rate_hz": RATE_HZ})
    return RigOptions(scene=scene, node="benchmark")


async def busy(stop: threading.Event) -> None:
    """Fifty clients of a live picture."""
    values = {"force_n": [1.2345] * 64, "gauge_kpa": [1.2345] * 64}

    async def client() -> None:
        while not stop.is_set():
            json.dumps(values)
            await asyncio.sleep(1 / 30)

    await asyncio.gather(*(client() for _ in range(CLIENTS)))


def beside_a_busy_loop(seconds: float, begin: Callable[[threading.Event], list[int]]) -> list[int]:
    stop = threading.Event()
    loop = threading.Thread(target=lambda: asyncio.run(busy(stop)))
    loop.start()
    threading.Timer(seconds, stop.set).start()
    try:
        return begin(stop)
    finally:
        stop.set()
        loop.join()


def in_a_thread(stop: threading.Event) -> list[int]:
    t_ns: list[int] = []
    with ExitStack() as stack:
        rig = Rig(options(), stack)
        for batch in rig.batches(stop.is_set):
            t_ns += batch.t_mono_ns.tolist()
    return t_ns


def in_a_process(stop: threading.Event) -> list[int]:
    messages: queue.Queue[Message] = queue.Queue()
    acquisition = AcquisitionProcess(options(), messages.put)
    t_ns: list[int] = []
    schema = None
    while True:
        message = messages.get()
        if isinstance(message, Started):
            schema = wire_schema(message.info)
        elif isinstance(message, Batch):
            t_ns += decode(message.batch.payload, schema).t_mono_ns.tolist()
        if isinstance(message, Failed):
            break
        if stop.is_set():
            acquisition.stop()
    acquisition.close()
    return t_ns


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    for round_ in range(2):
        for name, take in (("thread", in_a_thread), ("process", in_a_process)):
            t_ns = beside_a_busy_loop(seconds, take)
            error_us = np.abs(np.diff(t_ns[50:]) * 1e-3 - 1e6 / RATE_HZ)
            p50, p99, most = np.percentile(error_us, [50, 99, 100])
            print(
                f"{round_} {name:8} {len(t_ns) / seconds:6.1f} Hz  period error "
                f"p50 {p50:6.0f}  p99 {p99:6.0f}  max {most:6.0f} us"
            )


if __name__ == "__main__":
    main()
