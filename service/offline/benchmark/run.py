"""The whole benchmark: draws in parallel processes, then the times on a machine that is idle."""

from __future__ import annotations

import multiprocessing
import os
import platform
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from devices.errors import FootTileError
from devices.scene.file import Scene
from service.estimation.calibration import PRESETS
from service.estimation.ladder import MODELS
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
from service.version import SOFTWARE


@dataclass(frozen=True)
class BenchOptions:
    """What to compare; see `foottile bench --help`."""

    scenes: tuple[Scene, ...]
    draws: int
    seconds: float | None
    jobs: int
    offline_frames: int
    live_frames: int
    repetitions: int
    whole_only: bool = False
    """Only the scenes' whole ladders, for many draws."""
    repeatability: float | None = None
    """Of the emulated domes, instead of the scenes'."""
    correlated_ms: float | None = None
    """Correlation time of the emulated noise, instead of the scenes'."""

    def emulated(self, scene: Scene) -> Scene:
        """The scene with the emulation that is asked for."""
        asked = {"repeatability": self.repeatability, "correlated_ms": self.correlated_ms}
        given = {name: value for name, value in asked.items() if value is not None}
        emulation = scene.emulation.model_copy(update=given)
        return scene.model_copy(update={"emulation": emulation})


@dataclass(frozen=True)
class Bench:
    """What came of it."""

    options: BenchOptions
    made: str
    """When, ISO 8601 in UTC."""
    software: str
    machine: str
    scenes: tuple[SceneFigures, ...]

    @property
    def goals(self) -> dict[str, list[Goal]]:
        """The goals of every scene."""
        return {figures.scene: goals_of(figures) for figures in self.scenes}

    @property
    def failures(self) -> list[tuple[str, Failure]]:
        """What could not be measured, with its scene."""
        return [(figures.scene, f) for figures in self.scenes for f in figures.failures]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
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
    """Measure every scene.

    Args:
        options: what to compare.
        tell: told what is being done.

    Raises:
        FootTileError: no draw of a scene gave a figure.
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
    if scene.calibration in PRESETS:  # which know of a static curve only
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
    entries = [recording.calibration.of(serial) for serial in recording.info.serials]
    return any(entry.absolute_scale == "assumed" for entry in entries)


def drawn(tasks: Sequence[Task], jobs: int) -> Iterator[Drawn]:
    """Every draw as it is finished."""
    if jobs == 1:
        yield from map(run_draw, tasks)
        return
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        with _interrupts_wait():
            pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_end_when_told)
            stack.enter_context(pool)
            stack.push(partial(_end_early, pool))
            futures = {pool.submit(_run_draw, task): task for task in tasks}
        for future in as_completed(futures):
            try:
                yield future.result()
            except Exception as error:  # one that was killed breaks the pool: all draws left
                draw = futures[future].draw
                yield Drawn(draw, 0, {}, (Failure(f"draw {draw}", reason(error)),))


def _end_early(pool: ProcessPoolExecutor, kind: type[BaseException] | None, *_: object) -> None:
    """After an error nobody waits for the draws that are left."""
    if kind is not None:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()


@contextmanager
def _interrupts_wait() -> Iterator[None]:
    """Processes that are started meanwhile know no Ctrl-C: we tell them when to end.

    One that comes meanwhile is not lost, and finds no process half-started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # processes inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
    if came:
        raise KeyboardInterrupt


def _end_when_told() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))


def _run_draw(task: Task) -> Drawn:
    try:
        return run_draw(task)
    except SystemExit:
        os._exit(1)  # what it had open is cleaned up; the pool would give it another draw


def machine() -> str:
    """What the times were measured on."""
    model = platform.machine()
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
        name = next(line for line in lines if line.startswith("model name"))
        model = f"{name.partition(':')[2].strip()} ({model})"
    return (
        f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"numpy {np.__version__}"
    )
