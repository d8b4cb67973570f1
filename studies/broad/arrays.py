"""Evaluation of one random array: calibration on its rig, all scenes and conditions, errors."""

from __future__ import annotations

import math
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats
from devices.chips.pressure_chips import Compensation
from devices.emulation.parts import DomeProperties, make_rng
from devices.emulation.world import DomeEffect, World
from devices.flags import EstimateFlag
from devices.scene.scene_file import Scene, load_scene
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.effects import Effects, Parameter
from service.estimation.records import SIGMAS_95
from service.offline.accuracy import ACCURACY_COLUMNS, PHASES, classify_phases, compute_accuracy
from service.offline.calibration_lookup import EMULATED_RIG, RIG_REFERENCE, find_calibration
from service.offline.worker_pool import map_in_processes
from service.version import SOFTWARE_VERSION
from storage.durable_files import make_synced_folder
from studies.benchmark.draws import (
    LAGS_MS,
    DrawRecording,
    compute_estimates,
    describe_error,
    record_with_calibration,
)
from studies.benchmark.run import describe_machine
from studies.broad.results import (
    FIRST_SEEDS,
    ArrayResult,
    CaseResult,
    PhaseCounts,
    RefusedItem,
    Seeds,
    TileResult,
    get_result_path,
    hash_project_code,
    make_case_key,
    read_result,
    write_result,
)

EVALUATED_COLUMNS = (*ACCURACY_COLUMNS, "force_n", "force_sigma_n", "true_force_n")
FAULTY_TILE_FLAGS = (EstimateFlag.STUCK, EstimateFlag.CLIPPED, EstimateFlag.BASELINE_LOST)
"""Flags of tiles that answer but are faulty."""
UNSATURATED_MARGIN_SIGMAS = 4.0
"""Distance of the settled pressure below the calibrated end, in standard deviations of a reading,
from which a saturation flag is wrong."""
FORCE_EFFECTS: tuple[DomeEffect, ...] = ("gas", "rubber", "hysteresis")
MIN_LOAD_N = 0.5
EFFECT_PERCENTILE = 95


def evaluate_estimates(
    columns: Mapping[str, npt.NDArray[Any]],
    find_unsaturated: Callable[[], Bools],
) -> CaseResult:
    """Compute errors, coverage and flag counts.

    Args:
        columns: `EVALUATED_COLUMNS` of every frame of the recording.
        find_unsaturated: returns `surely_below_end`, (n, tiles); called only if needed,
            because it takes as long as the recording.
    """
    accuracy = compute_accuracy({name: columns[name] for name in ACCURACY_COLUMNS})
    status = columns["estimate_flags"]
    error_n = columns["grf_n"] - columns["true_grf_n"]
    sigma_n = columns["grf_sigma_n"]
    usable = ((status & EstimateFlag.SATURATED) == 0) & np.isfinite(error_n)
    phases = classify_phases(columns["t_ns"], columns["true_grf_n"])
    covered = np.abs(error_n) <= SIGMAS_95 * sigma_n
    # A lower bound has no sigma.
    bounds = np.isfinite(columns["force_n"]) & ~np.isfinite(columns["force_sigma_n"])
    held = columns["true_force_n"] >= columns["force_n"]
    return CaseResult(
        frames=accuracy.frames,
        grf_mae_n=nan_to_none(accuracy.grf_mae_n),
        peak_error_n=nan_to_none(accuracy.peak_error_n),
        cop_p95_m=nan_to_none(accuracy.cop_p95_m),
        flight_mean_n=nan_to_none(accuracy.flight_mean_n),
        phases={
            name: PhaseCounts(
                frames=int(rows.sum()),
                within=int((rows & covered).sum()),
                sigma2=float((sigma_n[rows] ** 2).sum()),
                error2=float((error_n[rows] ** 2).sum()),
            )
            for i, name in enumerate(PHASES)
            for rows in (usable & (phases == i),)
        },
        cop_frames=accuracy.cop_covered.frames,
        cop_within=accuracy.cop_covered.within,
        saturated_frames=accuracy.saturated_frames,
        saturated_tile_frames=int(bounds.sum()),
        wrongly=int((bounds & find_unsaturated()).sum()) if bounds.any() else 0,
        held=int((bounds & held).sum()),
        grf_bounds=accuracy.bounds.frames,
        grf_bounds_held=accuracy.bounds.within,
        after_frames=accuracy.after_saturation.frames,
        after_within=accuracy.after_saturation.within,
        after_saturation_mae_n=nan_to_none(accuracy.after_saturation_mae_n),
        seconds=float(columns["t_ns"][-1] - columns["t_ns"][0]) * 1e-9,
        alarms=_count_alarms(status),
    )


