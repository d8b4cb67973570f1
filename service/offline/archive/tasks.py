"""Tasks that are applied to each of many sessions: each has options, and makes files of a session.

Options are values, not file names: a worker on another machine cannot read the client's files.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

from devices.errors import UsageError
from service.estimation.calibration import Calibration
from service.offline.archive.staging import claims_of, frames_of, identity_of_file, staged_file
from service.offline.estimate.request import PIECE_FRAMES, EstimateRequest
from service.offline.export import ExportOptions, export_session
from service.plain_json import plain
from storage.checked_json import with_check
from storage.clock.file import CLOCK_NAME
from storage.file_hash import sha256_of
from storage.formats.slice import Slice
from storage.formats.written.registry import format_named
from storage.sessions.beside import EVENTS_NAME
from storage.sessions.claims import LEDGER_NAME, PULLED_EVENTS_NAME, SESSION_NAME, bytes_of
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.reader import SessionReader
from storage.verify.data import verdict_of, verify

if TYPE_CHECKING:
    from service.offline.comparison import CompareOptions
    from service.offline.estimate.session import Estimated

_BESIDE = (EVENTS_NAME, CLOCK_NAME, LEDGER_NAME, PULLED_EVENTS_NAME)

_ALL = Slice()


class Task(Protocol):
    """Operation on one session."""

    @property
    def command(self) -> str:
        """Name of the command, used in the names of notes and reports."""

    def options(self) -> dict[str, Any]:
        """Return the options as JSON values."""

    def run(self, source: Path, work: Path) -> dict[str, Any]:
        """Process one session.

        Args:
            source: the session's folder or file.
            work: empty folder for the result's files; the caller makes them durable.

        Returns:
            Report of the task, as JSON values.

        Raises:
            FootTileError: this session cannot be processed.
        """


@runtime_checkable
class LongTask(Task, Protocol):
    """Task that processes a long session in consecutive chunks."""

    PIECES: ClassVar[tuple[str, ...]]
    """Suffixes of the files of earlier chunks that the next chunk needs."""

    def is_long(self, source: Path) -> bool:
        """Return whether the session needs more than one chunk."""

    def make_piece(self, source: Path, folder: Path) -> bool:
        """Process the next chunk.

        Args:
            source: as for `run`.
            folder: folder of the chunks; the new one is written to it.

        Returns:
            False if all chunks existed already.

        Raises:
            FootTileError: as for `run`.
        """

    def join(self, source: Path, folder: Path, work: Path) -> dict[str, Any]:
        """Make the result of `run` from the folder of the chunks."""


@dataclass(frozen=True)
class EstimateTask(EstimateRequest):
    """Re-estimation of a session; the result is a session's folder if the source is one.

    Attributes:
        piece_frames: frames of a chunk of a long session; the result does not depend on it.
    """

    piece_frames: int = PIECE_FRAMES
    command: ClassVar[str] = "estimate"
    PIECES: ClassVar[tuple[str, ...]] = ("json", "npz")

    def options(self) -> dict[str, Any]:
        """See `Task`."""
        named = self.calibration
        return {
            **{name: value for name, value in vars(self).items() if name != "piece_frames"},
            "calibration": named.id if isinstance(named, Calibration) else named,
            "scene": None if self.scene is None else self.scene.model_dump(mode="json"),
            "part": vars(self.part),
        }

    def run(self, source: Path, work: Path) -> dict[str, Any]:
        """See `Task`."""
        from service.offline.estimate.session import estimate_session

        frames, remarks = frames_of(source), list[str]()
        out = work / FRAMES_NAME
        made = estimate_session(frames, out, self, remark=remarks.append, is_judged=False)
        return self._finished(source, work, made, remarks)

    def is_long(self, source: Path) -> bool:
        """See `LongTask`."""
        from service.offline.estimate.pieces import has_pieces

        return has_pieces(frames_of(source), self, self.piece_frames)

    def make_piece(self, source: Path, folder: Path) -> bool:
        """See `LongTask`."""
        from service.offline.estimate.pieces import make_piece

        return make_piece(
            frames_of(source), folder, self, piece_frames=self.piece_frames, remark=lambda _: None
        )

    def join(self, source: Path, folder: Path, work: Path) -> dict[str, Any]:
        """See `LongTask`."""
        from service.offline.estimate.pieces import join_pieces

        remarks, out = list[str](), work / FRAMES_NAME
        made = join_pieces(frames_of(source), folder, out, self, remark=remarks.append)
        return self._finished(source, work, made, remarks)

    def _finished(
        self, source: Path, work: Path, made: Estimated, remarks: list[str]
    ) -> dict[str, Any]:
        if source.is_dir() and self.part.is_all:
            _complete(source, work)
        return {
            "frames": made.frames,
            "calibration_id": made.plan.calibration.id,
            "models": made.plan.models,
            "remarks": remarks,
        }


@dataclass(frozen=True)
class ExportTask:
    """Export of a session to another format."""

    export: ExportOptions
    command: ClassVar[str] = "export"

    def options(self) -> dict[str, Any]:
        """See `Task`."""
        asked = self.export.options.model_dump(exclude_none=True)
        return {**vars(self.export), "part": vars(self.export.part), "options": asked}

    def run(self, source: Path, work: Path) -> dict[str, Any]:
        """See `Task`."""
        name = f"{Path(FRAMES_NAME).stem}.{format_named(self.export.to).ending}"
        done = export_session(frames_of(source), work / name, self.export)
        left_out = {mark.event.label: mark.left_out for mark in done.left_out}
        return {"bytes": done.size_bytes, "marks_left_out": left_out}


@dataclass(frozen=True)
class VerifyTask:
    """Verification of a session's files."""

    command: ClassVar[str] = "verify"

    def options(self) -> dict[str, Any]:
        """See `Task`."""
        return {}

    def run(self, source: Path, work: Path) -> dict[str, Any]:
        """See `Task`."""
        report = verify(source)
        text = json.dumps(report.as_dict(), indent=1).encode()
        (work / "verify.json").write_bytes(text)
        return {"verdict": verdict_of(report), "problems": report.problems}


