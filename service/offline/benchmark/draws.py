"""A random draw of tiles, calibration and noise: recorded once, estimated by every model set.

Live and offline differ only by the look-ahead. The result is bit-identical for any batch size, so
both are estimated in the pipeline's chunks.

The CPU time per frame is measured over `step` and `finish` alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.chips.compensation import Compensation
from devices.emulation.world import World
from devices.errors import FootTileError
from devices.frames import ArrayInfo, FrameBatch
from devices.scene.file import Scene
from service.estimation.calibration import Calibration
from service.estimation.estimate import Estimator
from service.estimation.ladder.plan import EstimationPlan, make_plan
from service.estimation.tare.unloaded import take_tare
from service.offline.accuracy import COMPARED, Accuracy, accuracy_of
from service.offline.benchmark.rungs import Rung
from service.offline.calibrations import find_calibration
from service.offline.findings import joined
from service.offline.simulate import SimulateOptions, Simulation
from service.rig.emulated import EmulatedFoot
from service.sessions.pipeline import CHUNK, EstimateOptions, EstimateStream

BATCH: Mapping[str, int] = {"live": 10, "offline": CHUNK}
"""Frames per estimator step, by mode."""
_WARM_STEPS = 30


class Endless:
    """Recording that is repeated endlessly, as one stream without gaps."""

    def __init__(self, frames: FrameBatch) -> None:
        self._frames = frames
        self._period_ns = round(float(np.median(np.diff(frames.t_mono_ns))))

    def rows(self, begin: int, end: int) -> FrameBatch:
        """Return frames `begin` to `end` of the stream, with rising `seq` and time."""
        n = len(self._frames)
        lap, at = np.divmod(np.arange(begin, end), n)
        once = self._frames.select(at)
        span_ns = int(self._frames.t_mono_ns[-1] - self._frames.t_mono_ns[0]) + self._period_ns
        return replace(
            once,
            seq=np.arange(begin, end, dtype=np.uint64) + self._frames.seq[0],
            t_mono_ns=once.t_mono_ns + lap * span_ns,
            t_ns=once.t_ns + lap * span_ns,
        )


def time_rungs(
    recording: Recording,
    rungs: Sequence[Rung],
    frames: Mapping[str, int],
    repetitions: int,
) -> tuple[dict[tuple[str, str], list[float]], list[Failure]]:
    """Measure ns per frame in every repetition, by mode and label of the model set.

    Args:
        recording: recording that is estimated repeatedly.
        rungs: model sets to time.
        frames: frames per repetition, by mode.
        repetitions: number of repetitions.

    Returns:
        The times, and the model sets that could not be timed.
    """
    stream = Endless(recording.frames)
    plans: dict[tuple[str, str], EstimationPlan] = {}
    failures = []
    for rung in rungs:
        for mode in LAGS_MS:
            try:
                plan = plan_of(recording, rung.models, LAGS_MS[mode])
                ns_per_frame(plan, stream, _WARM_STEPS * BATCH[mode], BATCH[mode])
            except Exception as error:
                failures.append(Failure(f"time of {rung.label}, {mode}", reason(error)))
            else:
                plans[mode, rung.label] = plan
    times: dict[tuple[str, str], list[float]] = {key: [] for key in plans}
    for _ in range(repetitions):
        for (mode, label), plan in plans.items():
            spent_ns = ns_per_frame(plan, stream, frames[mode], BATCH[mode])
            times[mode, label].append(spent_ns)
    return times, failures


def plan_of(recording: Recording, models: tuple[str, ...], lag_ms: float) -> EstimationPlan:
    """Make the constants of a recording's estimate, with the tare from its lead-in.

    Raises:
        FootTileError: the recording cannot be estimated with these models.
    """
    info, calibration = recording.info, recording.calibration
    tare = take_tare(recording.frames, Compensation(info.tiles), calibration, info.serials)
    return make_plan(info, calibration, tare, models=models, lag_ms=lag_ms)


def ns_per_frame(plan: EstimationPlan, stream: Endless, frames: int, batch: int) -> float:
    """Measure the CPU time per frame in ns, over `frames` frames, `batch` per step."""
    estimator = Estimator(plan)
    spent_ns = 0
    for begin in range(0, frames, batch):
        rows = stream.rows(begin, min(begin + batch, frames))
        began_ns = time.thread_time_ns()
        estimator.step(rows)
        spent_ns += time.thread_time_ns() - began_ns
    began_ns = time.thread_time_ns()
    estimator.finish()
    return (spent_ns + time.thread_time_ns() - began_ns) / frames


LAGS_MS: Mapping[str, float] = {"live": 10.0, "offline": 100.0}
"""Look-ahead of the two estimation modes."""

SECONDS = 20.0
"""Duration of a scene without an end."""

_TRUTH = (*(name for name in COMPARED if name.startswith("true_")), "true_force_n")


@dataclass(frozen=True)
class Recording:
    """Frames of one draw with their truth, and the calibration of its tiles."""

    info: ArrayInfo
    frames: FrameBatch
    truth: Mapping[str, npt.NDArray[Any]]
    calibration: Calibration


@dataclass(frozen=True)
class Task:
    """Work of one process: one draw of a scene, estimated by all model sets."""

    scene: Scene
    seconds: float | None
    draw: int
    rungs: tuple[Rung, ...]


@dataclass(frozen=True)
class Failure:
    """Measurement that failed, with the reason."""

    what: str
    why: str


@dataclass(frozen=True)
class Drawn:
    """Result of one draw.

    Attributes:
        draw: its number, the seed of noise and parts.
        frames: number of frames.
        accuracy: errors by mode and label of the model set.
        failures: failed measurements.
    """

    draw: int
    frames: int
    accuracy: Mapping[tuple[str, str], Accuracy]
    failures: tuple[Failure, ...]


def record(
    scene: Scene,
    seconds: float | None,
    draw: int,
    progress: Callable[[str], None] = lambda message: None,
) -> Recording:
    """Calibrate the tiles of a draw as a user would, and record the scene with them.

    Args:
        scene: scene to run.
        seconds: duration; None: the scene's, or `SECONDS` if it has no end.
        draw: seed of tiles and noise.
        progress: called before slow steps.

    Raises:
        FootTileError: scene or calibration is not usable.
    """
    calibration = find_calibration(
        scene.calibration,
        [tile.serial for tile in scene.tile if not tile.reference],
        parts_seed=draw,
        family=scene.emulation.family,
        progress=progress,
    )
    return recorded(scene, seconds, draw, calibration)[0]


def recorded(
    scene: Scene,
    seconds: float | None,
    draw: int,
    calibration: Calibration,
    foot: EmulatedFoot = EmulatedFoot(),  # noqa: B008  # frozen, so one for all is safe
) -> tuple[Recording, World]:
    """Record a scene with calibrated tiles of a draw; also return the emulated world.

    Args:
        scene: scene to run.
        seconds: duration, as for `record`.
        draw: seed of tiles and noise.
        calibration: calibration of the tiles.
        foot: emulated foot; the draw replaces its seeds.

    Raises:
        FootTileError: the scene is not usable.
    """
    with ExitStack() as stack:
        foot = replace(foot, seed=draw, parts_seed=draw)
        options = SimulateOptions(scene, seconds, otherwise_s=SECONDS, truth=True, foot=foot)
        simulation = Simulation(options, stack)
        pieces = [
            (frames, {name: extra[name] for name in _TRUTH})
            for frames, extra in simulation.pieces()
        ]
    recording = Recording(
        simulation.info,
        FrameBatch.concatenate([frames for frames, _ in pieces]),
        joined([truth for _, truth in pieces]),
        calibration,
    )
    return recording, simulation.world


def estimated(recording: Recording, models: tuple[str, ...], lag_ms: float) -> Accuracy:
    """Estimate a recording, with the tare from its lead-in, and compute the errors.

    Raises:
        FootTileError: the recording cannot be estimated with these models.
    """
    return accuracy_of(estimates_of(recording, models, lag_ms, COMPARED), lag_ms=lag_ms)


def estimates_of(
    recording: Recording, models: tuple[str, ...], lag_ms: float, names: Sequence[str]
) -> dict[str, npt.NDArray[Any]]:
    """Estimate a recording; return columns of estimates and truth, one row per frame.

    Raises:
        FootTileError: the recording cannot be estimated with these models.
    """
    options = EstimateOptions(recording.calibration, models, lag_ms, exact=True)
    stream = EstimateStream(recording.info, options)
    judged: list[Mapping[str, npt.NDArray[Any]]] = []
    for frames, columns in stream.run([(recording.frames, recording.truth)]):
        columns["t_ns"] = frames.t_ns
        judged.append({name: np.asarray(columns[name]) for name in names})
    return joined(judged)


def run_draw(task: Task) -> Drawn:
    """Record one draw and estimate it by every model set; failures are returned, not raised."""
    try:
        recording = record(task.scene, task.seconds, task.draw)
    except Exception as error:
        return Drawn(task.draw, 0, {}, (Failure(f"draw {task.draw}", reason(error)),))
    accuracy: dict[tuple[str, str], Accuracy] = {}
    failures = []
    for rung in task.rungs:
        for mode, lag_ms in LAGS_MS.items():
            try:
                accuracy[mode, rung.label] = estimated(recording, rung.models, lag_ms)
            except Exception as error:
                what = f"draw {task.draw}, {rung.label}, {mode}"
                failures.append(Failure(what, reason(error)))
    return Drawn(task.draw, len(recording.frames), accuracy, tuple(failures))


def reason(error: Exception) -> str:
    """Describe an error; an unexpected one with its type."""
    return str(error) if isinstance(error, FootTileError) else f"{type(error).__name__}: {error}"
