"""Run over many arrays, resumable, with an estimate of its run time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from service.offline.benchmark.broad.arrays import ArrayTask, run_array
from service.offline.benchmark.broad.results import (
    ArrayResult,
    Refusal,
    Seeds,
    code_id,
    path_of,
    read_result,
    write_result,
)
from service.offline.benchmark.draws import reason
from service.offline.benchmark.run import machine
from service.offline.processes import spread
from service.version import SOFTWARE
from storage.durable import make_folder


@dataclass(frozen=True)
class BroadOptions:
    """Options of the broad benchmark; see `foottile benchmark --help`."""

    arrays: int
    seeds: Seeds
    jobs: int
    folder: Path
    repeatability: float | None = None
    """Standard deviation between loadings in all scenes and rigs; None: drawn for each array."""


@dataclass(frozen=True)
class BroadBench:
    """Result of the broad benchmark."""

    options: BroadOptions
    made: str
    """Time of the run, ISO 8601 in UTC."""
    made_by: str
    """Hash of the code."""
    software: str
    machine: str
    results: tuple[ArrayResult, ...]
    lost: tuple[Refusal, ...]
    """Arrays whose process ended without a result."""


def run_broad(options: BroadOptions, tell: Callable[[str], None]) -> BroadBench:
    """Evaluate every array without a result file; write each result when it is done.

    Args:
        options: options of the benchmark.
        on_progress: called with the expected run time and progress.

    Raises:
        StorageError: results cannot be written.
    """
    made_by = code_id()
    tasks = [
        ArrayTask(number, options.seeds, made_by, options.repeatability)
        for number in range(options.arrays)
    ]
    make_folder(options.folder / "arrays")
    kept = [_kept(options, task) for task in tasks]
    results = [result for result in kept if result is not None]
    left = [task for task, result in zip(tasks, kept, strict=True) if result is None]
    if results:
        tell(f"{len(results)} of {options.arrays} arrays are there already")
    lost = []
    # Without any result, run the first array alone to estimate the run time.
    batches = [left] if results else [left[:1], left[1:]]
    for batch in batches:
        if results and batch:
            tell(_cost(results, len(batch), options.jobs))
        jobs = min(options.jobs, len(batch)) if results else 1
        for task, result in spread(run_array, batch, max(jobs, 1)):
            if isinstance(result, Exception):
                lost.append(Refusal(what=f"array {task.number}", why=reason(result)))
                continue
            write_result(options.folder, result)
            results.append(result)
            tell(f"{len(results)} of {options.arrays} arrays")
    results.sort(key=lambda result: result.number)
    made = datetime.now(UTC).isoformat(timespec="seconds")
    return BroadBench(options, made, made_by, SOFTWARE, machine(), tuple(results), tuple(lost))


def _kept(options: BroadOptions, task: ArrayTask) -> ArrayResult | None:
    result = read_result(path_of(options.folder, task.seeds, task.number))
    if result is None or result.made_by != task.made_by:
        return None
    is_asked = task.repeatability in (None, result.repeatability)
    return result if is_asked else None


def _cost(results: Sequence[ArrayResult], left: int, jobs: int) -> str:
    each_s = sum(result.cpu_bench_s + result.cpu_scenes_s for result in results) / len(results)
    minutes = each_s * left / min(jobs, left) / 60.0
    return (
        f"{left} arrays of about {each_s:.0f} s CPU each, {jobs} at a time: about "
        f"{minutes:.0f} min on a machine that has nothing else to do"
    )
