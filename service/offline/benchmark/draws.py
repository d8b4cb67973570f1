"""One draw of tiles, calibration and noise: recorded once, then estimated by every rung.

Live and offline differ by the look-ahead alone; how frames are cut into batches does not change a
bit of the result, so both are estimated in the chunks of the pipeline.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.errors import FootTileError
from devices.frames import ArrayInfo, FrameBatch
from devices.scene.file import Scene
from service.estimation.calibration import Calibration
from service.offline.accuracy import COMPARED, Accuracy, accuracy_of
from service.offline.benchmark.rungs import Rung
from service.offline.calibrations import find_calibration
from service.offline.findings import joined
from service.offline.simulate import SimulateOptions, Simulation
from service.rig.emulated import EmulatedFoot
from service.sessions.pipeline import EstimateOptions, EstimateStream

LAGS_MS: Mapping[str, float] = {"live": 10.0, "offline": 100.0}
"""Look-ahead of the two ways to estimate."""

SECONDS = 20.0
"""Length of a scene that has no end of its own."""

_TRUTH = tuple(name for name in COMPARED if name.startswith("true_"))


@dataclass(frozen=True)
class Recording:
    """One draw's frames with their truth, and the calibration of its tiles."""

    info: ArrayInfo
    frames: FrameBatch
    truth: Mapping[str, npt.NDArray[Any]]
    calibration: Calibration


@dataclass(frozen=True)
class Task:
    """What one process is to do."""

    scene: Scene
    seconds: float | None
    draw: int
    rungs: tuple[Rung, ...]


@dataclass(frozen=True)
class Failure:
    """Something that could not be measured, and why."""

    what: str
    why: str


@dataclass(frozen=True)
class Drawn:
    """What came of one draw.

    Attributes:
        draw: its number: the seed of noise and of parts.
        frames: how many frames it has.
        accuracy: by mode and label of the rung.
        failures: what could not be measured.
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
        scene: what to run.
        seconds: its length; None: as long as it is, or `SECONDS` if it has no end.
        draw: seed of tiles and of noise.
        progress: told what takes time.

    Raises:
        FootTileError: scene or calibration is not usable.
    """
    serials = [tile.serial for tile in scene.tile]
    calibration = find_calibration(scene.calibration, serials, parts_seed=draw, progress=progress)
    with ExitStack() as stack:
        foot = EmulatedFoot(seed=draw, parts_seed=draw)
        options = SimulateOptions(scene, seconds, otherwise_s=SECONDS, truth=True, foot=foot)
        simulation = Simulation(options, stack)
        pieces = [
            (frames, {name: extra[name] for name in _TRUTH})
            for frames, extra in simulation.pieces()
        ]
    return Recording(
        simulation.info,
        FrameBatch.concatenate([frames for frames, _ in pieces]),
        joined([truth for _, truth in pieces]),
        calibration,
    )


def estimated(recording: Recording, models: tuple[str, ...], lag_ms: float) -> Accuracy:
    """How far off the estimates of a recording are, tared from its lead.

    Raises:
        FootTileError: no estimate with these models.
    """
    options = EstimateOptions(recording.calibration, models, lag_ms)
    stream = EstimateStream(recording.info, options)
    judged: list[Mapping[str, npt.NDArray[Any]]] = []
    for frames, columns in stream.run([(recording.frames, recording.truth)]):
        columns["t_ns"] = frames.t_ns
        judged.append({name: np.asarray(columns[name]) for name in COMPARED})
    return accuracy_of(joined(judged), lag_ms=lag_ms)


def run_draw(task: Task) -> Drawn:
    """Record one draw and estimate it by every rung; what fails is reported, not raised."""
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
    """Why something failed; an unexpected error is named by its type."""
    return str(error) if isinstance(error, FootTileError) else f"{type(error).__name__}: {error}"
