"""Reproduction of the paper's experiments: tiles under the indenter, trials in the laboratory.

A failed part is reported by name and does not stop the others.

Server and nodes are processes on loopback, started by their commands; their output goes to log
files beside the sessions.
"""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Self

import foottile
from devices.errors import FootTileError, LinkError
from devices.scene.scene_file import load_scene
from service.estimation.calibration import Calibration
from service.estimation.domes import DOMES, PAPER_DOME, Dome
from service.offline.calibration_lookup import EMULATED_RIG, find_calibration, make_rig_scene
from service.offline.worker_pool import map_in_processes
from service.pull import pull_session
from service.sessions.calibration_file import write_calibration
from service.version import SOFTWARE_VERSION
from storage.durable_files import make_synced_folder, write_atomically
from storage.sessions.folder import FRAMES_NAME
from studies.reproduce.experiments import (
    LEAD_S,
    ROLLING,
    SETUPS,
    TRIALS,
    DomeResult,
    ExperimentSetup,
    TrialPlan,
    calibrate_tile,
    compose_scene_toml,
    evaluate_dome,
    indent_tile,
    make_dome_scene,
    merge_calibrations,
    plan_trials,
)
from studies.reproduce.result import (
    ExperimentResult,
    Reproduction,
    TrialResult,
    compute_not_borne_n,
    evaluate_trial,
)
from studies.reproduce.video_angle import AngleComparison, compare_angle_sources

_SERVER_START_TIMEOUT_S = 120.0
"""Timeout of the server's start, which compiles models on a new machine."""
_NODE_START_TIMEOUT_S = 60.0
_SEAL_TIMEOUT_S = 60.0
_STOP_TIMEOUT_S = 15.0
"""Timeout of a node's end, at which it writes the files of its plates."""
_POLL_S = 0.05
PRE_ROLL_S = 5.0
"""Longest pre-roll, which includes the lead and thus the tare."""
_ADDRESS_PREFIX = "FootTile is at "
_PYTHON_CODE = (
    "from devices.realtime import terminate_with_parent; terminate_with_parent(); "
    "from service.cli.main import main; main()"
)


@dataclass(frozen=True)
class RecordingJob:
    """Recording to make of an emulated foot.

    Attributes:
        name: name of node and session.
        arguments: arguments of `foottile node`: scene, seeds, plates.
        seconds: recorded time after the node has connected.
        expected_files: files that the node writes.
    """

    name: str
    arguments: Sequence[str]
    seconds: float
    expected_files: Sequence[Path]


@dataclass(frozen=True)
class RecordedTrial:
    """Downloaded session of a trial.

    Attributes:
        path: file of its frames.
        session: metadata of the server.
        lost_frames: number of lost frames.
        missed_slots: number of slots without a frame.
    """

    path: Path
    session: Mapping[str, Any]
    lost_frames: int
    missed_slots: int


