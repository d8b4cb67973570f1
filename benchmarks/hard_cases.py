"""What an estimate makes of tiles that are wrong and answer all the same, and of healthy ones.

    python benchmarks/hard_cases.py [--out docs/results/hard_cases.md]
    python benchmarks/hard_cases.py --healthy HOURS [--lost SHARE,SHARE] [--feet NAME,NAME]
        [--data DIR]

Each case is a fault of an emulated foot of four tiles that walks on the spot: half sines of 0.6 s,
each as heavy as it likes. Its frames are estimated live (10 ms of look-ahead) twice, with the watch
and without. Wrong is a GRF that is off by more than 1 N and by more than 1.96 of its own sigma.

With `--healthy` no fault is there, and every flag is a false alarm: built-in scenes and recorded
loads, over and over again, for so long each, with white noise, with noise correlated over 10 ms,
and with repeatability 0.03; with `--lost` less shares of the frames, a line for each. The bound is
that of alarms an hour with 95 % confidence; the evidence is the highest for a clip.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from devices.arrays import Bools, Floats
from devices.chips.pressure_chips import Compensation, get_raw_type
from devices.clock import VirtualClock
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2
from devices.emulation.ground.load_trace import CopTransform, LoadTrace
from devices.errors import FootTileError
from devices.flags import EstimateFlag, FrameFlag
from devices.frames import NO_SERVO_AGE, NO_SERVO_COUNTS, ArrayInfo, FrameBatch, allocate_columns
from devices.scene.scene_file import Scene, load_scene
from service.estimation.calibration import Calibration
from service.estimation.estimate import ModelEstimator
from service.estimation.pipeline.plan import EstimationPlan, make_plan
from service.estimation.records import Estimates
from service.estimation.tare.unloaded_windows import compute_recording_tare
from service.offline.calibration_lookup import find_calibration
from service.offline.simulation import EmulatedRun, SimulationOptions
from service.rig.emulated_foot import EmulatedFoot
from storage.formats.load_trace import read_load_to_emulate

LAG_MS = 10.0
AT_A_TIME = 50
"""Frames that are lost by a machine that is busy elsewhere: 0.1 s."""
CHUNK = 4096
MARK = "<!-- table -->"
WRONG_N = 1.0
LADDERS = {
    "static": ("unwrap", "static"),
    "whole": ("unwrap", "gas", "static", "skew", "denoise", "hysteresis", "rubber"),
}
WARM = ("unwrap", "temperature", *LADDERS["whole"][1:])
MUD = ("unwrap", "temperature", "ambient", *LADDERS["whole"][1:])
JUDGED = EstimateFlag.STUCK | EstimateFlag.CLIPPED | EstimateFlag.BASELINE_LOST
BEGIN_S = 5.3
"""When most faults begin, in the middle of a step."""


@dataclass(frozen=True)
class Recorded:
    """Frames of an emulated foot with what was true."""

    info: ArrayInfo
    frames: FrameBatch
    true_grf_n: Floats
    calibration: Calibration


def record(scene: Scene, foot: EmulatedFoot, seconds: float | None) -> Recorded:
    """Run a scene, its tiles calibrated on the emulated bench."""
    serials = [tile.serial for tile in scene.tile]
    calibration = find_calibration(scene.calibration, serials, parts_seed=foot.parts_seed)
    with ExitStack() as stack:
        options = SimulationOptions(
            scene, seconds, default_seconds=20.0, with_truth=True, foot=foot
        )
        simulation = EmulatedRun(options, stack)
        pieces = list(simulation.run_frames())
    return Recorded(
        simulation.info,
        FrameBatch.concatenate([frames for frames, _ in pieces]),
        np.concatenate([extra["true_grf_n"] for _, extra in pieces]),
        calibration,
    )


def estimated(plan: EstimationPlan, frames: FrameBatch) -> Estimates:
    """All estimates of a recording."""
    estimator, pieces = ModelEstimator(plan), []
    for begin in range(0, len(frames), CHUNK):
        pieces.append(
            estimator.process_frames(frames.slice_rows(begin, min(begin + CHUNK, len(frames))))
        )
    last = estimator.finish()
    return Estimates.concatenate(pieces if last is None else [*pieces, last])


def plan_of(recorded: Recorded, models: Sequence[str], *, blind: bool = False) -> EstimationPlan:
    """A live estimate's constants, tared from the lead."""
    info, calibration = recorded.info, recorded.calibration
    tare = compute_recording_tare(
        recorded.frames, Compensation(info.tiles), calibration, info.serials
    )
    plan = make_plan(info, calibration, tare, models=models, lag_ms=LAG_MS)
    if blind:
        plan.params.foot["has_fault_detection"] = 0
    return plan


