"""Reproduction of the paper's experiments: tiles under the indenter, trials in the laboratory.

A failed part is reported by name and does not stop the others.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from devices.errors import FootTileError
from devices.scene.scene_file import load_scene
from service.estimation.calibration import Calibration
from service.estimation.domes import DOMES, PAPER_DOME, Dome
from service.offline.calibration_lookup import EMULATED_RIG, find_calibration, make_rig_scene
from service.offline.process_pool import map_in_processes
from service.sessions.calibration_file import write_calibration
from service.version import SOFTWARE_VERSION
from storage.durable_files import make_synced_folder, write_atomically
from studies.reproduce.evaluation import TrialResult, compute_not_borne_n, evaluate_trial
from studies.reproduce.indentation import (
    DomeResult,
    calibrate_tile,
    evaluate_dome,
    indent_tile,
    make_dome_scene,
    merge_calibrations,
)
from studies.reproduce.laboratory import Laboratory, RecordingJob
from studies.reproduce.result import ExperimentResult, Reproduction
from studies.reproduce.trials import (
    ROLLING,
    SETUPS,
    TRIALS,
    ExperimentSetup,
    TrialPlan,
    compose_scene_toml,
    plan_trials,
)

ReportStep = Callable[[str], None]
QUICK_TRIALS = 1
REPEATED_MAX = 4
"""Most failed trials that are repeated: a busy machine spoils a few; more have another cause."""


@dataclass(frozen=True)
class ReproduceOptions:
    """Options of `foottile reproduce`."""

    seed: int = 0
    parts_seed: int = 0
    trials: int = TRIALS
    jobs: int = 2
    quick: bool = False

    @property
    def domes(self) -> tuple[Dome, ...]:
        """Domes under the indenter."""
        return (PAPER_DOME,) if self.quick else DOMES

    @property
    def setups(self) -> tuple[ExperimentSetup, ...]:
        """Experiments to record."""
        return (ROLLING,) if self.quick else SETUPS


@dataclass
class _Run:
    """State of a running reproduction."""

    options: ReproduceOptions
    folder: Path
    report_step: ReportStep
    failures: dict[str, str] = field(default_factory=dict)
    repeated: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def measure_time(self, what: str) -> Iterator[None]:
        begin_s = time.monotonic()
        yield
        self.seconds[what] = time.monotonic() - begin_s

    def add_failure(self, what: str, error: Exception) -> None:
        self.failures[what] = str(error) or type(error).__name__


def run_reproduction(options: ReproduceOptions, folder: Path, report: ReportStep) -> Reproduction:
    """Load tiles, record trials, download and compare.

    Args:
        options: extent of the reproduction.
        folder: existing folder for all recordings.
        report: receives progress messages.

    Raises:
        FootTileError: the server does not start, or the disk is not writable.
    """
    run = _Run(options, folder, report)
    with run.measure_time("mill"):
        domes, calibration = _indent_tiles(run)
    experiments: tuple[ExperimentResult, ...] = ()
    if calibration is not None:
        with run.measure_time("trials"):
            experiments = _run_experiments(run, calibration)
    return Reproduction(
        software=SOFTWARE_VERSION,
        run_at=datetime.now(UTC).strftime("%Y-%m-%d"),
        seed=options.seed,
        is_shortened=options.quick,
        domes=domes,
        calibration=calibration,
        experiments=experiments,
        not_borne_n=_compute_not_borne_n(run, experiments),
        failures=run.failures,
        seconds=run.seconds,
        notes=_make_notes(run),
    )


def _make_notes(run: _Run) -> list[str]:
    options = run.options
    how = (
        "the foot has the calibration of the emulated rig, cached if available"
        if options.quick
        else "it also loaded and calibrated the foot's four tiles"
    )
    return [
        f"The indenter runs in virtual time; {how}.",
        "Trials run in real time: a server and a node for each trial, in processes over loopback, "
        f"{options.jobs} at a time on {os.cpu_count()} cores; the real driver reads emulated "
        "chips. The server sealed the sessions; they were downloaded and compared.",
        "Domes differ by 3 % between loadings, as in the paper.",
        *(f"Trial {name} was repeated, alone: {reason}." for name, reason in run.repeated.items()),
    ]


def _indent_tiles(run: _Run) -> tuple[tuple[DomeResult, ...], Calibration | None]:
    options = run.options
    dome_results: dict[str, DomeResult] = {}
    calibrations: dict[str, Calibration] = {}
    serials = () if options.quick else _list_serials()
    tasks: list[Dome | str] = [*options.domes, *serials]
    work = partial(_indent, seed=options.seed, parts_seed=options.parts_seed)
    results: Iterator[tuple[Dome | str, DomeResult | Calibration | Exception]]
    results = map_in_processes(work, tasks, min(options.jobs, len(tasks)))
    for number, (task, found) in enumerate(results, 1):
        name = task if isinstance(task, str) else task.name
        run.report_step(f"indenter: {number} of {len(tasks)} tiles, last {name}")
        if isinstance(found, Exception):
            run.add_failure(f"indenter: {name}", found)
        elif isinstance(found, DomeResult):
            dome_results[name] = found
        else:
            calibrations[name] = found
    domes = tuple(dome_results[dome.name] for dome in options.domes if dome.name in dome_results)
    calibration = None
    try:
        if options.quick:
            seed, report_step = options.parts_seed, run.report_step
            calibration = find_calibration(
                EMULATED_RIG, _list_serials(), parts_seed=seed, on_progress=report_step
            )
        elif set(calibrations) == set(serials):
            calibration = merge_calibrations([calibrations[each] for each in serials], "reproduce")
    except FootTileError as error:
        run.add_failure("indenter: the foot", error)
    return domes, calibration


def _list_serials() -> tuple[str, ...]:
    return tuple(tile.serial for tile in load_scene(ROLLING.scene).tile)


def _indent(
    task: Dome | str, *, seed: int, parts_seed: int
) -> DomeResult | Calibration | FootTileError:
    """Evaluate a dome of Table I, or calibrate a tile of the foot."""
    try:
        if isinstance(task, str):
            return calibrate_tile(make_rig_scene(task), seed=seed, parts_seed=parts_seed)
        return evaluate_dome(
            task, indent_tile(make_dome_scene(task), seed=seed, parts_seed=parts_seed)
        )
    except FootTileError as error:
        return error


def _run_experiments(run: _Run, calibration: Calibration) -> tuple[ExperimentResult, ...]:
    options = run.options
    _write_scenes(run, calibration)
    planned = plan_trials(options.setups, options.trials, options.seed, run.folder / "references")
    run.report_step("trials: starting the server")
    with Laboratory(run.folder) as laboratory:
        results, failures = _record_trials(run, laboratory, planned, options.jobs)
        if len(failures) <= REPEATED_MAX:
            # One at a time: a machine too busy for two trials may manage one.
            again = [plan.make_repetition() for plan in failures]
            run.repeated |= {plan.trial_name: str(error) for plan, error in failures.items()}
            better, failures = _record_trials(run, laboratory, again, 1)
            results |= better
    for plan, error in failures.items():
        run.add_failure(plan.trial_name, error)
    done = [plan for plan in planned if plan.trial_name in results]
    grouped = (
        ExperimentResult(
            setup, tuple(results[plan.trial_name] for plan in done if plan.setup is setup)
        )
        for setup in options.setups
    )
    return tuple(one for one in grouped if one.trials)


def _write_scenes(run: _Run, calibration: Calibration) -> None:
    for name in ("scenes", "references"):
        make_synced_folder(run.folder / name)
    path = run.folder / "calibration.json"
    write_calibration(path, calibration)
    for setup in run.options.setups:
        write_atomically(_get_scene_path(run, setup), compose_scene_toml(setup, path).encode())


def _get_scene_path(run: _Run, setup: ExperimentSetup) -> Path:
    return run.folder / "scenes" / f"{setup.name}.toml"


def _record_trials(
    run: _Run, laboratory: Laboratory, planned: Sequence[TrialPlan], jobs: int
) -> tuple[dict[str, TrialResult], dict[TrialPlan, FootTileError]]:
    """Return the results of evaluated trials by name, and the errors of failed ones."""
    results: dict[str, TrialResult] = {}
    failures: dict[TrialPlan, FootTileError] = {}
    with ThreadPoolExecutor(jobs) as pool:
        futures = {pool.submit(_run_trial, run, laboratory, plan): plan for plan in planned}
        try:
            for number, future in enumerate(as_completed(futures), 1):
                plan = futures[future]
                try:
                    results[plan.trial_name] = future.result()
                except FootTileError as error:
                    failures[plan] = error
                run.report_step(f"trials: {number} of {len(planned)}, last {plan.session_name}")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            laboratory.stop_nodes()
            raise
    return results, failures


def _run_trial(run: _Run, laboratory: Laboratory, plan: TrialPlan) -> TrialResult:
    arguments = plan.make_node_arguments(_get_scene_path(run, plan.setup), run.options.parts_seed)
    recorded = laboratory.record(
        RecordingJob(plan.session_name, arguments, plan.recording_seconds, (plan.reference_path,))
    )
    return evaluate_trial(
        plan.setup,
        plan.session_name,
        recorded.path,
        plan.reference_path,
        lost_frames=recorded.lost_frames,
        missed_slots=recorded.missed_slots,
    )


def _compute_not_borne_n(run: _Run, experiments: tuple[ExperimentResult, ...]) -> dict[str, float]:
    found = {}
    for one in experiments:
        scene = load_scene(str(_get_scene_path(run, one.setup)))
        each = [
            compute_not_borne_n(scene, run.options.seed + number, one.setup.trial_seconds)
            for number in range(1, run.options.trials + 1)
        ]
        found[one.setup.name] = sum(each) / len(each)
    return found