def _count_alarms(status: npt.NDArray[np.uint16]) -> int:
    """Count the onsets of `FAULTY_TILE_FLAGS`."""
    return sum(
        int((np.diff((status & bit) != 0, prepend=False) & ((status & bit) != 0)).sum())
        for bit in FAULTY_TILE_FLAGS
    )


def find_unsaturated_tiles(recording: DrawRecording, world: World) -> Bools:
    """Return which tiles are surely within calibration and chip range, (n, tiles)."""
    t_ns = recording.frames.t_mono_ns
    chip_max_kpa = Compensation(recording.info.tiles).max_kpa
    doubt_kpa = UNSATURATED_MARGIN_SIGMAS * world.scene.emulation.noise_kpa
    unloaded_kpa = np.array([part.seal_kpa for part in world.dome_parts])
    settled_kpa = world.compute_dome_kpa(t_ns, ("gas", "surroundings")) - unloaded_kpa
    return np.asarray(
        (settled_kpa < _get_range_ends_kpa(recording) - doubt_kpa)
        & (world.compute_dome_kpa(t_ns) < chip_max_kpa - doubt_kpa)
    )


def _get_range_ends_kpa(recording: DrawRecording) -> Floats:
    """Return each tile's calibrated gauge pressure range end; infinite for a bare tile."""
    return np.array(
        [
            math.inf
            if tile.reference
            else recording.calibration.get_tile_or_wildcard(tile.serial).range_kpa[1]
            for tile in recording.info.tiles
        ]
    )


def nan_to_none(value: float) -> float | None:
    """Return the number, or None for NaN."""
    return value if math.isfinite(value) else None


def describe_tiles(recording: DrawRecording, world: World) -> tuple[TileResult, ...]:
    """Describe every tile of an array, from a recording at constant temperature."""
    t_ns = recording.frames.t_mono_ns
    whole_kpa = world.compute_dome_kpa(t_ns)
    less_kpa = {name: world.compute_dome_kpa(t_ns, (name,)) for name in FORCE_EFFECTS}
    loaded = recording.truth["true_force_n"] > MIN_LOAD_N
    tiles = []
    for i, serial in enumerate(recording.info.serials):
        part = world.dome_parts[i]
        felt_n = part.compute_static_force_n(whole_kpa[loaded[:, i], i])
        effect_n: dict[str, float] = {
            name: _compute_effect_size_n(felt_n - part.compute_static_force_n(kpa[loaded[:, i], i]))
            for name, kpa in less_kpa.items()
        }
        entry = recording.calibration.get_tile_or_wildcard(serial)
        late_ns = world.chips[i].sample_delay_ns
        tiles.append(_describe_tile(entry, part, late_ns, effect_n))
    return tuple(tiles)


def _compute_effect_size_n(difference_n: Floats) -> float:
    return (
        float(np.percentile(np.abs(difference_n), EFFECT_PERCENTILE)) if len(difference_n) else 0.0
    )


def _describe_tile(
    entry: TileCalibration, part: DomeProperties, late_ns: int, effect_n: dict[str, float]
) -> TileResult:
    effects = entry.effects
    offered = {
        "gas": effects.gas,
        "rubber": effects.rubber,
        "hysteresis": effects.hysteresis,
        "temperature": effects.temperature,
    }
    has = {
        "gas": part.kappa > 0.0,
        "rubber": bool(part.creep_s),
        "hysteresis": part.loop_n > 0.0 or part.viscous_n > 0.0,
    }
    return TileResult(
        serial=entry.serial,
        drawn={
            "gamma": 1.0 / (1.0 - part.kappa),
            "conduction_s": part.conduction_s,
            "late_s": late_ns * 1e-9,
            "gas_lag_s": part.gas_lag_s,
            "creep": sum(part.creep_parts),
            **{f"creep_s_{i}": tau_s for i, tau_s in enumerate(part.creep_s)},
            "loop_n": part.loop_n,
            "viscous_n": part.viscous_n,
        },
        effect_n=effect_n,
        lacks=tuple(name for name, is_there in has.items() if not is_there),
        given=tuple(name for name, effect in offered.items() if effect is not None),
        found=_list_fitted_parameters(effects),
        refused={str(name): reason for name, reason in effects.refused.items()},
        at_bound=effects.at_bound,
    )


