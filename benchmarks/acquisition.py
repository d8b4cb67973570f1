"""Frame rates of every schedule against the limit of the bus, and what our Python adds to it.

    python benchmarks/acquisition.py [--out docs/results/acquisition.md] [--plot FILE.png]

In virtual time: arrays of 1 to 64 tiles at 400 and 100 kHz, every part at 1.6 ms and drawn parts,
the whole driver with self-test, audits and second looks, over emulated chips. The bound is the time
that the transfers of a frame take on the wire with the true conversion times (hardware.md 4; the
formulas are `devices.array.schedules`, tested against its tables). In real time: CPU of a frame
against as many bare ioctls.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import random
import statistics
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from smbus2 import SMBus, i2c_msg

from devices.array.schedules import compute_frame_s
from devices.array.startup import prepare_array
from devices.buses.i2c import I2cBus, open_bus
from devices.clock import VirtualClock
from devices.emulation.world import World
from devices.scene.hardware_sections import ScheduleName
from devices.scene.scene_file import Scene, load_scene, validate_scene

COUNTS = (1, 2, 4, 8, 16, 32, 64)
SECONDS, FRAMES_MIN = 4.0, 60
TYPICAL_MS = 1.6


@dataclass(frozen=True)
class Measured:
    """One array under one schedule."""

    rate_hz: float
    bound_hz: float
    skew_ms: float
    age_ms: float
    stale: int

    @property
    def ratio(self) -> float:
        """Rate over bound."""
        return self.rate_hz / self.bound_hz


def scene_of(tiles: int, scl_hz: float, conversion_ms: float | None) -> Scene:
    content: dict[str, Any] = load_scene("standing").model_dump()
    content["array"] |= {
        "scl_hz": scl_hz,
        "conversion_ms": conversion_ms,
        "broadcast_channels": 64,
    }
    content["ground"] = {"kind": "none"}
    content["tile"] = [
        {
            **content["tile"][0],
            "serial": f"T{i + 1:02d}",
            "mux": 0x70 + i // 8,
            "channel": i % 8,
            "x_m": 0.01 * i,
        }
        for i in range(tiles)
    ]
    return validate_scene(content, where="benchmark")


def measure(
    tiles: int, scl_hz: float, schedule: ScheduleName, conversion_ms: float | None
) -> Measured:
    scene = scene_of(tiles, scl_hz, conversion_ms)
    clock = VirtualClock()
    world = World(scene, clock)
    ready = prepare_array(open_bus("emulated", world.i2c_adapter), scene, clock, schedule=schedule)
    # Of parts as drawn, the bound is that of the times as the self-test measured them.
    true = ready.timing
    if conversion_ms is not None:
        true = replace(true, conversions_s=(conversion_ms * 1e-3,) * tiles)
    begin_ns, frames, stale = clock.now_ns(), 0, 0
    skews_ns, ages_ns = [], []
    while frames < FRAMES_MIN or clock.now_ns() - begin_ns < SECONDS * 1e9:
        scan = ready.array.scan_frame()
        frames += 1
        stale += sum(1 for status in scan.tile_flags if status)
        skews_ns.append(max(scan.convert_stop_ns) - min(scan.convert_stop_ns))
        ages_ns.append(clock.now_ns() - min(scan.convert_stop_ns))
    return Measured(
        rate_hz=1e9 * frames / (clock.now_ns() - begin_ns),
        bound_hz=1.0 / compute_frame_s(schedule, true),
        skew_ms=statistics.median(skews_ns) * 1e-6,
        age_ms=statistics.median(ages_ns) * 1e-6,
        stale=stale,
    )


class FreeAdapter:
    """Answers every read at once, with words that change as a part's do, and keeps mux masks."""

    def __init__(self, coefficients: bytes) -> None:
        self.calls = 0
        self._coefficients = coefficients
        self._mask = b"\x00"
        self._conversions = 0
        draw = random.Random(0)  # noqa: S311  # no secret
        self._words = [
            bytes([0x66, 0x40 * draw.randrange(4), 0x7E, 0x40 * draw.randrange(4)])
            for _ in range(997)
        ]

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        """One transaction that takes no time."""
        self.calls += 1
        for message in messages:
            if not message.flags & 1:
                if message.addr != 0x60:
                    self._mask = bytes(message)
                self._conversions += message.addr == 0x60 and message.len == 2
                continue
            if message.addr != 0x60:
                answer = self._mask
            elif message.len == len(self._coefficients):
                answer = self._coefficients
            else:
                answer = self._words[self._conversions % len(self._words)]
            ctypes.memmove(message.buf, answer, message.len)

    def set_timeout(self, units_10ms: int) -> None:
        """Nothing takes time here."""

    def close(self) -> None:
        """Nothing to release."""


