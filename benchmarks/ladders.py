"""Which models the built-in scenes should name: error against time of every ladder, load by load.

    python benchmarks/ladders.py --data DIR [--draws N] [--case NAME] [--out FILE]

`foottile benchmark` compares what a scene names; here a scene may have every model that its
calibration offers. Ladders are built up to all of them, and each is left out of the whole; recorded
loads of DIR are pressed on the emulated domes where a scene has no ground of its own.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from devices.emulation.ground.load_trace import CopTransform
from devices.scene.scene_file import Scene, load_scene
from service.estimation.calibration import PRESETS
from service.estimation.pipeline.params import MODEL_NAMES
from service.offline.calibration_lookup import find_calibration
from service.rig.emulated_foot import EmulatedFoot
from storage.formats.load_trace import read_load_to_emulate
from studies.benchmark.draws import (
    BATCH_FRAMES,
    LAGS_MS,
    ComparedModelSet,
    DrawRecording,
    DrawResult,
    compute_recording_accuracy,
    list_model_sets,
    record_with_calibration,
    time_model_sets,
)
from studies.benchmark.figures import ModelSetFigures, find_pareto_front, summarize_model_sets

MARK = "<!-- tables -->"
FRAMES = {"live": 1000, "offline": 8 * BATCH_FRAMES["offline"]}
REPETITIONS = 5
OF_A_PRESET = ("unwrap", "static", "skew", "denoise")
"""A preset knows of a curve only."""


@dataclass(frozen=True)
class Case:
    """A scene under a load.

    Attributes:
        name: of the table.
        scene: built-in.
        load: file of a recorded load; None: the scene's own ground.
        load_scale: newtons on the tiles per newton of the recording.
        cop_scale: metres likewise.
        seconds: how much of it; None: all.
    """

    name: str
    scene: str
    load: str | None = None
    load_scale: float = 1.0
    cop_scale: float = 1.0
    seconds: float | None = 20.0

    def foot(self, data: Path) -> EmulatedFoot:
        """What presses the tiles."""
        if self.load is None:
            return EmulatedFoot()
        cop = CopTransform(scale=self.cop_scale)
        return EmulatedFoot(
            read_load_to_emulate(data / self.load), load_scale=self.load_scale, cop_transform=cop
        )


CASES = (
    Case("insole, walking, left", "insole", "insole_walk_left.csv", 0.05),
    Case("insole, walking, right", "insole", "insole_walk_right.csv", 0.05),
    Case("standing, quiet", "standing"),
    Case("standing, squat jumps", "standing", "squat_jump_plate1.csv", 0.06, 0.2, None),
    Case("grid, quiet", "grid", seconds=6.0),
    Case("grid, squat jumps", "grid", "squat_jump_plate2.csv", 0.5, 0.2, None),
    Case("rolling", "rolling", seconds=None),
)


def ladders_of(scene: Scene) -> tuple[ComparedModelSet, ...]:
    """All that are compared: what it names, up to every model that is offered, and less each."""
    offered: tuple[str, ...] = OF_A_PRESET
    if scene.calibration not in PRESETS:
        has_bare_tile = any(tile.reference for tile in scene.tile)
        offered = tuple(name for name in MODEL_NAMES if name != "ambient" or has_bare_tile)
    ladders = list_model_sets(offered)
    named = tuple(name for name in MODEL_NAMES if name in scene.models)
    if any(model_set.models == named for model_set in ladders):
        return ladders
    return (ComparedModelSet("the scene's", named, False, None, None, False), *ladders)


def drawn(case: Case, data: Path, draws: int) -> Iterator[tuple[DrawResult, DrawRecording]]:
    """Every draw of tiles, calibration and noise, estimated by every ladder."""
    scene, foot = load_scene(case.scene), case.foot(data)
    serials = [tile.serial for tile in scene.tile if not tile.reference]
    for draw in range(draws):
        calibration = find_calibration(scene.calibration, serials, parts_seed=draw)
        recording, _ = record_with_calibration(scene, case.seconds, draw, calibration, foot)
        accuracy = {
            (mode, model_set.label): compute_recording_accuracy(recording, model_set.models, lag_ms)
            for model_set in ladders_of(scene)
            for mode, lag_ms in LAGS_MS.items()
        }
        yield DrawResult(draw, len(recording.frames), accuracy, ()), recording


def measured(
    case: Case, data: Path, draws: int
) -> tuple[dict[tuple[str, str], ModelSetFigures], str]:
    """Every ladder in every mode, and what was pressed."""
    ladders = ladders_of(load_scene(case.scene))
    judged: list[DrawResult] = []
    recordings: list[DrawRecording] = []
    for draw, recording in drawn(case, data, draws):
        judged.append(draw)
        recordings[:] = [recording]
        print(f"{case.name}: {len(judged)} of {draws} draws", file=sys.stderr, flush=True)
    (recording,) = recordings
    times_ns, failures = time_model_sets(recording, ladders, FRAMES, REPETITIONS)
    for failure in failures:
        print(f"{case.name}: {failure.what}: {failure.why}", file=sys.stderr)
    peak_n, info = recording.truth["true_grf_n"].max(), recording.info
    what = (
        f"{len(info.tiles)} tiles at {info.nominal_rate_hz:.0f} frames/s, "
        f"{draws} draws of {len(recording.frames)} frames, up to {peak_n:.0f} N."
    )
    return summarize_model_sets(ladders, judged, times_ns), what


def tables(case: Case, data: Path, draws: int) -> Iterator[str]:
    """What a ladder costs and what it is off by."""
    scene = load_scene(case.scene)
    figures, what = measured(case, data, draws)
    ladders = ladders_of(scene)
    named = tuple(name for name in MODEL_NAMES if name in scene.models)
    fronts = {mode: on_front(figures, ladders, mode) for mode in LAGS_MS}
    head = [
        f"{quantity}, {mode}"
        for mode in LAGS_MS
        for quantity in ("us a frame", "GRF N", "peak N", "COP p95 mm", "covered %")
    ]
    yield from ("", f"### {case.name}", "", what, "")
    yield f"| ladder | {' | '.join(head)} |"
    yield f"|---{'|--:' * len(head)}|"
    for model_set in ladders:
        cells = []
        for mode in LAGS_MS:
            m = figures[mode, model_set.label]
            us = f"{m.ns_per_frame.median / 1e3:.1f}"
            cells += [
                f"**{us}**" if model_set.label in fronts[mode] else us,
                *(
                    cell(m.figures[name].median, scale, digits)
                    for name, scale, digits in (
                        ("grf_mae_n", 1.0, 3),
                        ("peak_error_n", 1.0, 2),
                        ("cop_p95_m", 1e3, 2),
                    )
                ),
                cell(m.coverage["all"].share, 100.0, 0),
            ]
        label = f"{model_set.label} (named)" if model_set.models == named else model_set.label
        yield f"| {label} | {' | '.join(cells)} |"


def on_front(
    figures: dict[tuple[str, str], ModelSetFigures], ladders: Sequence[ComparedModelSet], mode: str
) -> set[str]:
    """Labels of the ladders that no other beats in both time and GRF error."""
    points = [
        (m.ns_per_frame.median, m.figures["grf_mae_n"].median)
        for m in (figures[mode, model_set.label] for model_set in ladders)
    ]
    return {ladders[i].label for i in find_pareto_front(points)}


def cell(value: float, scale: float, digits: int) -> str:
    """A figure of the table."""
    return "-" if math.isnan(value) else f"{scale * value:.{digits}f}"


def main() -> None:
    """See the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--case", action="append", choices=[case.name for case in CASES])
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    lines = []
    for case in CASES:
        if asked.case is None or case.name in asked.case:
            for line in tables(case, asked.data, asked.draws):
                lines.append(line)
                print(line, flush=True)
    if asked.out is not None:
        before = asked.out.read_text("utf-8").partition(MARK)[0]
        asked.out.write_text(f"{before}{MARK}\n" + "\n".join(lines) + "\n", "utf-8")


if __name__ == "__main__":
    main()