def _list_fitted_parameters(effects: Effects) -> dict[str, float]:
    parameters: dict[str, Parameter | None] = {"late_s": effects.late_s}
    if effects.gas is not None:
        parameters |= {"gamma": effects.gas.gamma, "tau_s": effects.gas.tau_s}
    if effects.temperature is not None:
        parameters["gas_lag_s"] = effects.temperature.lag_s
    if effects.rubber is not None:
        parameters |= {f"creep_{i}": part for i, part in enumerate(effects.rubber.part)}
        parameters |= {f"creep_s_{i}": tau for i, tau in enumerate(effects.rubber.tau_s)}
    found: dict[str, float] = {}
    for name, parameter in parameters.items():
        if parameter is not None:
            found |= {name: parameter.value, f"{name}_sigma": parameter.sigma}
    return found


SCENES = ("rolling", "poppy", "mud")
SERIALS = ("T01", "T02", "T03", "T04")
"""Serials of the tiles, the same in all three scenes."""
ROLLING_SCENE_S = 12.0
"""One pass of the arc, back, and half another."""
HEAVY = "heavy"
_HEAVY = {"mass_kg": 3.3, "leg_n_per_m": 2250.0, "strength_n_per_cm3": 1.0}
"""A leg of 3.3 kg on firmer poppy seeds: 28 N within 50 ms, near or beyond the range of the softer
domes."""
CLEAN = "clean"
MAX_REPEATABILITY = 0.03
CONDITIONS: Mapping[str, str] = {
    CLEAN: "repeatability 0, drift 0, white noise",
    "repeatability": "loadings differ as on the array's rig, by 0 to 3 %",
    "correlated": "noise correlated over 10 ms, of the same variance",
    "drift": "gains have drifted by up to 1 % since the calibration",
}


@dataclass(frozen=True)
class ArrayTask:
    """Array to evaluate; `repeatability` None: drawn at random."""

    number: int
    seeds: Seeds
    made_by: str
    repeatability: float | None = None

    @property
    def seed(self) -> int:
        """Seed of its parts, noise and grounds."""
        return FIRST_SEEDS[self.seeds] + self.number


def run_array(task: ArrayTask) -> ArrayResult:
    """Calibrate and evaluate one array; failures are returned, not raised."""
    began_s = time.process_time()
    repeatability = task.repeatability
    if repeatability is None:
        drawn = make_rng(f"repeatability/{task.seed}").uniform(0.0, MAX_REPEATABILITY)
        repeatability = round(float(drawn), 6)
    calibration, refusals = _calibrate_array(task.seed, repeatability)
    bench_s = time.process_time() - began_s
    found: dict[str, CaseResult] = {}
    tiles: tuple[TileResult, ...] = ()
    if calibration is not None:
        for scene, condition in _iterate_cases(repeatability):
            try:
                found_here, tiles_here = _evaluate_case(scene, condition, task.seed, calibration)
            except Exception as error:
                refusals.append(
                    RefusedItem(what=f"{scene.name}, {condition}", why=describe_error(error))
                )
            else:
                found |= found_here
                tiles = tiles_here or tiles
    return ArrayResult(
        number=task.number,
        seeds=task.seeds,
        made_by=task.made_by,
        repeatability=repeatability,
        cpu_bench_s=bench_s,
        cpu_scenes_s=time.process_time() - began_s - bench_s,
        tiles=tiles,
        judged=found,
        tiles_refused=0 if calibration is not None else len(refusals),
        refusals=tuple(refusals),
    )


def _calibrate_array(
    seed: int, repeatability: float
) -> tuple[Calibration | None, list[RefusedItem]]:
    """Calibrate the array; None with the reasons if a tile is refused."""
    entries: list[Calibration] = []
    refusals = []
    with tempfile.TemporaryDirectory(prefix="foottile-broad-") as work:
        for serial in SERIALS:
            try:
                entries.append(
                    find_calibration(
                        EMULATED_RIG,
                        [serial],
                        parts_seed=seed,
                        family="broad",
                        repeatability=repeatability,
                        cache_folder=Path(work),
                    )
                )
            except Exception as error:
                # Without the path of the temporary folder.
                why = re.sub(r"\S*/(?=bench-)", "", describe_error(error))
                refusals.append(RefusedItem(what=f"calibration of {serial}", why=why))
    if refusals:
        return None, refusals
    tiles = tuple(tile for entry in entries for tile in entry.tiles)
    whole = Calibration(
        name=EMULATED_RIG, reference=RIG_REFERENCE, date=entries[0].date, tiles=tiles
    )
    return whole, []


def _iterate_cases(repeatability: float) -> Iterator[tuple[Scene, str]]:
    """Yield every scene under every condition; the heavy leg under one."""
    changes: Mapping[str, Mapping[str, Any]] = {
        CLEAN: {},
        "repeatability": {"repeatability": repeatability},
        "correlated": {"correlated_ms": 10.0},
        "drift": {"gain_drift": 0.01},
    }
    for condition in CONDITIONS:
        for name in SCENES:
            yield _make_broad_scene(load_scene(name), **changes[condition]), condition
    poppy = load_scene("poppy")
    ground = poppy.ground.model_copy(update=_HEAVY)
    yield _make_broad_scene(poppy.model_copy(update={"ground": ground})), HEAVY


