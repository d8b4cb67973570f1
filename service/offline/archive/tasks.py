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
from service.json_output import to_json_value
from service.offline.archive.local_copies import (
    get_sealed_frames_path,
    hash_file_or_session,
    open_local_file,
    read_session_metadata,
)
from service.offline.estimate.preparation import CHUNK_FRAMES, EstimateRequest
from service.offline.export import ExportOptions, export_session
from storage.clock.table import CLOCK_NAME
from storage.documents import append_json_checksum
from storage.formats.writers.registry import get_format
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import FRAMES_NAME, WARM_UP_NAME
from storage.sessions.metadata import (
    LEDGER_NAME,
    MARKERS_NAME,
    PULLED_MARKERS_NAME,
    SESSION_NAME,
    read_bytes_or_none,
)
from storage.sessions.reader import SealedFileReader
from storage.verify.data_folder import find_verdict, verify_path

if TYPE_CHECKING:
    from service.offline.comparison import CompareOptions
    from service.offline.estimate.session import EstimateResult

_SIDECAR_NAMES = (MARKERS_NAME, CLOCK_NAME, WARM_UP_NAME, LEDGER_NAME, PULLED_MARKERS_NAME)


class SessionTask(Protocol):
    """Operation on one session."""

    @property
    def command(self) -> str:
        """Name of the command, used in the names of notes and reports."""

    def describe_options(self) -> dict[str, Any]:
        """Return the options as JSON values."""

    def process_session(self, source: Path, result_folder: Path) -> dict[str, Any]:
        """Process one session.

        Args:
            source: the session's folder or file.
            result_folder: empty folder for the result's files; the caller makes them durable.

        Returns:
            Report of the task, as JSON values.

        Raises:
            FootTileError: this session cannot be processed.
        """


@runtime_checkable
class ChunkedTask(SessionTask, Protocol):
    """Task that processes a long session in consecutive chunks."""

    CHUNK_SUFFIXES: ClassVar[tuple[str, ...]]
    """Suffixes of the files of earlier chunks that the next chunk needs."""

    def needs_chunks(self, source: Path) -> bool:
        """Return whether the session needs more than one chunk."""

    def process_next_chunk(self, source: Path, chunks_folder: Path) -> bool:
        """Process the next chunk.

        Args:
            source: as for `process_session`.
            chunks_folder: folder of the chunks; the new one is written to it.

        Returns:
            False if all chunks existed already.

        Raises:
            FootTileError: as for `run`.
        """

    def join_chunks(self, source: Path, chunks_folder: Path, result_folder: Path) -> dict[str, Any]:
        """Make the result of `process_session` from the folder of the chunks."""


@dataclass(frozen=True)
class EstimateTask(EstimateRequest):
    """Re-estimation of a session; the result is a session's folder if the source is one.

    Attributes:
        piece_frames: frames of a chunk of a long session; the result does not depend on it.
    """

    piece_frames: int = CHUNK_FRAMES
    command: ClassVar[str] = "estimate"
    CHUNK_SUFFIXES: ClassVar[tuple[str, ...]] = ("json", "npz")

    def describe_options(self) -> dict[str, Any]:
        """See `SessionTask`."""
        named = self.calibration
        return {
            **{name: value for name, value in vars(self).items() if name != "piece_frames"},
            "estimator": self.estimator.name,
            "calibration": named.id if isinstance(named, Calibration) else named,
            "scene": None if self.scene is None else self.scene.model_dump(mode="json"),
            "part": vars(self.part),
        }

    def process_session(self, source: Path, result_folder: Path) -> dict[str, Any]:
        """See `SessionTask`."""
        from service.offline.estimate.session import estimate_session

        frames, remarks = get_sealed_frames_path(source), list[str]()
        out = result_folder / FRAMES_NAME
        made = estimate_session(frames, out, self, on_remark=remarks.append, with_findings=False)
        return self._complete_result(source, result_folder, made, remarks)

    def needs_chunks(self, source: Path) -> bool:
        """See `ChunkedTask`."""
        from service.offline.estimate.session import needs_chunks

        return needs_chunks(get_sealed_frames_path(source), self, self.piece_frames)

    def process_next_chunk(self, source: Path, chunks_folder: Path) -> bool:
        """See `ChunkedTask`."""
        from service.offline.estimate.session import estimate_next_chunk

        return estimate_next_chunk(
            get_sealed_frames_path(source),
            chunks_folder,
            self,
            chunk_frames=self.piece_frames,
            on_remark=lambda _: None,
        )

    def join_chunks(self, source: Path, chunks_folder: Path, result_folder: Path) -> dict[str, Any]:
        """See `ChunkedTask`."""
        from service.offline.estimate.session import join_chunks

        remarks, out = list[str](), result_folder / FRAMES_NAME
        made = join_chunks(
            get_sealed_frames_path(source), chunks_folder, out, self, on_remark=remarks.append
        )
        return self._complete_result(source, result_folder, made, remarks)

    def _complete_result(
        self, source: Path, work: Path, made: EstimateResult, remarks: list[str]
    ) -> dict[str, Any]:
        if source.is_dir() and self.part.has_all_rows_and_columns:
            _copy_session_files(source, work)
        return {
            "frames": made.frame_count,
            "calibration_id": made.plan.calibration.id,
            "models": made.plan.models,
            "remarks": remarks,
        }


