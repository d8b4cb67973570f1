"""What the driver makes of every fault of the field: flagged, missed, and for how long.

Runs an array of four (and of sixteen) tiles in virtual time with each fault again and again, and
compares every frame with what the emulated parts really converted. Detection sees only the bus.

    python benchmarks/fault_matrix.py [--rounds 5] [--out docs/results/fault-matrix.md]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from devices.acquisition import Acquisition
from devices.array.bus_recovery import GpioRecovery
from devices.array.startup import prepare_array
from devices.buses.i2c import open_bus
from devices.clock import UtcAnchor, VirtualClock
from devices.emulation.i2c_bus import EmulatedGpioLines
from devices.emulation.world import World
from devices.flags import TileFlag
from devices.frames import FrameBatch
from devices.scene.scene_file import Scene, load_scene, validate_scene
from tests.builders.witness import Verdict, Witness

FAULT_S, PERIOD_S, LEAD_S = 0.3, 2.0, 1.0
STRUCK = 1
"""Index of the tile that the faults of a tile strike; those of a mux strike the first mux."""
BOUND_KPA = 0.5
FRAMES_MAX = 10
TILE = ("no_answer", "unplugged", "replaced", "stale", "slow", "all_ones", "over_range")
MUX = ("brown_out", "mux_reset")
BUS = ("sda_low", "sda_high", "scl_low", "adapter_timeout", "nack_storm", "bit_errors")
RATES = {"nack_storm": (0.002, 0.02), "bit_errors": (0.0005, 0.005), "adapter_timeout": (0.002,)}


@dataclass
class Row:
    """One fault under one schedule.

    Attributes:
        struck: samples of tiles and frames that the fault touched.
        flagged: of these, how many were null or flagged in their own frame.
        needless: of the flagged, how many were read, and rightly.
        right: passed on, and word for word what was converted.
        bounded: passed on wrong, by at most 0.5 kPa.
        caught: passed on wrong by more, but flagged or right again within 10 frames.
        missed: passed on wrong by more, and for longer.
        worst_kpa: the largest error passed on.
        run: the longest run of wrong samples of one tile, in frames.
        wrongly: healthy samples of other tiles that were flagged while it lasted.
        strayed: samples of other tiles that were passed on wrong while it lasted.
        healthy: how many of these there were.
        rate: frames a second while it lasted, relative to before.
        recovery_ms: from its end until all tiles are right again, the longest.
    """

    name: str
    schedule: str
    struck: int = 0
    flagged: int = 0
    needless: int = 0
    right: int = 0
    bounded: int = 0
    caught: int = 0
    missed: int = 0
    worst_kpa: float = 0.0
    run: int = 0
    wrongly: int = 0
    strayed: int = 0
    healthy: int = 0
    rate: float = 0.0
    recovery_ms: float = 0.0


def scene_of(kind: str, rate: float | None, rounds: int, schedule: str, muxes: int) -> Scene:
    content: dict[str, Any] = load_scene("standing").model_dump()
    content["array"] |= {"conversion_ms": None, "schedule": schedule}
    # The load moves, so that what is late or left out differs from what is there.
    content["ground"] = {"kind": "rolling", "load_n": 9.0, "speed_m_s": 0.05}
    per_mux = 4 if muxes == 1 else 8
    content["tile"] = [
        {
            **content["tile"][0],
            "serial": f"T{i + 1:02d}",
            "mux": 0x70 + i // per_mux,
            "channel": i % per_mux,
            "x_m": 0.014 * i,
        }
        for i in range(per_mux * muxes)
    ]
    fault: dict[str, Any] = {"kind": kind, "duration_s": FAULT_S}
    if kind in TILE:
        fault["tile"] = f"T{STRUCK + 1:02d}"
    if kind in MUX:
        fault["mux"] = 0x70
    if rate is not None:
        fault["rate"] = rate
    times = [LEAD_S + i * PERIOD_S for i in range(rounds)] if kind else []
    content["fault"] = [{**fault, "t_s": t_s} for t_s in times]
    return validate_scene(content, where="fault matrix")


def run(scene: Scene, seconds: float, seed: int) -> tuple[FrameBatch, Verdict, np.ndarray]:
    clock = VirtualClock()
    world = World(scene, clock, begins_now=False, lead_s=0.0, seed=seed)
    recovery = GpioRecovery(EmulatedGpioLines(world.i2c_adapter, clock), clock)
    ready = prepare_array(open_bus("emulated", world.i2c_adapter), scene, clock, recovery=recovery)
    witness = Witness(world)
    ready.array.scan_frame()
    world.begin_scene_time()
    end_ns = clock.now_ns() + round(seconds * 1e9)
    anchor = UtcAnchor.from_readings(clock.now_ns(), 0, clock_set=True)
    acquisition = Acquisition(ready.array, ready.tiles, clock, anchor)
    frames = FrameBatch.concatenate(
        list(acquisition.acquire_batches(lambda: clock.now_ns() >= end_ns))
    )
    return frames, witness.judge(frames, ready.tiles), frames.t_ns * 1e-9


def judged(name: str, kind: str, rate: float | None, schedule: str, rounds: int, muxes: int) -> Row:
    row = Row(f"{name}{'' if muxes == 1 else ', 2 muxes'}", schedule)
    # A replaced part stays replaced: one round each.
    runs = rounds if kind == "replaced" else 1
    for seed in range(runs):
        each = 1 if kind == "replaced" else rounds
        scene = scene_of(kind, rate, each, schedule, muxes)
        frames, verdict, t_s = run(scene, LEAD_S + each * PERIOD_S, seed)
        _count(row, kind, frames, verdict, t_s, scene)
    row.rate /= runs
    return row


def _count(
    row: Row, kind: str, frames: FrameBatch, verdict: Verdict, t_s: np.ndarray, scene: Scene
) -> None:
    tiles = len(scene.tile)
    targets = np.ones(tiles, dtype=bool)
    if kind in TILE:
        targets = np.arange(tiles) == STRUCK
    if kind in MUX:
        targets = np.array([tile.mux == 0x70 for tile in scene.tile])
    usual_hz = (t_s < LEAD_S).sum() / LEAD_S
    unusable = ~verdict.given
    over = (frames.tile_flags & np.uint8(TileFlag.OVER_RANGE)) != 0
    fine = verdict.right & verdict.given
    for fault in scene.fault:
        begin_s, end_s = fault.t_s, fault.t_s + fault.duration_s
        rows = (t_s >= begin_s) & (t_s < end_s)
        # A sample is older than its reading: the last ones before the next fault are lost to that.
        until = np.flatnonzero((t_s >= begin_s) & (t_s < begin_s + PERIOD_S - 0.05))
        # A fault that lasts but a moment, and one whose trace outlasts it, is followed to its end.
        bad = np.flatnonzero(~(fine | (over & verdict.right))[until][:, targets].all(axis=1))
        after_s = 0.0
        if len(bad) and kind != "replaced":
            after_s = max(0.0, t_s[until[bad[-1]]] - end_s)
            rows |= (t_s >= end_s) & (t_s <= end_s + after_s)
        struck = rows[:, None] & targets[None]
        bus_lost = kind == "over_range"
        flagged = (unusable | (over if bus_lost else False)) & struck
        wrong = verdict.wrong & struck & ~flagged
        row.struck += int(struck.sum())
        row.flagged += int(flagged.sum())
        row.needless += int((flagged & verdict.same & ~over & (frames.pressure_raw < 1024)).sum())
        row.right += int((fine & struck & ~flagged).sum())
        errors = verdict.error_kpa[wrong]
        row.bounded += int((errors <= BOUND_KPA).sum())
        large = wrong & (np.nan_to_num(verdict.error_kpa) > BOUND_KPA)
        for tile in np.flatnonzero(targets):
            late = _beyond(wrong[:, tile], FRAMES_MAX)
            row.missed += int((large[:, tile] & late).sum())
            row.caught += int((large[:, tile] & ~late).sum())
        row.worst_kpa = max(row.worst_kpa, float(errors.max(initial=0.0)))
        for tile in np.flatnonzero(targets):
            row.run = max(row.run, _longest_run(wrong[:, tile]))
        others = rows[:, None] & ~targets[None]
        row.healthy += int(others.sum())
        row.wrongly += int((unusable & others).sum())
        row.strayed += int((verdict.wrong & others).sum())
        inside = (t_s >= begin_s) & (t_s < end_s)
        row.rate += inside.sum() / fault.duration_s / usual_hz / len(scene.fault)
        row.recovery_ms = max(row.recovery_ms, 1e3 * after_s)
    if kind == "replaced":
        row.recovery_ms = float("nan")  # the array has to be described anew


def _beyond(wrong: np.ndarray, frames_max: int) -> np.ndarray:
    """Which wrong samples belong to a run of more than so many frames."""
    beyond = np.zeros(len(wrong), dtype=bool)
    begin = 0
    for at in range(len(wrong) + 1):
        if at < len(wrong) and wrong[at]:
            continue
        if at - begin > frames_max:
            beyond[begin:at] = True
        begin = at + 1
    return beyond


def _longest_run(wrong: np.ndarray) -> int:
    longest = length = 0
    for is_wrong in wrong.tolist():
        length = length + 1 if is_wrong else 0
        longest = max(longest, length)
    return longest


def healthy(schedule: str, seconds: float, correlated_ms: float) -> str:
    scene = scene_of("", None, 0, schedule, 1)
    emulation = scene.emulation.model_copy(update={"correlated_ms": correlated_ms})
    scene = scene.model_copy(update={"emulation": emulation})
    frames, verdict, _ = run(scene, seconds, 0)
    samples = frames.tile_flags.size
    flagged = int((~verdict.given).sum())
    retried = int(((frames.tile_flags & np.uint8(TileFlag.RETRIED)) != 0).sum())
    noise = "white" if not correlated_ms else f"correlated over {correlated_ms:g} ms"
    return (
        f"| {schedule} | {noise} | {samples} | {flagged} | {int(verdict.wrong.sum())} | {retried} |"
    )


def matrix(rounds: int) -> Iterator[Row]:
    for schedule, muxes in (("pipelined", 1), ("simultaneous", 1), ("per_mux", 2)):
        for kind in (*TILE, *MUX, *BUS):
            for rate in RATES.get(kind, (None,)):
                name = kind if rate is None else f"{kind} {100 * rate:g} %"
                yield judged(name, kind, rate, schedule, rounds, muxes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="how often each fault strikes")
    parser.add_argument("--healthy-s", type=float, default=60.0, help="seconds without any fault")
    parser.add_argument("--out", type=Path, help="Markdown file to write; default: the terminal")
    a = parser.parse_args()
    began_s = time.monotonic()
    lines = [
        "| fault | schedule | struck | flagged in its frame | needlessly | right | passed on, "
        "wrong by <= 0.5 kPa | more, <= 10 frames | missed | worst kPa | longest run | others "
        "flagged | others wrong | rate kept | recovered after |",
        "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for r in matrix(a.rounds):
        recovered = "new stream" if np.isnan(r.recovery_ms) else f"{r.recovery_ms:.0f} ms"
        lines.append(
            f"| {r.name} | {r.schedule} | {r.struck} | {r.flagged} | {r.needless} | {r.right} | "
            f"{r.bounded} | {r.caught} | {r.missed} | {r.worst_kpa:.2f} | {r.run} | "
            f"{r.wrongly} of {r.healthy} | "
            f"{r.strayed} | "
            f"{100 * r.rate:.0f} % | {recovered} |"
        )
        if a.out is not None:
            print(lines[-1], flush=True)
    lines += [
        "",
        "Without any fault:",
        "",
        "| schedule | noise | samples | flagged | passed on wrong | asked again and mended |",
        "|---|---|--:|--:|--:|--:|",
    ]
    for schedule in ("pipelined", "simultaneous"):
        lines += [healthy(schedule, a.healthy_s, correlated_ms) for correlated_ms in (0.0, 10.0)]
    lines += ["", f"{a.rounds} rounds, {time.monotonic() - began_s:.0f} s."]
    if a.out is None:
        print("\n".join(lines))
    else:
        text = a.out.read_text("utf-8") if a.out.exists() else "<!-- table -->\n<!-- end -->\n"
        head, _, rest = text.partition("<!-- table -->")
        tail = rest.partition("<!-- end -->")[2]
        body = "\n".join(lines)
        a.out.write_text(f"{head}<!-- table -->\n{body}\n<!-- end -->{tail}", "utf-8")


if __name__ == "__main__":
    main()
