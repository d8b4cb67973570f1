"""Runs a reproduction: tiles on the mill in processes, trials in the laboratory, all judged.

One part that fails fails alone: what was not measured is said by name.
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
from service.cli.laboratory import Laboratory, Trial
from service.estimation.calibration import Calibration
from service.estimation.domes import DOMES, PAPER_DOME, Dome
from service.offline.calibration_lookup import EMULATED_RIG, find_calibration, make_rig_scene
from service.offline.process_pool import map_in_processes
from service.offline.reproduce.indentation import (
    DomeResult,
    calibrate_tile,
    evaluate_dome,
    indent_tile,
    make_dome_scene,
    merge_calibrations,
)
from service.offline.reproduce.result import ExperimentResult, Reproduction
from service.offline.reproduce.setups import (
    ROLLING,
    SETUPS,
    TRIALS,
    ExperimentSetup,
    compose_scene_toml,
)
from service.offline.reproduce.trial_evaluation import TrialResult, evaluate_trial
from service.offline.reproduce.trial_plan import TrialPlan, plan_trials
from service.offline.reproduce.unborne_force import compute_not_borne_n
from service.sessions.calibration_file import write_calibration
from service.version import SOFTWARE_VERSION
from storage.durable_files import make_synced_folder, write_atomically

Tell = Callable[[str], None]
QUICK_TRIALS = 1
REPEATED_MAX = 4
"""So many trials may be spoiled, by a machine that stood still, and are repeated. If there are
more, something else is wrong."""


@dataclass(frozen=True)
class ReproduceOptions:
    """How much; see `foottile reproduce --help`."""

    seed: int = 0
    parts_seed: int = 0
    trials: int = TRIALS
    jobs: int = 2
    quick: bool = False

    @property
    def domes(self) -> tuple[Dome, ...]:
        """That are pressed."""
        return (PAPER_DOME,) if self.quick else DOMES

    @property
    def setups(self) -> tuple[ExperimentSetup, ...]:
        """That are recorded."""
        return (ROLLING,) if self.quick else SETUPS


@dataclass
class _Run:
    """A run as far as it is."""

    options: ReproduceOptions
    folder: Path
    tell: Tell
    failures: dict[str, str] = field(default_factory=dict)
    repeated: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, what: str) -> Iterator[None]:
        begin_s = time.monotonic()
        yield
        self.seconds[what] = time.monotonic() - begin_s

    def failed(self, what: str, error: Exception) -> None:
        self.failures[what] = str(error) or type(error).__name__


def reproduce(options: ReproduceOptions, folder: Path, tell: Tell) -> Reproduction:
    """Press, record, download and compare.

    Args:
        options: how much.
        folder: for everything that is recorded; is there.
        tell: told how far it is.

    Raises:
        FootTileError: the server does not start, or the disk takes nothing.
    """
    run = _Run(options, folder, tell)
    with run.timed("mill"):
        domes, calibration = _mill(run)
    experiments: tuple[ExperimentResult, ...] = ()
    if calibration is not None:
        with run.timed("trials"):
            experiments = _experiments(run, calibration)
    return Reproduction(
        software=SOFTWARE_VERSION,
        run_at=datetime.now(UTC).strftime("%Y-%m-%d"),
        seed=options.seed,
        is_shortened=options.quick,
        domes=domes,
        calibration=calibration,
        experiments=experiments,
        not_borne_n=_not_borne_n(run, experiments),
        failures=run.failures,
        seconds=run.seconds,
        notes=_notes(run),
    )


def _notes(run: _Run) -> list[str]:
    options = run.options
    how = (
        "the foot's calibration is that of the emulated bench, kept from before if it was there"
        if options.quick
        else "the foot's four tiles were pressed on it, too, and calibrated"
    )
    return [
        f"The mill runs in virtual time; {how}.",
        "Trials run in real time: a server and, for each trial, a node as processes of their own, "
        f"{options.jobs} of them at a time on {os.cpu_count()} cores, over loopback; the real "
        "driver reads emulated chips. Sessions were sealed by the server, downloaded and compared.",
        "Domes differ by 3 % between loadings, as the paper's.",
        *(f"Trial {name} was repeated, alone: {why}." for name, why in run.repeated.items()),
    ]


def _mill(run: _Run) -> tuple[tuple[DomeResult, ...], Calibration | None]:
    options = run.options
    pressed: dict[str, DomeResult] = {}
    calibrated: dict[str, Calibration] = {}
    serials = () if options.quick else _serials()
    tasks: list[Dome | str] = [*options.domes, *serials]
    work = partial(_pressed, seed=options.seed, parts_seed=options.parts_seed)
    results: Iterator[tuple[Dome | str, DomeResult | Calibration | Exception]]
    results = map_in_processes(work, tasks, min(options.jobs, len(tasks)))
    for number, (task, found) in enumerate(results, 1):
        name = task if isinstance(task, str) else task.name
        run.tell(f"mill: {number} of {len(tasks)} tiles pressed, the last one {name}")
        if isinstance(found, Exception):
            run.failed(f"mill: {name}", found)
        elif isinstance(found, DomeResult):
            pressed[name] = found
        else:
            calibrated[name] = found
    domes = tuple(pressed[dome.name] for dome in options.domes if dome.name in pressed)
    calibration = None
    try:
        if options.quick:
            calibration = find_calibration(
                EMULATED_RIG, _serials(), parts_seed=options.parts_seed, on_progress=run.tell
            )
        elif set(calibrated) == set(serials):
            calibration = merge_calibrations(
                [calibrated[serial] for serial in serials], "reproduce"
            )
    except FootTileError as error:
        run.failed("mill: the foot", error)
    return domes, calibration


def _serials() -> tuple[str, ...]:
    return tuple(tile.serial for tile in load_scene(ROLLING.scene).tile)


def _pressed(
    task: Dome | str, *, seed: int, parts_seed: int
) -> DomeResult | Calibration | FootTileError:
    """Press a dome of Table I, or calibrate a tile of the foot."""
    try:
        if isinstance(task, str):
            return calibrate_tile(make_rig_scene(task), seed=seed, parts_seed=parts_seed)
        return evaluate_dome(
            task, indent_tile(make_dome_scene(task), seed=seed, parts_seed=parts_seed)
        )
    except FootTileError as error:
        return error


def _experiments(run: _Run, calibration: Calibration) -> tuple[ExperimentResult, ...]:
    options = run.options
    _write_scenes(run, calibration)
    planned = plan_trials(options.setups, options.trials, options.seed, run.folder / "references")
    run.tell("trials: starting the server")
    with Laboratory(run.folder) as laboratory:
        judged, spoiled = _recorded(run, laboratory, planned, options.jobs)
        if len(spoiled) <= REPEATED_MAX:
            # One at a time: a machine that was too busy for two may have room for one.
            again = [plan.make_repetition() for plan in spoiled]
            run.repeated |= {plan.trial_name: str(error) for plan, error in spoiled.items()}
            better, spoiled = _recorded(run, laboratory, again, 1)
            judged |= better
    for plan, error in spoiled.items():
        run.failed(plan.trial_name, error)
    grouped = (
        ExperimentResult(
            setup,
            tuple(
                judged[p.trial_name] for p in planned if p.setup is setup and p.trial_name in judged
            ),
        )
        for setup in options.setups
    )
    return tuple(one for one in grouped if one.trials)


def _write_scenes(run: _Run, calibration: Calibration) -> None:
    for name in ("scenes", "references"):
        make_synced_folder(run.folder / name)
    kept = run.folder / "calibration.json"
    write_calibration(kept, calibration)
    for setup in run.options.setups:
        write_atomically(_scene(run, setup), compose_scene_toml(setup, kept).encode())


def _scene(run: _Run, setup: ExperimentSetup) -> Path:
    return run.folder / "scenes" / f"{setup.name}.toml"


def _recorded(
    run: _Run, laboratory: Laboratory, planned: Sequence[TrialPlan], jobs: int
) -> tuple[dict[str, TrialResult], dict[TrialPlan, FootTileError]]:
    """Trials that were recorded and judged, by name, and those that were not."""
    judged: dict[str, TrialResult] = {}
    spoiled: dict[TrialPlan, FootTileError] = {}
    with ThreadPoolExecutor(jobs) as pool:
        futures = {pool.submit(_trial, run, laboratory, plan): plan for plan in planned}
        try:
            for number, future in enumerate(as_completed(futures), 1):
                plan = futures[future]
                try:
                    judged[plan.trial_name] = future.result()
                except FootTileError as error:
                    spoiled[plan] = error
                run.tell(
                    f"trials: {number} of {len(planned)} done, the last one {plan.session_name}"
                )
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            laboratory.end_nodes()
            raise
    return judged, spoiled


def _trial(run: _Run, laboratory: Laboratory, plan: TrialPlan) -> TrialResult:
    arguments = plan.make_node_arguments(_scene(run, plan.setup), run.options.parts_seed)
    recorded = laboratory.record(
        Trial(plan.session_name, arguments, plan.recording_seconds, (plan.reference_path,))
    )
    return evaluate_trial(
        plan.setup,
        plan.session_name,
        recorded.path,
        plan.reference_path,
        lost_frames=recorded.lost_frames,
        missed_slots=recorded.missed_slots,
    )


def _not_borne_n(run: _Run, experiments: tuple[ExperimentResult, ...]) -> dict[str, float]:
    found = {}
    for one in experiments:
        scene = load_scene(str(_scene(run, one.setup)))
        each = [
            compute_not_borne_n(scene, run.options.seed + number, one.setup.trial_seconds)
            for number in range(1, run.options.trials + 1)
        ]
        found[one.setup.name] = sum(each) / len(each)
    return found