@dataclass(frozen=True)
class ExportTask:
    """Export of a session to another format."""

    export: ExportOptions
    command: ClassVar[str] = "export"

    def describe_options(self) -> dict[str, Any]:
        """See `SessionTask`."""
        requested = self.export.options.model_dump(exclude_none=True)
        return {**vars(self.export), "part": vars(self.export.part), "options": requested}

    def process_session(self, source: Path, result_folder: Path) -> dict[str, Any]:
        """See `SessionTask`."""
        name = f"{Path(FRAMES_NAME).stem}{get_format(self.export.to).ending}"
        done = export_session(get_sealed_frames_path(source), result_folder / name, self.export)
        left_out = {
            marker.marker.label: marker.exclusion_reason for marker in done.left_out_markers
        }
        return {"bytes": done.size_bytes, "marks_left_out": left_out}


@dataclass(frozen=True)
class VerifyTask:
    """Verification of a session's files."""

    command: ClassVar[str] = "verify"

    def describe_options(self) -> dict[str, Any]:
        """See `SessionTask`."""
        return {}

    def process_session(self, source: Path, result_folder: Path) -> dict[str, Any]:
        """See `SessionTask`."""
        report = verify_path(source)
        text = json.dumps(report.to_json_dict(), indent=1).encode()
        (result_folder / "verify.json").write_bytes(text)
        return {"verdict": find_verdict(report), "problems": report.problems}


@dataclass(frozen=True)
class CompareTask:
    """Comparison of a session with a reference."""

    reference: str
    """Path or URI of a file, or of a session's `frames.parquet`."""
    compare: CompareOptions
    limits: Mapping[str, float]
    command: ClassVar[str] = "compare"

    def describe_options(self) -> dict[str, Any]:
        """Return the options as JSON values, with the reference by its hash."""
        sha256 = hash_file_or_session(self.reference)
        options = {**vars(self.compare), "stated": asdict(self.compare.stated)}
        return {"reference_sha256": sha256, "limits": self.limits, **options}

    def process_session(self, source: Path, result_folder: Path) -> dict[str, Any]:
        """See `SessionTask`."""
        from service.offline.comparison import write_comparison

        title = f"{source.name} against {self.reference.rpartition('/')[2]}"
        with open_local_file(self.reference) as reference:
            done = write_comparison(
                get_sealed_frames_path(source),
                reference,
                self.compare,
                self.limits,
                result_folder,
                title,
            )
        means = {name: figure.mean for name, figure in done.content["figures"].items()}
        verdict = (
            {"verdict": "limit missed", "missed": list(done.missed_limits)}
            if done.missed_limits
            else {}
        )
        return {"means": to_json_value(means), **verdict}


@dataclass(frozen=True)
class InvalidTask:
    """Task with invalid options for one session; running it raises `UsageError`."""

    reason: str
    command: str

    def describe_options(self) -> dict[str, Any]:
        """See `SessionTask`."""
        raise UsageError(self.reason)

    def process_session(self, source: Path, result_folder: Path) -> dict[str, Any]:
        """See `SessionTask`."""
        raise UsageError(self.reason)


def _copy_session_files(source: Path, work: Path) -> None:
    """Complete the session's folder: `session.json`, and copies of the source's sidecar files."""
    metadata = read_session_metadata(source)
    out = work / FRAMES_NAME
    with SealedFileReader(out, skip_verification=True) as session:
        about: Mapping[str, Any] = {
            "bytes": out.stat().st_size,
            "sha256": compute_sha256(out),
            "calibration_id": session.notes.get("calibration_id"),
            "absolute_scale": session.notes.get("absolute_scale"),
            "problem": None,
        }
    for name in _SIDECAR_NAMES:
        if (content := read_bytes_or_none(source / name)) is not None:
            (work / name).write_bytes(content)
    text = json.dumps({**metadata.content, **about}, indent=1).encode()
    (work / SESSION_NAME).write_bytes(append_json_checksum(text))
