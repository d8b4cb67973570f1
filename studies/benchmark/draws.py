"""A random draw of tiles, calibration and noise: recorded once, estimated by every model set.

Live and offline differ only by the look-ahead. The result is bit-identical for any batch size, so
both are estimated in the pipeline's chunks.

The CPU time per frame is measured over `process_frames` and `finish` alone.

The first show the gain of each model for its run time, the second show its effect in the full set.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.chips.pressure_chips import Compensation
from devices.emulation.world import World
from devices.errors import FootTileError
from devices.frames import ArrayInfo, FrameBatch
from devices.scene.scene_file import Scene
from service.estimation.calibration import Calibration
from service.estimation.estimate import Estimator, ModelEstimator
from service.estimation.pipeline.params import MODEL_NAMES
from service.estimation.pipeline.plan import EstimationPlan, make_plan
from service.estimation.tare.unloaded_windows import compute_recording_tare
from service.offline.accuracy import ACCURACY_COLUMNS, Accuracy, compute_accuracy
from service.offline.calibration_lookup import find_calibration
from service.offline.estimate_summary import concatenate_columns
from service.offline.simulation import EmulatedRun, SimulationOptions
from service.rig.emulated_foot import EmulatedFoot
from service.sessions.estimate_stream import ROWS_PER_STEP, EstimateOptions, EstimateStream

BASE_MODELS = ("unwrap", "static")
"""First model set: the models that every force needs."""
MODELS_BY_IMPORTANCE = ("denoise", "skew", "gas", "rubber", "hysteresis", "temperature", "ambient")


@dataclass(frozen=True)
class ComparedModelSet:
    """Model set, and its relation to the others.

    Attributes:
        label: short name for tables and plots.
        models: the models, in the order of `MODEL_NAMES`.
        is_built_up: True for the first set and each set with one model more than the set before.
        added_model: model that it adds to the set before; None for the first and ablated sets.
        missing_model: the one model of the full set that is missing in it; None otherwise.
        extra_model: model that it adds to the full set.
        is_full_set: True for the scene's full set.
    """

    label: str
    models: tuple[str, ...]
    is_built_up: bool
    added_model: str | None
    missing_model: str | None
    is_full_set: bool
    extra_model: str | None = None


def list_model_sets(
    scene_models: Sequence[str],
    all_models: Sequence[str] = MODEL_NAMES,
    extra_models: Sequence[str] = (),
) -> tuple[ComparedModelSet, ...]:
    """List the model sets to compare for a scene, without duplicates.

    First the built-up ones, ending with the scene's full set, then the full set without each of its
    models, then the full set with each further model. Unknown models are left out; see
    `list_missing_models`.

    Args:
        scene_models: models of the scene, with `static`.
        all_models: all models, in order of application.
        extra_models: further models that array and calibration support.
    """
    whole = tuple(name for name in all_models if name in scene_models)
    later = [name for name in all_models if name not in (*BASE_MODELS, *MODELS_BY_IMPORTANCE)]
    order = [name for name in (*MODELS_BY_IMPORTANCE, *later) if name in whole]
    less = {tuple(m for m in whole if m != name): name for name in whole if name != "static"}
    built: list[ComparedModelSet] = []
    chosen = [name for name in BASE_MODELS if name in whole]
    for added in (None, *order):
        chosen += [] if added is None else [added]
        models = tuple(name for name in all_models if name in chosen)
        label = "+".join(models) if added is None else f"+{added}"
        if models == whole:
            label = f"{label} (whole)" if added is None else f"whole ({label})"
        built.append(
            ComparedModelSet(label, models, True, added, less.get(models), models == whole)
        )
    seen = {model_set.models for model_set in built}
    ablated = [
        ComparedModelSet(f"whole -{name}", models, False, None, name, False)
        for models, name in less.items()
        if models not in seen
    ]
    more = [
        ComparedModelSet(
            f"whole +{name}",
            tuple(m for m in all_models if m in (*whole, name)),
            is_built_up=False,
            added_model=None,
            missing_model=None,
            is_full_set=False,
            extra_model=name,
        )
        for name in all_models
        if name in extra_models and name not in whole
    ]
    return (*built, *ablated, *more)


def list_missing_models(
    scene_models: Sequence[str], all_models: Sequence[str] = MODEL_NAMES
) -> tuple[str, ...]:
    """Return the models of a scene that do not exist."""
    return tuple(name for name in scene_models if name not in all_models)


BATCH_FRAMES: Mapping[str, int] = {"live": 10, "offline": ROWS_PER_STEP}
"""Frames per estimator step, by mode."""
_WARM_UP_STEPS = 30


class RepeatedRecording:
    """Recording that is repeated endlessly, as one stream without gaps."""

    def __init__(self, frames: FrameBatch) -> None:
        self._frames = frames
        self._period_ns = round(float(np.median(np.diff(frames.t_mono_ns))))

    def get_frames(self, begin: int, end: int) -> FrameBatch:
        """Return frames `begin` to `end` of the stream, with rising `seq` and time."""
        n = len(self._frames)
        lap, at = np.divmod(np.arange(begin, end), n)
        once = self._frames.select_rows(at)
        span_ns = int(self._frames.t_mono_ns[-1] - self._frames.t_mono_ns[0]) + self._period_ns
        return replace(
            once,
            seq=np.arange(begin, end, dtype=np.uint64) + self._frames.seq[0],
            t_mono_ns=once.t_mono_ns + lap * span_ns,
            t_ns=once.t_ns + lap * span_ns,
        )


def time_model_sets(
    recording: DrawRecording,
    model_sets: Sequence[ComparedModelSet],
    frames_per_repetition: Mapping[str, int],
    repetitions: int,
    estimator: type[Estimator] = ModelEstimator,
) -> tuple[dict[tuple[str, str], list[float]], list[MeasurementFailure]]:
    """Measure ns per frame in every repetition, by mode and label of the model set.

    Args:
        recording: recording that is estimated repeatedly.
        model_sets: model sets to time.
        frames_per_repetition: frames per repetition, by mode.
        repetitions: number of repetitions.
        estimator: to time.

    Returns:
        The times, and the model sets that could not be timed.
    """
    stream = RepeatedRecording(recording.frames)
    plans: dict[tuple[str, str], EstimationPlan] = {}
    failures = []
    for model_set in model_sets:
        for mode in LAGS_MS:
            try:
                plan = make_recording_plan(recording, model_set.models, LAGS_MS[mode])
                measure_ns_per_frame(
                    estimator(plan), stream, _WARM_UP_STEPS * BATCH_FRAMES[mode], BATCH_FRAMES[mode]
                )
            except Exception as error:
                failures.append(
                    MeasurementFailure(f"time of {model_set.label}, {mode}", describe_error(error))
                )
            else:
                plans[mode, model_set.label] = plan
    times: dict[tuple[str, str], list[float]] = {key: [] for key in plans}
    for _ in range(repetitions):
        for (mode, label), plan in plans.items():
            spent_ns = measure_ns_per_frame(
                estimator(plan), stream, frames_per_repetition[mode], BATCH_FRAMES[mode]
            )
            times[mode, label].append(spent_ns)
    return times, failures


def make_recording_plan(
    recording: DrawRecording, models: tuple[str, ...], lag_ms: float
) -> EstimationPlan:
    """Make the constants of a recording's estimate, with the tare from its lead-in.

    Raises:
        FootTileError: the recording cannot be estimated with these models.
    """
    info, calibration = recording.info, recording.calibration
    tare = compute_recording_tare(
        recording.frames, Compensation(info.tiles), calibration, info.serials
    )
    return make_plan(info, calibration, tare, models=models, lag_ms=lag_ms)


def measure_ns_per_frame(
    estimator: Estimator, stream: RepeatedRecording, frames: int, batch_frames: int
) -> float:
    """Measure the CPU time per frame in ns, over `frames` frames, `batch_frames` per step."""
    spent_ns = 0
    for begin in range(0, frames, batch_frames):
        rows = stream.get_frames(begin, min(begin + batch_frames, frames))
        began_ns = time.thread_time_ns()
        estimator.process_frames(rows)
        spent_ns += time.thread_time_ns() - began_ns
    began_ns = time.thread_time_ns()
    estimator.finish()
    return (spent_ns + time.thread_time_ns() - began_ns) / frames


LAGS_MS: Mapping[str, float] = {"live": 10.0, "offline": 100.0}
"""Look-ahead of the two estimation modes."""

DEFAULT_SCENE_SECONDS = 20.0
"""Duration of a scene without an end."""

_TRUTH = (*(name for name in ACCURACY_COLUMNS if name.startswith("true_")), "true_force_n")


@dataclass(frozen=True)
class DrawRecording:
    """Frames of one draw with their truth, and the calibration of its tiles."""

    info: ArrayInfo
    frames: FrameBatch
    truth: Mapping[str, npt.NDArray[Any]]
    calibration: Calibration


@dataclass(frozen=True)
class DrawTask:
    """Work of one process: one draw of a scene, estimated by all model sets."""

    scene: Scene
    seconds: float | None
    draw: int
    model_sets: tuple[ComparedModelSet, ...]
    estimator: type[Estimator] = ModelEstimator


@dataclass(frozen=True)
class MeasurementFailure:
    """Measurement that failed, with the reason."""

    what: str
    why: str


@dataclass(frozen=True)
class DrawResult:
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
    failures: tuple[MeasurementFailure, ...]


def record_draw(scene: Scene, seconds: float | None, draw: int) -> DrawRecording:
    """Calibrate the tiles of a draw as a user would, and record the scene with them.

    Args:
        scene: scene to run.
        seconds: duration; None: the scene's, or `DEFAULT_SCENE_SECONDS` if it has no end.
        draw: seed of tiles and noise.

    Raises:
        FootTileError: scene or calibration is not usable.
    """
    calibration = find_calibration(
        scene.calibration,
        [tile.serial for tile in scene.tile if not tile.reference],
        chips={tile.serial: tile.chip for tile in scene.tile},
        parts_seed=draw,
        family=scene.emulation.family,
    )
    return record_with_calibration(scene, seconds, draw, calibration)[0]


def record_with_calibration(
    scene: Scene,
    seconds: float | None,
    draw: int,
    calibration: Calibration,
    foot: EmulatedFoot = EmulatedFoot(),  # noqa: B008  # frozen, so one for all is safe
) -> tuple[DrawRecording, World]:
    """Record a scene with calibrated tiles of a draw; also return the emulated world.

    Args:
        scene: scene to run.
        seconds: duration, as for `record_draw`.
        draw: seed of tiles and noise.
        calibration: calibration of the tiles.
        foot: emulated foot; the draw replaces its seeds.

    Raises:
        FootTileError: the scene is not usable.
    """
    with ExitStack() as stack:
        foot = replace(foot, seed=draw, parts_seed=draw)
        options = SimulationOptions(
            scene, seconds, default_seconds=DEFAULT_SCENE_SECONDS, with_truth=True, foot=foot
        )
        simulation = EmulatedRun(options, stack)
        pieces = [
            (frames, {name: extra[name] for name in _TRUTH})
            for frames, extra in simulation.run_frames()
        ]
    recording = DrawRecording(
        simulation.info,
        FrameBatch.concatenate([frames for frames, _ in pieces]),
        concatenate_columns([truth for _, truth in pieces]),
        calibration,
    )
    return recording, simulation.world


def compute_recording_accuracy(
    recording: DrawRecording,
    models: tuple[str, ...],
    lag_ms: float,
    estimator: type[Estimator] = ModelEstimator,
) -> Accuracy:
    """Estimate a recording, with the tare from its lead-in, and compute the errors.

    Raises:
        FootTileError: the recording cannot be estimated with these models.
    """
    columns = compute_estimates(recording, models, lag_ms, ACCURACY_COLUMNS, estimator)
    return compute_accuracy(columns, lag_ms=lag_ms)


def compute_estimates(
    recording: DrawRecording,
    models: tuple[str, ...],
    lag_ms: float,
    column_names: Sequence[str],
    estimator: type[Estimator] = ModelEstimator,
) -> dict[str, npt.NDArray[Any]]:
    """Estimate a recording; return columns of estimates and truth, one row per frame.

    Raises:
        FootTileError: the recording cannot be estimated with these models.
    """
    options = EstimateOptions(
        recording.calibration, models, lag_ms, unquantized=True, estimator=estimator
    )
    stream = EstimateStream(recording.info, options)
    judged: list[Mapping[str, npt.NDArray[Any]]] = []
    for frames, columns in stream.estimate_batches([(recording.frames, recording.truth)]):
        columns["t_ns"] = frames.t_ns
        judged.append({name: np.asarray(columns[name]) for name in column_names})
    return concatenate_columns(judged)


def run_draw(task: DrawTask) -> DrawResult:
    """Record one draw and estimate it by every model set; failures are returned, not raised."""
    try:
        recording = record_draw(task.scene, task.seconds, task.draw)
    except Exception as error:
        return DrawResult(
            task.draw, 0, {}, (MeasurementFailure(f"draw {task.draw}", describe_error(error)),)
        )
    accuracy: dict[tuple[str, str], Accuracy] = {}
    failures = []
    for model_set in task.model_sets:
        for mode, lag_ms in LAGS_MS.items():
            try:
                accuracy[mode, model_set.label] = compute_recording_accuracy(
                    recording, model_set.models, lag_ms, task.estimator
                )
            except Exception as error:
                what = f"draw {task.draw}, {model_set.label}, {mode}"
                failures.append(MeasurementFailure(what, describe_error(error)))
    return DrawResult(task.draw, len(recording.frames), accuracy, tuple(failures))


def describe_error(error: Exception) -> str:
    """Describe an error; an unexpected one with its type."""
    return str(error) if isinstance(error, FootTileError) else f"{type(error).__name__}: {error}"