@dataclass(frozen=True)
class CompareTask:
    """Comparison of a session with a reference."""

    reference: str
    """Path or URI of a file, or of a session's `frames.parquet`."""
    compare: CompareOptions
    limits: Mapping[str, float]
    command: ClassVar[str] = "compare"

    def options(self) -> dict[str, Any]:
        """Return the options as JSON values, with the reference by its hash."""
        said = identity_of_file(self.reference)
        options = {**vars(self.compare), "stated": asdict(self.compare.stated)}
        return {"reference_sha256": said, "limits": self.limits, **options}

    def run(self, source: Path, work: Path) -> dict[str, Any]:
        """See `Task`."""
        from service.offline.comparison_files import write_comparison

        title = f"{source.name} against {self.reference.rpartition('/')[2]}"
        with staged_file(self.reference) as reference:
            done = write_comparison(
                frames_of(source), reference, self.compare, self.limits, work, title
            )
        means = {name: figure.mean for name, figure in done.content["figures"].items()}
        verdict = {"verdict": "limit missed", "missed": list(done.missed)} if done.missed else {}
        return {"means": plain(means), **verdict}


@dataclass(frozen=True)
class RefusedTask:
    """Task with invalid options for one session; running it raises `UsageError`."""

    reason: str
    command: str

    def options(self) -> dict[str, Any]:
        """See `Task`."""
        raise UsageError(self.reason)

    def run(self, source: Path, work: Path) -> dict[str, Any]:
        """See `Task`."""
        raise UsageError(self.reason)


def _complete(source: Path, work: Path) -> None:
    """Complete the session's folder: `session.json`, and copies of the source's sidecar files."""
    said = claims_of(source)
    out = work / FRAMES_NAME
    with SessionReader(out, is_checked=True) as session:
        about: Mapping[str, Any] = {
            "bytes": out.stat().st_size,
            "sha256": sha256_of(out),
            "calibration_id": session.notes.get("calibration_id"),
            "absolute_scale": session.notes.get("absolute_scale"),
            "problem": None,
        }
    for name in _BESIDE:
        if (content := bytes_of(source / name)) is not None:
            (work / name).write_bytes(content)
    text = json.dumps({**said.content, **about}, indent=1).encode()
    (work / SESSION_NAME).write_bytes(with_check(text))