def cost_us(call: Callable[[], object], times: int) -> float:
    """Fastest of seven rounds, in us of CPU a call."""
    best = float("inf")
    for _ in range(7):
        begin = time.process_time()
        for _ in range(times):
            call()
        best = min(best, time.process_time() - begin)
    return 1e6 * best / times


def overhead(tiles: int, schedule: ScheduleName) -> tuple[int, float, float]:
    """Transfers of a frame, our CPU beside them, and the CPU of as many bare ioctls, both in us.

    A bare ioctl is smbus2's own call with messages built before, on a device that is no I2C bus and
    refuses it at once: the way into the kernel and back.
    """
    scene = scene_of(tiles, 400_000.0, TYPICAL_MS)
    scene = scene.model_copy(update={"array": scene.array.model_copy(update={"wait_ms": 1.6})})
    adapter = FreeAdapter(bytes.fromhex("3ECEB3F9C51733C8"))
    clock = VirtualClock()
    ready = prepare_array(I2cBus(adapter, "free"), scene, clock, schedule=schedule)
    for _ in range(20):
        ready.array.scan_frame()
    before = adapter.calls
    for _ in range(100):
        ready.array.scan_frame()
    calls = round((adapter.calls - before) / 100)
    write = i2c_msg.write(0x60, [0x12, 0x00])
    point, read = i2c_msg.write(0x60, [0x00]), i2c_msg.read(0x60, 4)
    requests = [(write,)] * (calls - tiles) + [(point, read)] * tiles

    def free() -> None:
        for request in requests:
            adapter.i2c_rdwr(*request)

    ours_us = cost_us(ready.array.scan_frame, 400) - cost_us(free, 400)
    kernel = SMBus()
    kernel.fd = os.open(os.devnull, os.O_RDWR)

    def bare() -> None:
        for request in requests:
            with suppress(OSError):
                kernel.i2c_rdwr(*request)

    bare_us = cost_us(bare, 400)
    kernel.close()
    return calls, ours_us, bare_us


def table(scl_hz: float, conversion_ms: float | None, rows: list[tuple[Any, ...]]) -> list[str]:
    parts = "every part at 1.6 ms" if conversion_ms is not None else "drawn parts (1.4 to 2.0 ms)"
    lines = [
        f"### {scl_hz / 1e3:.0f} kHz, {parts}",
        "",
        "| tiles | schedule | frames/s | bound | ratio | skew ms | oldest sample ms | not fresh |",
        "|--:|---|--:|--:|--:|--:|--:|--:|",
    ]
    for tiles in COUNTS:
        for schedule in get_args(ScheduleName):
            m = measure(tiles, scl_hz, schedule, conversion_ms)
            rows.append((scl_hz, conversion_ms, tiles, schedule, m))
            mark = " (1)" if schedule == "simultaneous" and tiles > 8 else ""
            lines.append(
                f"| {tiles} | {schedule}{mark} | {m.rate_hz:.1f} | {m.bound_hz:.1f} | "
                f"{100 * m.ratio:.1f} % | {m.skew_ms:.2f} | {m.age_ms:.2f} | {m.stale} |"
            )
            print(lines[-1], flush=True)
    return [*lines, ""]


