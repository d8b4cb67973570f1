"""Calibrations of a server, uploaded or fitted here: their jobs, and their assignment to nodes.

An id is the hash of the content, so a calibration never changes: other content is another
calibration. Nodes and sessions copy the one they use, so a calibration may be deleted at any time.

A job runs in a separate process at low priority, one at a time, so that recording goes on. Its
calibration is stored whole or not at all; the process ends with the server.
"""

from __future__ import annotations

import asyncio
import logging
import os
import re
import secrets
import sys
import tempfile
from collections import OrderedDict, deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import Field

from devices.clock import server_utc_ns
from devices.errors import (
    CalibrationError,
    FileFormatError,
    FootTileError,
    StateError,
    StorageError,
    UnknownError,
    UsageError,
)
from devices.types import StrictModel
from service.estimation.calibration import Calibration
from service.protocol.live import View
from service.server.session_store import SessionStore
from service.sessions.calibration_file import encode_calibration, parse_calibration
from storage.documents import read_document, write_document
from storage.durable_files import (
    ASIDE_SUFFIX,
    make_synced_folder,
    read_small_file,
    sync_folder,
    translate_storage_errors,
    try_set_aside_and_describe,
    write_atomically,
)
from storage.sessions.folder import FRAMES_NAME

CALIBRATIONS_MAX = 1000
CONTENT_BYTES_MAX = 1 << 20
"""Size limit, that of a message of the link: a node cannot send a longer one either."""
CALIBRATION_ID = re.compile(r"[0-9a-f]{16}")
_ASSIGN_AGAIN = "assign a calibration again, or unassign it"


class CalibrationSummaryView(View):
    """Summary of a calibration."""

    id: str = Field(description="Hash of its content.", examples=["983bbbe1624bad0b"])
    name: str
    reference: str = Field(description="Force sensor of its scale.")
    date: str = Field(description="Date of the recordings, ISO 8601.")
    serials: list[str] = Field(description="Tiles with a curve; `*`: any tile.")
    refused: list[str] = Field(
        description="Tiles without a curve, although recorded; the file has the reasons."
    )
    absolute_scale: Literal["measured", "assumed"]
    mounted: bool = Field(description="True: a force plate has shown how its tiles are mounted.")

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> CalibrationSummaryView:
        """Return the summary of a calibration."""
        serials = [tile.serial for tile in calibration.tiles]
        return cls(
            id=calibration.id,
            name=calibration.name,
            reference=calibration.reference,
            date=calibration.date,
            serials=serials,
            refused=list(calibration.refused),
            absolute_scale="assumed" if calibration.has_assumed_scale(serials) else "measured",
            mounted=calibration.mounted is not None,
        )


