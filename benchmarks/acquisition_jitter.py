"""Pace of acquisition: a thread against a process, a plain sleep against one that ends in a spin.

    python benchmarks/acquisition_jitter.py [SECONDS]

All take frames of four tiles at 250 Hz with the real driver on the real clock. Beneath it is an
adapter that sleeps as long as the wire would take, with Python's lock released, as the kernel's
ioctl does: an emulated world would take time of its own. Meanwhile an asyncio loop in the main
process serves fifty clients JSON thirty times a second. The period error is the distance of two
frames' instants from 4 ms; CPU is that of the process that takes the frames.
"""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import sys
import threading
import time
from multiprocessing.connection import Connection

import numpy as np
from acquisition import FreeAdapter, scene_of
from smbus2 import i2c_msg

from devices.acquisition import Acquisition
from devices.array.startup import ReadyArray, prepare_array
from devices.buses.i2c import I2cBus
from devices.clock import Clock, SpinningClock, SystemClock, UtcAnchor
from devices.realtime import set_timer_slack

RATE_HZ = 250.0
CLIENTS = 50
SCL_HZ = 400_000

Taken = tuple[list[int], float]


class SleepingAdapter(FreeAdapter):
    """Takes the time of the wire."""

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        """One transaction, in the time that the wire would take."""
        bits = sum(10 + 9 * message.len for message in messages) + 1
        end_ns = time.monotonic_ns() + bits * 1_000_000_000 // SCL_HZ
        super().i2c_rdwr(*messages)
        SystemClock().sleep_until_ns(end_ns)


def opened(clock: Clock) -> ReadyArray:
    """Four tiles on that adapter."""
    scene = scene_of(4, SCL_HZ, 1.6)
    array = scene.array.model_copy(update={"wait_ms": 1.6, "schedule": "simultaneous"})
    adapter = SleepingAdapter(bytes.fromhex("3ECEB3F9C51733C8"))
    return prepare_array(
        I2cBus(adapter, "sleeping"), scene.model_copy(update={"array": array}), clock
    )


def take(seconds: float, *, spins: bool) -> Taken:
    """Instants of the frames, and the share of a core that they took."""
    set_timer_slack()
    clock = SpinningClock() if spins else SystemClock()
    ready = opened(clock)
    anchor = UtcAnchor.measure(clock_set=True)
    acquisition = Acquisition(ready.array, ready.tiles, clock, anchor, rate_hz=RATE_HZ)
    begin_s, end_ns = time.thread_time(), clock.now_ns() + round(seconds * 1e9)
    t_ns: list[int] = []
    for batch in acquisition.acquire_batches(lambda: clock.now_ns() >= end_ns):
        t_ns += batch.t_mono_ns.tolist()
    return t_ns, (time.thread_time() - begin_s) / seconds


def take_and_send(seconds: float, connection: Connection, spins: bool) -> None:
    connection.send(take(seconds, spins=spins))


async def busy(seconds: float) -> None:
    """Fifty clients of a live picture."""
    values = {"force_n": [1.2345] * 64, "gauge_kpa": [1.2345] * 64}
    end_s = time.monotonic() + seconds

    async def client() -> None:
        while time.monotonic() < end_s:
            json.dumps(values)
            await asyncio.sleep(1 / 30)

    await asyncio.gather(*(client() for _ in range(CLIENTS)))


def in_a_thread(seconds: float, *, spins: bool) -> Taken:
    taken: list[Taken] = []
    thread = threading.Thread(target=lambda: taken.append(take(seconds, spins=spins)))
    thread.start()
    asyncio.run(busy(seconds))
    thread.join()
    return taken[0]


def in_a_process(seconds: float, *, spins: bool) -> Taken:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=take_and_send, args=(seconds, theirs, spins))
    process.start()
    asyncio.run(busy(seconds + 1.0))
    taken: Taken = ours.recv()
    process.join()
    return taken


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    print("| round | runs in | waits by | frames/s | p50 us | p99 us | max us | CPU % |")
    print("|--:|---|---|--:|--:|--:|--:|--:|")
    for round_ in range(3):
        for name, taken in (("thread", in_a_thread), ("process", in_a_process)):
            for spins in (False, True):
                instants, busy_part = taken(seconds, spins=spins)
                t_ns = np.array(instants[50:])
                error_us = np.abs(np.diff(t_ns) * 1e-3 - 1e6 / RATE_HZ)
                p50, p99, most = np.percentile(error_us, [50, 99, 100])
                rate_hz = 1e9 * (len(t_ns) - 1) / (t_ns[-1] - t_ns[0])
                print(
                    f"| {round_} | {name} | {'sleep, spin' if spins else 'sleep'} | {rate_hz:.1f} "
                    f"| {p50:.0f} | {p99:.0f} | {most:.0f} | {100 * busy_part:.0f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
