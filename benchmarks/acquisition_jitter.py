"""Pace of acquisition in a thread beside a busy event loop, and in a process of its own.

    python benchmarks/acquisition_jitter.py [SECONDS]

Both take frames of four tiles at 250 Hz with the real driver on the real clock. Beneath it is an
adapter that sleeps as long as the wire would take, with Python's lock released, as the kernel's
ioctl does, and gives constant words: an emulated world would take time of its own. Meanwhile an
asyncio loop in the main process serves fifty clients JSON thirty times a second. The period error
is the distance of two frames' instants from 4 ms.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import multiprocessing
import sys
import threading
import time
from multiprocessing.connection import Connection

import numpy as np
from smbus2 import i2c_msg

from devices.acquisition import Acquisition
from devices.array import TileArray
from devices.clock import SystemClock, UtcAnchor
from devices.i2c import open_bus
from devices.realtime import sharpen_timers
from devices.scene import load_scene

RATE_HZ = 250.0
CLIENTS = 50
SCL_HZ = 400_000
COEFFICIENTS = bytes.fromhex("3ECEB3F9C51733C8")  # the data sheet's example part
COUNTS = bytes.fromhex("66807EC0")


class SleepingAdapter:
    """Takes the time of the wire and answers every read with the same words."""

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        """One transaction, in the time that the wire would take."""
        bits = sum(10 + 9 * message.len for message in messages) + 1
        end_ns = time.monotonic_ns() + bits * 1_000_000_000 // SCL_HZ
        for message in messages:
            if message.flags & 1:
                words = COEFFICIENTS if message.len == len(COEFFICIENTS) else COUNTS
                ctypes.memmove(message.buf, words[: message.len], message.len)
        SystemClock().sleep_until_ns(end_ns)

    def close(self) -> None:
        """Nothing to release."""


def take(seconds: float) -> list[int]:
    """Instants of the frames."""
    sharpen_timers()
    clock = SystemClock()
    scene = load_scene("standing")
    array = TileArray(
        open_bus("emulated", SleepingAdapter()),
        scene.tile,
        clock,
        schedule="simultaneous",
        wait_ms=scene.array.wait_ms,
    )
    tiles = array.identify()
    anchor = UtcAnchor.now(clock_set=True)
    acquisition = Acquisition(array, tiles, clock, anchor, rate_hz=RATE_HZ)
    end_ns = clock.now_ns() + round(seconds * 1e9)
    t_ns: list[int] = []
    for batch in acquisition.run(lambda: clock.now_ns() >= end_ns):
        t_ns += batch.t_mono_ns.tolist()
    return t_ns


def take_and_send(seconds: float, connection: Connection) -> None:
    connection.send(take(seconds))


async def busy(seconds: float) -> None:
    """Fifty clients of a live picture."""
    values = {"force_n": [1.2345] * 64, "gauge_kpa": [1.2345] * 64}
    end_s = time.monotonic() + seconds

    async def client() -> None:
        while time.monotonic() < end_s:
            json.dumps(values)
            await asyncio.sleep(1 / 30)

    await asyncio.gather(*(client() for _ in range(CLIENTS)))


def in_a_thread(seconds: float) -> list[int]:
    taken: list[list[int]] = []
    thread = threading.Thread(target=lambda: taken.append(take(seconds)))
    thread.start()
    asyncio.run(busy(seconds))
    thread.join()
    return taken[0]


def in_a_process(seconds: float) -> list[int]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=take_and_send, args=(seconds, theirs))
    process.start()
    asyncio.run(busy(seconds + 1.0))
    t_ns: list[int] = ours.recv()
    process.join()
    return t_ns


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    for round_ in range(3):
        for name, taken in (("thread", in_a_thread), ("process", in_a_process)):
            t_ns = np.array(taken(seconds)[50:])
            error_us = np.abs(np.diff(t_ns) * 1e-3 - 1e6 / RATE_HZ)
            p50, p99, most = np.percentile(error_us, [50, 99, 100])
            rate_hz = 1e9 * (len(t_ns) - 1) / (t_ns[-1] - t_ns[0])
            print(
                f"{round_} {name:8} {rate_hz:6.1f} Hz  period error "
                f"p50 {p50:6.0f}  p99 {p99:6.0f}  max {most:6.0f} us"
            )


if __name__ == "__main__":
    main()
