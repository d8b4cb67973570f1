"""Run of the benchmark: draws in parallel processes, then timing on the idle machine."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from devices.errors import FootTileError
from devices.scene.file import Scene
from service.estimation.calibration import PRESETS
from service.estimation.ladder.chosen import MODELS
from service.offline.benchmark.draws import (
    BATCH,
    Drawn,
    Failure,
    Recording,
    Task,
    reason,
    record,
    run_draw,
    time_rungs,
)
from service.offline.benchmark.figures import Goal, SceneFigures, Spread, goals_of, measured_of
from service.offline.benchmark.rungs import Rung, absent, rungs
from service.offline.processes import spread
from service.version import SOFTWARE


@dataclass(frozen=True)
class BenchOptions:
    """Options of a benchmark; see `foottile benchmark --help`."""

    scenes: tuple[Scene, ...]
    draws: int
    seconds: float | None
    jobs: int
    offline_frames: int
    live_frames: int
    repetitions: int
    whole_only: bool = False
    """Only the scenes' full model sets, for many draws."""
    repeatability: float | None = None
    """Standard deviation between loadings of the emulated domes; None: the scenes'."""
    correlated_ms: float | None = None
    """Correlation time of the emulated noise; None: the scenes'."""

    def emulated(self, scene: Scene) -> Scene:
        """Return the scene with the options of its emulation replaced."""
        asked = {"repeatability": self.repeatability, "correlated_ms": self.correlated_ms}
        given = {name: value for name, value in asked.items() if value is not None}
        emulation = scene.emulation.model_copy(update=given)
        return scene.model_copy(update={"emulation": emulation})


@dataclass(frozen=True)
class Bench:
    """Result of a benchmark."""

    options: BenchOptions
    made: str
    """Time of the run, ISO 8601 in UTC."""
    software: str
    machine: str
    scenes: tuple[SceneFigures, ...]

    @property
    def goals(self) -> dict[str, list[Goal]]:
        """Goals of every scene."""
        return {figures.scene: goals_of(figures) for figures in self.scenes}

    @property
    def failures(self) -> list[tuple[str, Failure]]:
        """Failed measurements, each with its scene."""
        return [(figures.scene, f) for figures in self.scenes for f in figures.failures]

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON representation."""
        options = self.options
        return {
            "software": self.software,
            "made": self.made,
            "machine": self.machine,
            "draws": options.draws,
            "emulation": {
                "repeatability": options.repeatability,
                "correlated_ms": options.correlated_ms,
            },
            "timed": {
                "live": {"frames": options.live_frames, "batch": BATCH["live"]},
                "offline": {"frames": options.offline_frames, "batch": BATCH["offline"]},
                "repetitions": options.repetitions,
            },
            "scenes": [figures.as_dict() | {"goals": goals_of(figures)} for figures in self.scenes],
        }


def run_bench(options: BenchOptions, tell: Callable[[str], None]) -> Bench:
    """Run the benchmark on every scene.

    Args:
        options: options of the benchmark.
        on_progress: called with progress messages.

    Raises:
        FootTileError: every draw of a scene failed.
    """
    scenes = []
    for scene in map(options.emulated, options.scenes):
        ladder = rungs(scene.models, offered=_offered(scene))
        if options.whole_only:
            ladder = tuple(rung for rung in ladder if rung.is_default)
        tasks = [Task(scene, options.seconds, seed, ladder) for seed in range(options.draws)]
        draws: list[Drawn] = []
        for draw in drawn(tasks, options.jobs):
            draws.append(draw)
            tell(f"{scene.name}: {len(draws)} of {options.draws} draws")
        draws.sort(key=lambda draw: draw.draw)
        scenes.append(_figures(scene, ladder, draws, options, tell))
    made = datetime.now(UTC).isoformat(timespec="seconds")
    return Bench(options, made, SOFTWARE, machine(), tuple(scenes))


def _offered(scene: Scene) -> tuple[str, ...]:
    has_bare_tile = any(tile.reference for tile in scene.tile)
    if scene.calibration in PRESETS:  # presets have a static curve only
        return ("skew", "denoise")
    return tuple(name for name in MODELS if name != "ambient" or has_bare_tile)


def _figures(
    scene: Scene,
    ladder: tuple[Rung, ...],
    draws: Sequence[Drawn],
    options: BenchOptions,
    tell: Callable[[str], None],
) -> SceneFigures:
    failures = [failure for draw in draws for failure in draw.failures]
    good = [draw for draw in draws if draw.accuracy]
    if not good:
        raise FootTileError(
            f"none of {len(draws)} draws gave a figure: {failures[0].what}: {failures[0].why}",
            where=f"scene {scene.name}",
        )
    tell(f"{scene.name}: timing")
    recording = record(scene, options.seconds, good[0].draw)
    frames = {"live": options.live_frames, "offline": options.offline_frames}
    times_ns, not_timed = time_rungs(recording, ladder, frames, options.repetitions)
    return SceneFigures(
        scene=scene.name,
        tiles=len(scene.tile),
        rate_hz=recording.info.nominal_rate_hz,
        absent_models=absent(scene.models),
        assumed_scale=_is_assumed(recording),
        draws=len(good),
        frames=Spread.of([float(draw.frames) for draw in good]),
        rungs=ladder,
        measured=measured_of(ladder, good, times_ns),
        failures=(*failures, *not_timed),
    )


def _is_assumed(recording: Recording) -> bool:
    bearing = [tile.serial for tile in recording.info.tiles if not tile.reference]
    return any(recording.calibration.of(serial).absolute_scale == "assumed" for serial in bearing)


def drawn(tasks: Sequence[Task], jobs: int) -> Iterator[Drawn]:
    """Run draws in processes; yield each as it finishes."""
    for task, draw in spread(run_draw, tasks, jobs):
        if isinstance(draw, Drawn):
            yield draw
        else:
            yield Drawn(task.draw, 0, {}, (Failure(f"draw {task.draw}", reason(draw)),))


def machine() -> str:
    """Describe this machine, for the report."""
    model = platform.machine()
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
        name = next(line for line in lines if line.startswith("model name"))
        model = f"{name.partition(':')[2].strip()} ({model})"
    return (
        f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"numpy {np.__version__}"
    )