class CalibrationStore:
    """Calibrations of a data folder; a damaged file is set aside and not listed.

    Args:
        folder: folder of the files; created with the first one.

    Raises:
        StorageError: the folder cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._summaries: dict[str, CalibrationSummaryView] = {}
        self.problems: list[str] = []
        with translate_storage_errors(folder):
            paths = sorted(folder.glob("*.json"))
        for path in paths:
            if not CALIBRATION_ID.fullmatch(path.stem):
                continue
            try:
                calibration = self._read_file(path.stem)
            except (CalibrationError, FileFormatError) as error:
                self.problems.append(f"a calibration: {try_set_aside_and_describe(path, error)}")
            except FootTileError as error:
                self.problems.append(f"a calibration is left out: {error}")
            else:
                self._summaries[path.stem] = CalibrationSummaryView.from_calibration(calibration)

    def list_all(self) -> list[CalibrationSummaryView]:
        """Return the summaries of all calibrations, the newest recordings first."""
        return sorted(self._summaries.values(), key=lambda kept: (kept.date, kept.id), reverse=True)

    def load(self, calibration_id: str) -> Calibration:
        """Load a calibration from the disk.

        Raises:
            UnknownError: no calibration has this id.
            StateError: its file is damaged or was deleted.
            StorageError: it cannot be read now.
        """
        if calibration_id not in self._summaries:
            raise UnknownError(
                f"no calibration {calibration_id[:80]!r}",
                expected="the id of one that was uploaded or fitted here",
            )
        try:
            return self._read_file(calibration_id)
        except (CalibrationError, FileFormatError, FileNotFoundError) as error:
            raise StateError(
                f"calibration {calibration_id} is damaged: {error}", remedy="Upload it again"
            ) from error

    def save(self, calibration: Calibration) -> CalibrationSummaryView:
        """Save a calibration atomically; the same content twice is one calibration.

        Raises:
            StateError: the store is full.
            StorageError: it cannot be written.
        """
        summary = CalibrationSummaryView.from_calibration(calibration)
        if summary.id not in self._summaries and len(self._summaries) >= CALIBRATIONS_MAX:
            raise StateError(
                f"this server keeps {len(self._summaries)} calibrations already",
                remedy="Delete unused ones",
            )
        with translate_storage_errors(self._folder):
            make_synced_folder(self._folder)
        write_atomically(self._path(summary.id), encode_calibration(calibration))
        self._summaries[summary.id] = summary
        return summary

    def delete_leaving_copies_in_use(self, calibration_id: str) -> None:
        """Delete a calibration; nodes and sessions that use it have a copy.

        Raises:
            UnknownError: no calibration has this id.
            StorageError: it cannot be deleted.
        """
        if calibration_id not in self._summaries:
            raise UnknownError(f"no calibration {calibration_id[:80]!r}")
        path = self._path(calibration_id)
        with translate_storage_errors(path):
            path.unlink(missing_ok=True)
            sync_folder(self._folder)
        del self._summaries[calibration_id]

    def _path(self, calibration_id: str) -> Path:
        return self._folder / f"{calibration_id}.json"

    def _read_file(self, calibration_id: str) -> Calibration:
        path = self._path(calibration_id)
        calibration = parse_calibration(read_small_file(path), where=str(path))
        if calibration.id != calibration_id:
            raise CalibrationError(f"it is {calibration.id}", where=str(path))
        return calibration


log = logging.getLogger("foottile.fits")

JOB_SESSIONS_MAX = 32
FRAMES_MAX = 1_000_000
"""Half an hour of the fastest array; all frames are in memory at once."""
_JOBS_KEPT = 16
"""Number of ended jobs that are listed, the newest."""
_LOG_LINES_KEPT = 300
"""Number of log lines: more than an array has tiles."""
_LINE_BYTES = 4000
_JOB_TIMEOUT_S = 1800.0
"""Time limit, against a process that hangs."""
_NICENESS = 15
_CALIBRATE_COMMAND = (
    sys.executable,
    "-c",
    "from service.cli.main import main; main()",
    "calibrate",
)
_EXIT_TILE_REFUSED = 3
"""Exit code of `foottile calibrate`: file written, but a tile was refused."""

JobState = Literal["running", "done", "failed", "cancelled"]


@dataclass
class CalibrationJob:
    """State of a calibration job."""

    id: str
    name: str
    sessions: tuple[str, ...]
    started_t_ns: int
    state: JobState = "running"
    ended_t_ns: int | None = None
    log: deque[str] = field(default_factory=lambda: deque(maxlen=_LOG_LINES_KEPT))
    """Log of the job up to now, a line per tile."""
    calibration_id: str | None = None
    problem: str | None = None
    """Reason of a failure."""


class CalibrationJobs:
    """Calibration jobs of a server; at most one is running.

    Args:
        sessions: store of the sessions to fit.
        calibrations: store of the results.
    """

    def __init__(self, sessions: SessionStore, calibrations: CalibrationStore) -> None:
        self._sessions = sessions
        self._calibrations = calibrations
        self._jobs: OrderedDict[str, CalibrationJob] = OrderedDict()
        self._task: asyncio.Task[None] | None = None
        self._running: CalibrationJob | None = None

    @property
    def is_busy(self) -> bool:
        """True if a job is running."""
        return self._running is not None

    def list_jobs_newest_first(self) -> list[CalibrationJob]:
        """Return the known jobs, newest first."""
        return [*reversed(self._jobs.values())]

    def get_job(self, job_id: str) -> CalibrationJob:
        """Return a job.

        Raises:
            UnknownError: no known job has this id.
        """
        if job_id not in self._jobs:
            raise UnknownError(
                f"no fit {job_id[:80]!r}",
                expected=f"one of the last {_JOBS_KEPT} since the server was started",
            )
        return self._jobs[job_id]

    def start_job(
        self, name: str, sessions: Sequence[str], options: Mapping[str, str]
    ) -> CalibrationJob:
        """Start to fit test-rig recordings; called on the event loop.

        Args:
            name: name of the calibration.
            sessions: ids of sessions; repeats of a tile may be spread over several.
            options: further options of `foottile calibrate`, by name.

        Raises:
            UnknownError: no session has this id.
            StateError: a session is not sealed, or another job is running.
            UsageError: a session is named twice, or the sessions are too long.
        """
        if self._running is not None:
            raise StateError(
                f"calibration {self._running.name!r} is being fitted",
                remedy="Wait until it is done, or cancel it",
            )
        ids = tuple(dict.fromkeys(sessions))
        if len(ids) < len(sessions):
            raise UsageError("a session is named twice", remedy="Name each once")
        found = [self._sessions.get_session(one) for one in ids]
        for session in found:
            if session.sha256 is None:
                raise StateError(
                    f"session {session.id} is {session.state} and has no sealed file",
                    expected="sealed sessions",
                )
        frames = sum(session.frames for session in found)
        if frames > FRAMES_MAX:
            raise UsageError(
                f"these sessions have {frames} frames",
                expected=f"at most {FRAMES_MAX} in one fit",
                remedy="Fit fewer, or pull them and run `foottile calibrate`",
            )
        fit = CalibrationJob(secrets.token_hex(6), name, ids, server_utc_ns())
        self._jobs[fit.id] = fit
        while len(self._jobs) > _JOBS_KEPT:
            self._jobs.popitem(last=False)
        folder = self._sessions.folder
        paths = [folder.get_path(one) / FRAMES_NAME for one in ids]
        self._running = fit
        self._task = asyncio.get_running_loop().create_task(self._run(fit, paths, options))
        return fit

    async def cancel_job(self, job_id: str) -> CalibrationJob:
        """Cancel a running job and drop its result; an ended job is unchanged.

        Raises:
            UnknownError: no known job has this id.
        """
        fit = self.get_job(job_id)
        if fit is self._running:
            await self.cancel_running_job_and_wait()
        return fit

    async def cancel_running_job_and_wait(self) -> None:
        """Cancel the running job, if any, and wait for its end."""
        if self._task is None or self._running is None:
            return
        fit, task = self._running, self._task
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        if fit.state == "running":  # the task had not started
            self._finish_job(fit, "cancelled")

    async def _run(
        self, fit: CalibrationJob, paths: list[Path], options: Mapping[str, str]
    ) -> None:
        try:
            with tempfile.TemporaryDirectory(prefix="foottile-fit-") as folder:
                out = Path(folder) / "calibration.json"
                await self._run_process(fit, paths, out, options)
                content = await asyncio.to_thread(read_small_file, out)
                found = await asyncio.to_thread(parse_calibration, content, where=str(out))
                fit.calibration_id = self._calibrations.save(found).id
            self._finish_job(fit, "done")
        except asyncio.CancelledError:
            self._finish_job(fit, "cancelled")
        except (FootTileError, OSError) as error:
            fit.problem = str(error)
            self._finish_job(fit, "failed")
        except Exception as error:
            log.exception("fit %s: this is a bug", fit.id)
            fit.problem = f"internal error: {error!r}"
            self._finish_job(fit, "failed")

    def _finish_job(self, fit: CalibrationJob, state: JobState) -> None:
        fit.state, fit.ended_t_ns = state, server_utc_ns()
        self._running = self._task = None

    async def _run_process(
        self, fit: CalibrationJob, paths: list[Path], out: Path, options: Mapping[str, str]
    ) -> None:
        """Run the process that writes the calibration to `out`.

        Raises:
            StateError: the process failed.
        """
        all_options = {"name": fit.name, **options}
        process = await asyncio.create_subprocess_exec(
            *(*_CALIBRATE_COMMAND, f"--out={out}"),
            *(f"--{name.replace('_', '-')}={value}" for name, value in all_options.items()),
            *("--", *map(str, paths)),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the server
        )
        try:
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
            async with asyncio.timeout(_JOB_TIMEOUT_S):
                await self._read_log(fit, process)
                code = await process.wait()
        except TimeoutError as error:
            raise StateError(f"not finished after {_JOB_TIMEOUT_S:.0f} s") from error
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        if code not in (0, _EXIT_TILE_REFUSED):
            last = fit.log[-1] if fit.log else f"the process ended with {code}"
            raise StateError(last.removeprefix("foottile: "))

    @staticmethod
    async def _read_log(fit: CalibrationJob, process: asyncio.subprocess.Process) -> None:
        assert process.stderr is not None  # noqa: S101  # it was asked for
        rest = b""
        while piece := await process.stderr.read(_LINE_BYTES):
            *lines, rest = (rest + piece).split(b"\n")
            rest = rest[-_LINE_BYTES:]
            fit.log.extend(line.decode(errors="replace")[:1000] for line in lines if line.strip())
        if rest.strip():
            fit.log.append(rest.decode(errors="replace")[:1000])


class AssignedCalibration(StrictModel):
    """Assignment of a calibration as its file has it; without one the node's own is in use."""

    t_ns: int
    calibration: Calibration | None
    """None: the assignment was removed."""