def walk(seconds: float) -> LoadTrace:
    """Steps of 0.6 s, 0.6 s apart, on four tiles, each with a top of its own."""
    rng = np.random.default_rng(0)
    t_s = np.arange(0.0, seconds, 0.005)
    number, at_s = (t_s // 1.2).astype(int), t_s % 1.2
    tops_n = rng.uniform(9.0, 17.0, (number[-1] + 1, 4))[number]
    shape = np.where(at_s < 0.6, np.sin(math.pi * np.minimum(at_s, 0.6) / 0.6), 0.0)
    cells_n = tops_n * shape[:, None]
    return LoadTrace("steps", t_s, cells_n, None, None, None)


@dataclass(frozen=True)
class Case:
    """One thing that goes wrong."""

    name: str
    fault: dict[str, Any] | None = None
    emulation: dict[str, Any] | None = None
    begin_s: float = BEGIN_S
    ladders: tuple[str, ...] = ("whole",)


def on_tile(kind: str, seconds: float = 60.0, **keys: Any) -> dict[str, Any]:
    """A fault of the second tile."""
    return {"kind": kind, "tile": "T02", "t_s": BEGIN_S, "duration_s": seconds, **keys}


def cases() -> list[Case]:
    """All of them."""
    step_k = {"temperature_step_s": BEGIN_S}
    return [
        Case("nothing", begin_s=0.0),
        Case("pressure word stands still for 1 s (`frozen`)", on_tile("frozen", 1.0)),
        Case("pressure word stands still for good", on_tile("frozen")),
        *(
            Case(f"dome leaks, {leak_s:g} s (`puncture`)", on_tile("puncture", leak_s=leak_s))
            for leak_s in (0.03, 0.1, 0.5, 2.0, 10.0, 60.0)
        ),
        Case("all chips clip at 106 kPa", emulation={"clip_kpa": 106.0}, begin_s=1.0),
        Case("all chips clip at 104 kPa", emulation={"clip_kpa": 104.0}, begin_s=1.0),
        Case("4 K colder", emulation={"temperature_step_k": -4.0, **step_k}),
        Case("4 K warmer", emulation={"temperature_step_k": 4.0, **step_k}),
        Case(
            "4 K colder, `temperature` named",
            emulation={"temperature_step_k": -4.0, **step_k},
            ladders=("warm",),
        ),
        Case("conversions never end for 1 s (`stale`)", on_tile("stale", 1.0)),
        Case("no answer for 1 s (`no_answer`)", on_tile("no_answer", 1.0)),
        Case("pressed past its range for 1 s (`over_range`)", on_tile("over_range", 1.0)),
    ]


def rows(seconds: float) -> Iterator[str]:
    """A line of the table for each case and ladder."""
    content = load_scene("standing").model_dump(mode="python", exclude_none=True)
    content["ground"] = {"kind": "trace"}
    for case in cases():
        fault = [] if case.fault is None else [case.fault]
        emulation = content["emulation"] | (case.emulation or {})
        scene = Scene.model_validate(content | {"fault": fault, "emulation": emulation})
        recorded = record(scene, EmulatedFoot(load=walk(seconds), seed=1), seconds)
        for ladder in case.ladders:
            models = WARM if ladder == "warm" else LADDERS[ladder]
            yield row(case, ladder, recorded, models)


def row(case: Case, ladder: str, recorded: Recorded, models: Sequence[str]) -> str:
    """One line of the table."""
    before = estimated(plan_of(recorded, models, blind=True), recorded.frames)
    after = estimated(plan_of(recorded, models), recorded.frames)
    t_s = (recorded.frames.t_ns - recorded.frames.t_ns[0]) * 1e-9
    wrong = [_wrong(e, recorded.true_grf_n) for e in (before, after)]
    off_n = np.abs(before.grf_n - recorded.true_grf_n)[t_s >= case.begin_s]
    flagged = (after.estimate_flags & JUDGED) != 0
    first_s = "-" if not flagged.any() else f"{t_s[flagged][0] - case.begin_s:.2f}"
    bits = np.bitwise_or.reduce(after.estimate_flags & ~np.uint16(_ORDINARY))
    names = ", ".join(f"`{bit.name.lower()}`" for bit in EstimateFlag if bit & bits and bit.name)
    seen = np.isfinite(after.grf_sigma_n) & (t_s >= case.begin_s)
    within = np.abs(after.grf_n - recorded.true_grf_n) <= 1.96 * after.grf_sigma_n
    covered = f"{100 * within[seen].mean():.0f} %" if seen.any() else "-"
    worst_n = f"{np.nanmax(off_n):.1f}" if np.isfinite(off_n).any() else "-"
    silent = [int((w & ~_said(e)).sum()) for w, e in zip(wrong, (before, after), strict=True)]
    return (
        f"| {case.name} | {ladder} | {worst_n} | {silent[0]} | {silent[1]} | {names or '-'} "
        f"| {first_s} | {covered} |"
    )


_ORDINARY = EstimateFlag.COP_MASKED | EstimateFlag.OUTLIER_REPLACED | EstimateFlag.GAP
_SAYING = JUDGED | EstimateFlag.SATURATED | EstimateFlag.TARE_OLD | EstimateFlag.TILE_MISSING


def _said(e: Estimates) -> Bools:
    return np.asarray((e.estimate_flags & _SAYING) != 0)


def _wrong(e: Estimates, true_n: Floats) -> Bools:
    off_n = np.abs(e.grf_n - true_n)
    return np.asarray((off_n > WRONG_N) & (off_n > 1.96 * e.grf_sigma_n))


NOISES: tuple[dict[str, Any], ...] = ({}, {"correlated_ms": 10.0}, {"repeatability": 0.03})


def healthy_feet(
    data: Path, seed: int, feet: Sequence[str]
) -> Iterator[tuple[str, Scene, EmulatedFoot]]:
    """Yield feet that nothing is wrong with, without an end: those of these names, or all."""
    for name, load in (
        ("insole", "insole_walk_left.csv"),
        ("insole", "insole_walk_right.csv"),
        ("rolling", None),
        ("poppy", None),
        ("mud", None),
        ("standing", None),
        ("standing", "squat_jump_plate1.csv"),
    ):
        if feet and (load or name) not in feet:
            continue
        content = load_scene(name).model_dump(mode="python", exclude_none=True)
        emulation = content["emulation"] | NOISES[seed % len(NOISES)]
        scene = Scene.model_validate(content | {"emulation": emulation})
        foot = EmulatedFoot(seed=101 + seed)
        if load is not None:
            scale, cop = (0.05, 1.0) if name == "insole" else (0.03, 0.2)
            trace, transform = read_load_to_emulate(data / load), CopTransform(scale=cop)
            foot = replace(foot, load=trace, load_scale=scale, cop_transform=transform)
        yield load or name, scene, foot


def converted(
    scene: Scene, foot: EmulatedFoot, info: ArrayInfo, hours: float
) -> Iterator[FrameBatch]:
    """Frames of what the chips convert, over and over again, without a bus, which takes longer."""
    world = foot.make_world(scene, VirtualClock(), foot.compute_tile_load(scene), is_repeated=True)
    world.begin_scene_time()
    chips = [
        chip._silicon.sample_counts  # noqa: SLF001  # a driver has the bus only; here is none
        for chip in world.chips
        if isinstance(chip, EmulatedMpl115a2)
    ]
    step_ns = round(1e9 / info.nominal_rate_hz)
    late_ns = step_ns // len(chips) * np.arange(len(chips))
    end = round(hours * 3600 * info.nominal_rate_hz)
    for begin in range(0, end, CHUNK):
        n = min(CHUNK, end - begin)
        columns = allocate_columns(n, len(chips), get_raw_type(info.tiles))
        t_ns = step_ns * np.arange(begin, begin + n, dtype=np.int64)
        columns["seq"][:] = np.arange(begin, begin + n)
        columns["t_mono_ns"][:] = world.epoch_ns + t_ns
        columns["t_ns"][:] = columns["t_mono_ns"] + info.utc_offset_ns
        columns["sample_offset_us"][:] = late_ns // 1000
        columns["servo_counts"][:], columns["servo_age_us"][:] = NO_SERVO_COUNTS, NO_SERVO_AGE
        columns["reference_force_n"][:] = np.nan
        columns["frame_flags"][:] = np.where(t_ns < foot.lead_s * 1e9, FrameFlag.LEAD, 0)
        for i, at_ns in enumerate(columns["t_mono_ns"].tolist()):
            for j, chip in enumerate(chips):
                columns["pressure_raw"][i, j], columns["temperature_raw"][i, j] = chip(
                    at_ns + int(late_ns[j])
                )
        yield FrameBatch(**columns)


def without(batch: FrameBatch, share: float, rng: np.random.Generator) -> FrameBatch:
    """Return a batch but for this share of its frames; its lead is whole."""
    begins = rng.random(len(batch)) < share / AT_A_TIME
    lost = np.convolve(begins, np.ones(AT_A_TIME))[: len(batch)] > 0
    return batch.select_rows(~lost | (batch.frame_flags & FrameFlag.LEAD != 0))


def healthy(
    data: Path, hours: float, shares: Sequence[float], feet: Sequence[str]
) -> Iterator[str]:
    """Yield a line for each foot and share of lost frames: hours, alarms, bound, evidence."""
    found: dict[tuple[str, float], Alarms] = {}
    for seed in range(len(NOISES)):
        for name, scene, foot in healthy_feet(data, seed, feet):
            recorded = record(scene, replace(foot, seed=0), 3.0)
            frames = converted(scene, foot, recorded.info, hours)
            # Mud presses on all tiles: without its own ladder their baselines are lost.
            ladders = [MUD] if name == "mud" else list(LADDERS.values())
            counts = [found.setdefault((name, share), Alarms()) for share in shares]
            count_alarms(recorded, frames, shares, counts, ladders, seed)
            print(name, NOISES[seed], counts, file=sys.stderr, flush=True)
    yield from alarm_lines(found)


@dataclass
class Alarms:
    """Hours of healthy frames, onsets of each `EstimateFlag`, highest evidence for a clip."""

    hours: float = 0.0
    onsets: Counter[EstimateFlag] = field(default_factory=Counter)
    evidence: float = 0.0

    def __add__(self, other: Alarms) -> Alarms:
        """Return both together."""
        return Alarms(
            self.hours + other.hours,
            self.onsets + other.onsets,
            max(self.evidence, other.evidence),
        )


def count_alarms(
    recorded: Recorded,
    frames: Iterable[FrameBatch],
    shares: Sequence[float],
    found: Sequence[Alarms],
    ladders: Sequence[Sequence[str]],
    seed: int,
) -> None:
    """Add hours, onsets and evidence of these frames to each share that is lost."""
    rngs = [np.random.default_rng(seed) for _ in shares]
    estimators: list[list[ModelEstimator]] = []
    for batch in frames:
        if not estimators:
            first = replace(recorded, frames=batch)
            estimators = [[ModelEstimator(plan_of(first, m)) for m in ladders] for _ in shares]
        for share, rng, alarms, of_share in zip(shares, rngs, found, estimators, strict=True):
            alarms.hours += len(batch) / recorded.info.nominal_rate_hz / 3600.0
            taken = without(batch, share, rng)
            for estimator in of_share:
                status = estimator.process_frames(taken).estimate_flags
                for bit in JUDGED:
                    there = ((status & bit) != 0).astype(int)
                    alarms.onsets[bit] += int((np.diff(there, prepend=0) == 1).sum())
                states = estimator._tile_states  # noqa: SLF001  # no estimate says how near a clip was
                evidence = float(states["clipping"]["evidence"].max())
                alarms.evidence = max(alarms.evidence, evidence)


def most_per_hour(alarms: int, hours: float) -> float:
    """Return the upper bound of a rate, 95 % (Wilson and Hilferty 1931); 3 / hours for none."""
    k = alarms + 1
    return float(k * (1.0 - 1.0 / (9.0 * k) + 1.645 / (3.0 * math.sqrt(k))) ** 3 / hours)


def alarm_lines(found: dict[tuple[str, float], Alarms]) -> Iterator[str]:
    """Yield the table's lines, and their sum."""
    every = ("all", math.nan), sum(found.values(), Alarms())
    for (name, share), alarms in [*found.items(), every]:
        counts = [alarms.onsets[bit] for bit in JUDGED]
        bound = most_per_hour(alarms.onsets[EstimateFlag.CLIPPED], alarms.hours)
        lost = "-" if math.isnan(share) else f"{100 * share:g} %"
        yield (
            f"| {name} | {lost} | {alarms.hours:.2f} | {' | '.join(map(str, counts))} "
            f"| < {bound:.2f} | {alarms.evidence:.1f} |"
        )


def main() -> None:
    """Print the tables, or write the first into the page behind its mark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--healthy", type=float, default=0.0, metavar="HOURS")
    parser.add_argument("--lost", default="0", metavar="SHARE,SHARE")
    parser.add_argument("--feet", default="", metavar="NAME,NAME")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    if options.healthy:
        print("| foot | lost | hours | stuck | clipped | baseline_lost | clipped/h | evidence |")
        print("|---|--:|--:|--:|--:|--:|--:|--:|")
        shares = [float(share) for share in options.lost.split(",")]
        feet = options.feet.split(",") if options.feet else []
        print("\n".join(healthy(options.data, options.healthy, shares, feet)))
        return
    table = [
        "| case | ladder | worst error N | wrong and silent before | now | flags | first after s "
        "| covered |",
        "|---|---|--:|--:|--:|---|--:|--:|",
    ]
    for line in rows(options.seconds):
        print(line, file=sys.stderr, flush=True)
        table.append(line)
    text = "\n".join(table) + "\n"
    if options.out is None:
        print(text, end="")
        return
    head, _, rest = options.out.read_text().partition(MARK)
    _, _, tail = rest.partition("\n\n")
    options.out.write_text(f"{head}{MARK}\n{text}\n{tail}")


if __name__ == "__main__":
    try:
        main()
    except FootTileError as error:
        sys.exit(str(error))