def _make_broad_scene(scene: Scene, **changes: Any) -> Scene:
    """Return the scene with broad parts and without the servo, which no figure needs."""
    emulation = scene.emulation.model_copy(update={"family": "broad", **changes})
    return scene.model_copy(update={"emulation": emulation, "servo": None})


def _evaluate_case(
    scene: Scene, condition: str, seed: int, calibration: Calibration
) -> tuple[dict[str, CaseResult], tuple[TileResult, ...]]:
    """Evaluate one recording in both modes; for clean poppy seeds also describe the tiles."""
    seconds = ROLLING_SCENE_S if scene.name == "rolling" else None
    recording, world = record_with_calibration(scene, seconds, seed, calibration)
    below_end = cache(partial(find_unsaturated_tiles, recording, world))
    found = {}
    for mode, lag_ms in LAGS_MS.items():
        columns = compute_estimates(recording, scene.models, lag_ms, EVALUATED_COLUMNS)
        found[make_case_key(scene.name, condition, mode)] = evaluate_estimates(columns, below_end)
    is_reference = scene.name == "poppy" and condition == CLEAN
    return found, describe_tiles(recording, world) if is_reference else ()


@dataclass(frozen=True)
class BroadOptions:
    """Options of the broad benchmark; see `foottile benchmark --help`."""

    arrays: int
    seeds: Seeds
    process_count: int
    folder: Path
    repeatability: float | None = None
    """Standard deviation between loadings in all scenes and rigs; None: drawn for each array."""


@dataclass(frozen=True)
class BroadBenchmarkResult:
    """Result of the broad benchmark."""

    options: BroadOptions
    run_at: str
    """Time of the run, ISO 8601 in UTC."""
    code_hash: str
    """Hash of the code."""
    software: str
    machine: str
    results: tuple[ArrayResult, ...]
    lost_arrays: tuple[RefusedItem, ...]
    """Arrays whose process ended without a result."""


def run_broad_benchmark(
    options: BroadOptions, on_progress: Callable[[str], None]
) -> BroadBenchmarkResult:
    """Evaluate every array without a result file; write each result when it is done.

    Args:
        options: options of the benchmark.
        on_progress: called with the expected run time and progress.

    Raises:
        StorageError: results cannot be written.
    """
    made_by = hash_project_code()
    tasks = [
        ArrayTask(number, options.seeds, made_by, options.repeatability)
        for number in range(options.arrays)
    ]
    make_synced_folder(options.folder / "arrays")
    kept = [_read_reusable_result(options, task) for task in tasks]
    results = [result for result in kept if result is not None]
    left = [task for task, result in zip(tasks, kept, strict=True) if result is None]
    if results:
        on_progress(f"{len(results)} of {options.arrays} arrays are there already")
    lost = []
    # Without any result, run the first array alone to estimate the run time.
    batches = [left] if results else [left[:1], left[1:]]
    for batch in batches:
        if results and batch:
            on_progress(_describe_run_time(results, len(batch), options.process_count))
        jobs = min(options.process_count, len(batch)) if results else 1
        for task, result in map_in_processes(run_array, batch, max(jobs, 1)):
            if isinstance(result, Exception):
                lost.append(RefusedItem(what=f"array {task.number}", why=describe_error(result)))
                continue
            write_result(options.folder, result)
            results.append(result)
            on_progress(f"{len(results)} of {options.arrays} arrays")
    results.sort(key=lambda result: result.number)
    made = datetime.now(UTC).isoformat(timespec="seconds")
    return BroadBenchmarkResult(
        options, made, made_by, SOFTWARE_VERSION, describe_machine(), tuple(results), tuple(lost)
    )


def _read_reusable_result(options: BroadOptions, task: ArrayTask) -> ArrayResult | None:
    result = read_result(get_result_path(options.folder, task.seeds, task.number))
    if result is None or result.made_by != task.made_by:
        return None
    is_requested = task.repeatability in (None, result.repeatability)
    return result if is_requested else None


def _describe_run_time(results: Sequence[ArrayResult], left: int, jobs: int) -> str:
    each_s = sum(result.cpu_bench_s + result.cpu_scenes_s for result in results) / len(results)
    minutes = each_s * left / min(jobs, left) / 60.0
    return (
        f"{left} arrays of about {each_s:.0f} s CPU each, {jobs} at a time: about "
        f"{minutes:.0f} min on a machine that has nothing else to do"
    )