class CalibrationAssignment:
    """Assignment for one node.

    Args:
        path: file of the assignment.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.current: AssignedCalibration | None = None
        """None: the node's own calibration is used, unless `problem` is set."""
        self.problem: str | None = None
        """Reason why the assignment is unknown; None: it is known, or there is none."""
        try:
            found = read_document(path, AssignedCalibration)
            self.current = None if found.calibration is None else found
        except FileNotFoundError:
            if any(path.parent.glob(path.name + ASIDE_SUFFIX + "*")):
                self.problem = f"the calibration that was assigned is lost: {_ASSIGN_AGAIN}"
        except FileFormatError as error:
            aside = try_set_aside_and_describe(path, error)
            self.problem = f"the calibration that was assigned is lost ({aside}): {_ASSIGN_AGAIN}"
        except StorageError as error:
            self.problem = f"the calibration that was assigned cannot be read: {error}"

    def store_assignment(self, calibration: Calibration | None, t_ns: int) -> None:
        """Store the calibration to use from now on; None: the node's own again.

        Raises:
            StorageError: that cannot be stored; the assignment is unchanged.
        """
        with translate_storage_errors(self._path):
            make_synced_folder(self._path.parent)
        assigned = AssignedCalibration(t_ns=t_ns, calibration=calibration)
        write_document(self._path, assigned)
        self.current, self.problem = (None if calibration is None else assigned), None
