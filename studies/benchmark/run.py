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
from devices.scene.scene_file import Scene
from service.estimation.calibration import PRESETS
from service.estimation.estimate import Estimator, ModelEstimator
from service.estimation.pipeline.params import MODEL_NAMES
from service.offline.worker_pool import map_in_processes
from service.version import SOFTWARE_VERSION
from studies.benchmark.draws import (
    BATCH_FRAMES,
    ComparedModelSet,
    DrawResult,
    DrawTask,
    MeasurementFailure,
    describe_error,
    list_missing_models,
    list_model_sets,
    record_draw,
    run_draw,
    time_model_sets,
)
from studies.benchmark.figures import (
    Goal,
    Quantiles,
    SceneFigures,
    compare_with_goals,
    summarize_model_sets,
)


@dataclass(frozen=True)
class BenchmarkOptions:
    """Options of a benchmark; see `foottile benchmark --help`."""

    scenes: tuple[Scene, ...]
    draws: int
    seconds: float | None
    process_count: int
    offline_frames: int
    live_frames: int
    repetitions: int
    full_only: bool = False
    """Only the scenes' full model sets, for many draws."""
    repeatability: float | None = None
    """Standard deviation between loadings of the emulated domes; None: the scenes'."""
    correlated_ms: float | None = None
    """Correlation time of the emulated noise; None: the scenes'."""
    estimator: type[Estimator] = ModelEstimator

    def apply_emulation_options(self, scene: Scene) -> Scene:
        """Return the scene with the options of its emulation replaced."""
        requested = {"repeatability": self.repeatability, "correlated_ms": self.correlated_ms}
        given = {name: value for name, value in requested.items() if value is not None}
        emulation = scene.emulation.model_copy(update=given)
        return scene.model_copy(update={"emulation": emulation})


@dataclass(frozen=True)
class BenchmarkResult:
    """Result of a benchmark."""

    options: BenchmarkOptions
    run_at: str
    """Time of the run, ISO 8601 in UTC."""
    software: str
    machine: str
    scenes: tuple[SceneFigures, ...]

    @property
    def goals(self) -> dict[str, list[Goal]]:
        """Goals of every scene."""
        return {figures.scene: compare_with_goals(figures) for figures in self.scenes}

    @property
    def failures(self) -> list[tuple[str, MeasurementFailure]]:
        """Failed measurements, each with its scene."""
        return [(figures.scene, f) for figures in self.scenes for f in figures.failures]

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON representation."""
        options = self.options
        return {
            "software": self.software,
            "made": self.run_at,
            "machine": self.machine,
            "draws": options.draws,
            "estimator": options.estimator.name,
            "emulation": {
                "repeatability": options.repeatability,
                "correlated_ms": options.correlated_ms,
            },
            "timed": {
                "live": {"frames": options.live_frames, "batch": BATCH_FRAMES["live"]},
                "offline": {"frames": options.offline_frames, "batch": BATCH_FRAMES["offline"]},
                "repetitions": options.repetitions,
            },
            "scenes": [
                figures.as_dict() | {"goals": compare_with_goals(figures)}
                for figures in self.scenes
            ],
        }


def run_benchmark(options: BenchmarkOptions, on_progress: Callable[[str], None]) -> BenchmarkResult:
    """Run the benchmark on every scene.

    Args:
        options: options of the benchmark.
        on_progress: called with progress messages.

    Raises:
        FootTileError: every draw of a scene failed.
    """
    scenes = []
    for scene in map(options.apply_emulation_options, options.scenes):
        model_set = list_model_sets(scene.models, extra_models=_list_supported_models(scene))
        if options.estimator is not ModelEstimator:
            model_set = list_model_sets(("static",))
        if options.full_only:
            model_set = tuple(model_set for model_set in model_set if model_set.is_full_set)
        tasks = [
            DrawTask(scene, options.seconds, seed, model_set, options.estimator)
            for seed in range(options.draws)
        ]
        draws: list[DrawResult] = []
        for draw in run_draws(tasks, options.process_count):
            draws.append(draw)
            on_progress(f"{scene.name}: {len(draws)} of {options.draws} draws")
        draws.sort(key=lambda draw: draw.draw)
        scenes.append(_measure_scene(scene, model_set, draws, options, on_progress))
    made = datetime.now(UTC).isoformat(timespec="seconds")
    return BenchmarkResult(options, made, SOFTWARE_VERSION, describe_machine(), tuple(scenes))


def _list_supported_models(scene: Scene) -> tuple[str, ...]:
    has_bare_tile = any(tile.reference for tile in scene.tile)
    if scene.calibration in PRESETS:  # presets have a static curve only
        return ("skew", "denoise")
    return tuple(name for name in MODEL_NAMES if name != "ambient" or has_bare_tile)


def _measure_scene(
    scene: Scene,
    model_set: tuple[ComparedModelSet, ...],
    draws: Sequence[DrawResult],
    options: BenchmarkOptions,
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
    recording = record_draw(scene, options.seconds, good[0].draw)
    frames = {"live": options.live_frames, "offline": options.offline_frames}
    times_ns, not_timed = time_model_sets(
        recording, model_set, frames, options.repetitions, options.estimator
    )
    return SceneFigures(
        scene=scene.name,
        tile_count=len(scene.tile),
        rate_hz=recording.info.nominal_rate_hz,
        absent_models=list_missing_models(scene.models),
        assumed_scale=recording.calibration.has_assumed_scale(
            [tile.serial for tile in recording.info.tiles if not tile.reference]
        ),
        draw_count=len(good),
        frames=Quantiles.from_values([float(draw.frames) for draw in good]),
        model_sets=model_set,
        figures_by_mode_and_label=summarize_model_sets(model_set, good, times_ns),
        failures=(*failures, *not_timed),
    )


def run_draws(tasks: Sequence[DrawTask], process_count: int) -> Iterator[DrawResult]:
    """Run draws in processes; yield each as it finishes."""
    for task, draw in map_in_processes(run_draw, tasks, process_count):
        if isinstance(draw, DrawResult):
            yield draw
        else:
            yield DrawResult(
                task.draw, 0, {}, (MeasurementFailure(f"draw {task.draw}", describe_error(draw)),)
            )


def describe_machine() -> str:
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