def plot(rows: list[tuple[Any, ...]], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), sharey=True, layout="constrained")
    for axis, scl_hz in zip(axes, (400_000.0, 100_000.0), strict=True):
        for schedule, colour in zip(
            get_args(ScheduleName), ("#0b6e6e", "#c2410c", "#6d28d9", "#64748b"), strict=True
        ):
            chosen = [r for r in rows if r[0] == scl_hz and r[1] is not None and r[3] == schedule]
            tiles = [r[2] for r in chosen]
            axis.plot(tiles, [r[4].bound_hz for r in chosen], color=colour, lw=1, ls="--")
            rates = [r[4].rate_hz for r in chosen]
            axis.plot(tiles, rates, "o", ms=5, color=colour, label=schedule)
        axis.set_xscale("log", base=2)
        axis.set_yscale("log")
        axis.set_xticks(COUNTS, [str(n) for n in COUNTS])
        ticks = (5, 10, 20, 50, 100, 200, 500)
        axis.set_yticks(ticks, [str(tick) for tick in ticks])
        axis.minorticks_off()
        axis.grid(visible=True, color="#e2e8f0")
        axis.set_xlabel("tiles")
        axis.set_title(f"{scl_hz / 1e3:.0f} kHz, conversion 1.6 ms", loc="left", fontsize=11)
    axes[0].axhline(330, color="#94a3b8", lw=1, ls=":")
    axes[0].text(64, 340, "the paper: 330 Hz with 4 tiles", ha="right", fontsize=8, color="#475569")
    axes[0].set_ylabel("frames/s in virtual time")
    axes[0].legend(title="dashed: limit of the bus", frameon=False, loc="lower left", fontsize=9)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="Markdown file to write the tables to")
    parser.add_argument("--plot", type=Path, help="picture of the rates")
    a = parser.parse_args()
    rows: list[tuple[Any, ...]] = []
    lines: list[str] = []
    for scl_hz in (400_000.0, 100_000.0):
        lines += table(scl_hz, TYPICAL_MS, rows)
    lines += table(400_000.0, None, rows)
    worst = min(rows, key=lambda row: row[4].ratio)
    lines += [
        "(1) more channels at once than is electrically sound; the bound was lifted for this.",
        "",
        f"Lowest ratio {100 * worst[4].ratio:.1f} % ({worst[2]} tiles, {worst[3]}, "
        f"{worst[0] / 1e3:.0f} kHz); samples that were not fresh: {sum(r[4].stale for r in rows)}.",
        "",
        "### CPU of a frame",
        "",
        "| tiles | schedule | transfers | bare ioctls us | ours beside them us | frame to bare |",
        "|--:|---|--:|--:|--:|--:|",
    ]
    for tiles in (4, 16, 64):
        for schedule in ("pipelined", "per_mux"):
            calls, ours_us, bare_us = overhead(tiles, schedule)
            lines.append(
                f"| {tiles} | {schedule} | {calls} | {bare_us:.0f} | {ours_us:.0f} | "
                f"{(ours_us + bare_us) / bare_us:.2f} |"
            )
            print(lines[-1], flush=True)
    if a.plot is not None:
        plot(rows, a.plot)
    if a.out is not None:
        text = a.out.read_text("utf-8") if a.out.exists() else "<!-- table -->\n<!-- end -->\n"
        head, _, rest = text.partition("<!-- table -->")
        tail = rest.partition("<!-- end -->")[2]
        body = "\n".join(lines)
        a.out.write_text(f"{head}<!-- table -->\n{body}\n<!-- end -->{tail}", "utf-8")
    else:
        print("\n".join(lines[-12:]))


if __name__ == "__main__":
    main()