class Laboratory:
    """Running server with a folder for all files; a context manager.

    Args:
        folder: existing folder for data, journals, downloads and logs.

    Raises:
        FootTileError: the server does not start.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stack = ExitStack()
        self._url = ""
        self._token = secrets.token_urlsafe(18)
        self._nodes: list[subprocess.Popen[bytes]] = []
        self._is_closed = False
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        try:
            arguments = ("serve", "--host=127.0.0.1", "--port=0", f"--data={self._folder / 'data'}")
            server = self._start("server", arguments)
            self._url = self._wait_for_address(server)
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop_nodes()
        self._stack.close()

    def stop_nodes(self) -> None:
        """Stop all nodes and start no more; this ends pending `record` calls."""
        with self._lock:
            self._is_closed = True
            for node in self._nodes:
                _stop_process(node)

    def record(self, trial: RecordingJob) -> RecordedTrial:
        """Run a node, record it and download the sealed session; calls may run in parallel.

        Raises:
            FootTileError: the node ends early, the session is not sealed, or a file is missing.
        """
        own = (f"--server={self._url}", f"--name={trial.name}", "--end-with-parent")
        journal = self._folder / "nodes" / trial.name
        with self._lock:
            if self._is_closed:
                raise FootTileError(f"trial {trial.name} was not started: the laboratory is closed")
            arguments = ("node", *own, f"--journal={journal}", *trial.arguments)
            node = self._start(trial.name, arguments)
            self._nodes.append(node)
        try:
            with foottile.connect(self._url, self._token) as server:
                session = self._start_recording(server, trial.name, node)
                _check_keeps_running(trial.seconds, node, trial.name)
                sealed = session.stop().wait_until_sealed(_SEAL_TIMEOUT_S).metadata
                missed = server.node(trial.name)["missed_slots"]
                pulled = pull_session(server, session.id, self._folder / "sessions")
        except foottile.ClientError as error:
            raise LinkError(f"trial {trial.name}: {error}") from error
        finally:
            code = _stop_process(node)
        missing_files = [path for path in trial.expected_files if not path.is_file()]
        if code != 0 or missing_files:
            raise FootTileError(
                f"node {trial.name} ended with code {code}"
                + "".join(f", and without {path.name}" for path in missing_files),
                where=str(self._log_path(trial.name)),
            )
        return RecordedTrial(
            path=self._folder / "sessions" / session.id / FRAMES_NAME,
            session=pulled,
            lost_frames=sum(sealed["lost"].values()),
            missed_slots=int(missed or 0),
        )

    def _start(self, name: str, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
        log = self._log_path(name)
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as file:
            process = subprocess.Popen(  # noqa: S603  # our own program and arguments
                [sys.executable, "-c", _PYTHON_CODE, *arguments],
                env={**os.environ, "PYTHONUNBUFFERED": "1", "FOOTTILE_TOKEN": self._token},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches this process, which stops the node
            )
        self._stack.callback(_stop_process, process)
        return process

    def _log_path(self, name: str) -> Path:
        return self._folder / "logs" / f"{name}.log"

    def _wait_for_address(self, server: subprocess.Popen[bytes]) -> str:
        deadline_s = time.monotonic() + _SERVER_START_TIMEOUT_S
        while time.monotonic() < deadline_s and server.poll() is None:
            for line in self._log_path("server").read_text(errors="replace").splitlines():
                if line.startswith(_ADDRESS_PREFIX):
                    return line.removeprefix(_ADDRESS_PREFIX).strip().rstrip("/")
            time.sleep(_POLL_S)
        raise FootTileError("the server does not start", where=str(self._log_path("server")))

    def _start_recording(
        self, server: foottile.Client, name: str, process: subprocess.Popen[bytes]
    ) -> foottile.RemoteSession:
        """Start recording as soon as the node is connected."""
        deadline_s, reason = time.monotonic() + _NODE_START_TIMEOUT_S, ""
        while time.monotonic() < deadline_s and process.poll() is None:
            try:
                return server.record(name, name, pre_roll_s=PRE_ROLL_S)
            except foottile.ClientError as error:  # not connected yet
                reason = str(error)
                time.sleep(_POLL_S)
        raise FootTileError(f"node {name} does not come: {reason}", where=str(self._log_path(name)))


def _check_keeps_running(seconds: float, process: subprocess.Popen[bytes], name: str) -> None:
    """Wait while a node runs; fail if it ends.

    Raises:
        FootTileError: the node ended.
    """
    try:
        code = process.wait(seconds)
    except subprocess.TimeoutExpired:
        return
    raise FootTileError(f"node {name} has ended by itself, with code {code}")


def _stop_process(process: subprocess.Popen[bytes]) -> int:
    """Stop a process and return its exit code."""
    if process.poll() is None:
        with suppress(ProcessLookupError):
            process.send_signal(signal.SIGTERM)
        try:
            process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
    return process.wait()


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
    films_angle: bool = False
    """True: the angle of `rolling` is also taken from a film."""

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
    with run.measure_time("indenter"):
        domes, calibration = _indent_tiles(run)
    experiments: tuple[ExperimentResult, ...] = ()
    angles = None
    if calibration is not None:
        with run.measure_time("trials"):
            experiments = _run_experiments(run, calibration)
        if options.films_angle:
            with run.measure_time("film"):
                angles = _film_angle(run, calibration)
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
        angles=angles,
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


def _film_angle(run: _Run, calibration: Calibration) -> AngleComparison | None:
    run.report_step("film: rolling, with the angle from video")
    try:
        return compare_angle_sources(
            load_scene(str(_get_scene_path(run, ROLLING))),
            calibration,
            seconds=LEAD_S + ROLLING.trial_seconds,
            seed=run.options.seed,
            parts_seed=run.options.parts_seed,
        )
    except FootTileError as error:
        run.add_failure("film: the angle", error)
        return None


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
