"""Pace of the tiles beside a servo: none, a healthy one, a silent one, a line full of garbage.

    python benchmarks/servo_jitter.py [SECONDS]

Frames of four tiles at 250 Hz with the real driver on the real clock, over the adapter of
acquisition_jitter.py, which takes the time of the wire and none of Python's. Beside them the
node's own thread reads a servo of Protocol 1.0 or 2.0 a hundred times a second. The servo is at the
far end of a pseudo-terminal in a process of its own, as a real one has its own processor. Garbage
are random bytes with many headers among them, as fast as 1 Mbaud carries them.

The four take turns, several times. The period error is the distance of two frames' instants from
4 ms. Its percentiles are medians over the turns, because one moment in which the machine was busy
otherwise would be the maximum of all; beside them stand their ratios to those without a servo.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pty
import random
import sys
import time
import tty
from collections.abc import Iterator
from multiprocessing.connection import Connection

import numpy as np
from acquisition_jitter import RATE_HZ, opened

from devices.acquisition import Acquisition
from devices.chips.dynamixel.driver import open_servo
from devices.chips.dynamixel.position_sources import ThreadedServoSource
from devices.clock import SystemClock, UtcAnchor
from devices.flags import FrameFlag
from devices.realtime import set_timer_slack
from tests.builders.servo import FaultyServo

BAUDRATE = 1_000_000
SERVO_HZ = 100.0
ROUNDS = 7
SETTLING_FRAMES = 50
LINES = ("none", "healthy", "silent", "garbage")
PIECES = (b"\xff\xff", b"\xff\xff\xfd\x00\x01", b"\xff\xff\x01\x04\x00", b"\x00\x00\x00\x00")


def be_a_servo(protocol: int, silent: bool, connection: Connection) -> None:
    with (
        FaultyServo(lambda t_ns: t_ns // 10**6, SystemClock(), protocol=protocol) as servo,
        servo.silent() if silent else contextlib.nullcontext(),
    ):
        connection.send(servo.port)
        connection.recv()


def be_garbage(connection: Connection) -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    connection.send(os.ttyname(slave))
    rng = random.Random(0)  # noqa: S311  # no secret
    while not connection.poll(0.001):
        noise = b"".join(rng.choice(PIECES) + rng.randbytes(6) for _ in range(10))
        with contextlib.suppress(BlockingIOError):
            os.write(master, noise[: BAUDRATE // 10_000])  # what the wire carries in 1 ms
        with contextlib.suppress(BlockingIOError):
            os.read(master, 4096)


@contextlib.contextmanager
def line(kind: str, protocol: int) -> Iterator[str]:
    """A line of that kind; its port."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    if kind == "garbage":
        process = context.Process(target=be_garbage, args=(theirs,))
    else:
        process = context.Process(target=be_a_servo, args=(protocol, kind == "silent", theirs))
    process.start()
    yield ours.recv()
    ours.send(None)
    process.join()


def take(kind: str, protocol: int, seconds: float) -> tuple[list[int], int, int]:
    """Instants of the frames; how many of them had a position; readings that failed."""
    set_timer_slack()
    clock = SystemClock()
    ready = opened(clock)
    with contextlib.ExitStack() as stack:
        reader = None
        if kind != "none":
            servo = open_servo(
                stack.enter_context(line(kind, protocol)),
                baudrate=BAUDRATE,
                clock=clock,
                protocol=protocol,
            )
            stack.callback(servo.close)
            reader = stack.enter_context(ThreadedServoSource(servo, clock, rate_hz=SERVO_HZ))
        anchor = UtcAnchor.measure(clock_set=True)
        acquisition = Acquisition(
            ready.array, ready.tiles, clock, anchor, rate_hz=RATE_HZ, servo=reader
        )
        end_ns = clock.now_ns() + round(seconds * 1e9)
        t_ns: list[int] = []
        positions = 0
        for batch in acquisition.acquire_batches(lambda: clock.now_ns() >= end_ns):
            t_ns += batch.t_mono_ns.tolist()
            if reader is not None:
                positions += int((batch.frame_flags & FrameFlag.SERVO_STALE == 0).sum())
        return t_ns, positions, 0 if reader is None else reader.failed_readings


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 3.0
    for protocol in (1, 2):
        percentiles: dict[str, list[np.ndarray]] = {kind: [] for kind in LINES}
        frames, positions, failures = (dict.fromkeys(LINES, 0) for _ in range(3))
        for _ in range(ROUNDS):
            for kind in LINES:
                t_ns, seen, failed = take(kind, protocol, seconds)
                period_us = np.diff(t_ns[SETTLING_FRAMES:]) * 1e-3
                error_us = np.abs(period_us - 1e6 / RATE_HZ)
                percentiles[kind].append(np.percentile(error_us, [50, 99, 100]))
                frames[kind] += len(t_ns)
                positions[kind] += seen
                failures[kind] += failed
                time.sleep(0.2)
        print(f"Protocol {protocol}.0, {ROUNDS} times {seconds:g} s each")
        base = np.median(percentiles["none"], axis=0)
        for kind in LINES:
            figures = np.median(percentiles[kind], axis=0)
            p50, p99, most = figures
            r50, r99, most_r = figures / base
            print(
                f"  {kind:8} period error p50 {p50:5.0f}  p99 {p99:5.0f}  max {most:6.0f} us"
                f"   ratio {r50:4.2f} {r99:4.2f} {most_r:4.2f}"
                f"   {frames[kind]} frames, {positions[kind]} with a position, "
                f"{failures[kind]} readings failed"
            )


if __name__ == "__main__":
    main()
