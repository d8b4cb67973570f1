"""Run over many arrays, resumable, with an estimate of its run time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from service.offline.process_pool import map_in_processes
from service.version import SOFTWARE_VERSION
from storage.durable_files import make_synced_folder
from studies.benchmark.draws import describe_error
from studies.benchmark.run import describe_machine
from studies.broad.arrays import ArrayTask, run_array
from studies.broad.results import (
    ArrayResult,
    RefusedItem,
    Seeds,
    get_result_path,
    hash_project_code,
    read_result,
    write_result,
)


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
