"""Re-estimation of a sealed session into a new file, whole or chunk by chunk.

The result is bit-identical for any chunk size. After a kill, any machine continues with at most one
chunk repeated. Chunks cannot run in parallel, because each needs the model state of the one before.

A chunk consists of a sealed file of frames with estimates, `0000.parquet`, the estimator's state,
`0000.npz`, and, written last, an index with the hashes of both, `0000.json`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from devices.errors import DamagedFileError, FileFormatError, UsageError
from devices.frames import ArrayInfo
from service.estimation.estimate import ModelEstimator
from service.estimation.model_sensitivity import OmittedModelEffect
from service.estimation.pipeline.params import MODEL_NAMES
from service.estimation.pipeline.plan import EstimationPlan
from service.estimation.records import ColumnDict
from service.offline.estimate.preparation import (
    CHUNK_FRAMES,
    BatchWithColumns,
    EstimateRequest,
    EstimationRange,
    PreparedEstimate,
    compute_estimation_range,
    prepare_estimate,
    read_warm_up_or_remark,
    select_tares_in_force,
)
from service.offline.estimate.table_angle import AngleTrack, TableServo
from service.offline.estimate_summary import EstimateSummarizer, EstimateSummary
from service.sessions.estimate_stream import EstimateOptions, EstimateStream, make_estimate_metadata
from service.sessions.stances import StancesWriter
from storage.documents import append_json_checksum, verify_and_strip_json_checksum
from storage.durable_files import open_for_atomic_write, read_small_file, write_atomically
from storage.formats.slice import Slice
from storage.parquet_hash import compute_sha256
from storage.schema import ESTIMATE_COLUMNS, TRUTH_COLUMNS
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.ledger import iterate_checking_order
from storage.sessions.reader import SealedFileReader
from storage.sessions.time_axis import TIME_AXIS_NOTE
from storage.sessions.warm_up import WARM_UP_NOTE
from storage.sessions.writer import SealedFileWriter

_WHOLE_SESSION_NOTES = frozenset({"session", "ledger", WARM_UP_NOTE})
"""Notes of a session that do not hold for a part."""
_ESTIMATOR_NOTE = "estimator"
"""Note of the estimator, if it is not that of the models."""
_ANGLE_NOTE = "angle"
"""Note of the table that the angle is from, if it is not the servo's."""


@dataclass(frozen=True)
class EstimateResult:
    """Result of a re-estimation.

    Attributes:
        frame_count: number of frames.
        plan: initial constants of the estimate.
        begin_t_ns: UTC of the first frame of the session.
        findings: stances, and errors against the truth; empty if not requested.
        omitted_effects_n: omitted models with a considerable effect, with that effect in N; empty
            if not requested.
    """

    frame_count: int
    plan: EstimationPlan
    begin_t_ns: int
    findings: EstimateSummary = field(default_factory=EstimateSummary)
    omitted_effects_n: Mapping[str, float] = field(default_factory=dict)

    @property
    def tare_s(self) -> tuple[float, float]:
        """Begin and end of the tare, in s from the first frame; negative before it."""
        tare = self.plan.tare
        end_s = (tare.t_ns - self.begin_t_ns) * 1e-9
        return end_s - (tare.end_s - tare.begin_s), end_s


def estimate_session(
    source: Path,
    out: Path,
    request: EstimateRequest,
    *,
    on_remark: Callable[[str], None],
    with_findings: bool = True,
    angle: AngleTrack | None = None,
) -> EstimateResult:
    """Estimate a session.

    Args:
        source: the session.
        out: the session to write; may be the same file unless a part is estimated.
        request: options of the estimate.
        on_remark: called with each remark.
        with_findings: True to compute findings, which doubles the run time.
        angle: of the segment, in place of the servo's; None: the servo's.

    Raises:
        FootTileError: the session, scene, calibration or tare is not usable, or the part has no
            frame; `out` is unchanged.
    """
    part = request.part
    if not part.has_all_rows_and_columns and out.exists() and out.samefile(source):
        raise UsageError(
            f"--out {str(out)!r} is the session itself, of which a part would be left",
            expected="another file",
        )
    with SealedFileReader(source, only_slices=not part.has_all_rows_and_columns) as session:
        what = prepare_estimate(session, request, on_remark)
        span_ns = session.read_span_on_axis_ns() if session.footer.rows_by_group else (0, 0)
        notes, stretch = dict(session.notes), EstimationRange()
        notes.pop(_ANGLE_NOTE, None)  # of an earlier estimate
        info, servo = what.info, None
        if angle is not None:
            servo = TableServo(info, request.scene, angle, session.time_axis)
            servo.check_overlap(*span_ns)
            what = replace(what, info=servo.info)
            notes[_ANGLE_NOTE] = angle.origin
        if session.time_axis.is_shifted:  # the output may have no clock table beside it
            notes[TIME_AXIS_NOTE] = session.time_axis.to_json_list()
        if not part.has_all_rows_and_columns:
            options, stretch = _restrict_to_part(session, what.info, what.options, part)
            notes, what = (
                _make_part_notes(session, notes, part, stretch),
                replace(what, options=options),
            )
        stream = EstimateStream(what.info, what.options)
        judged = _FindingsObserver(what) if with_findings else None
        ordered = iterate_checking_order(
            session.read_batches(*what.kept_columns, row_groups=stretch.row_groups),
            where=str(source),
        )
        if servo is not None:
            ordered = servo.replace_positions(ordered)
        before = read_warm_up_or_remark(session, stretch, on_remark)
        if angle is not None:
            of_table = TableServo(info, request.scene, angle, session.time_axis)
            before = of_table.replace_positions(before)
        given = stretch.select_output(
            stream.estimate_batches(stretch.select_needed(ordered), warm_up=before)
        )
        watched = given if judged is None else judged.observe(given, stream)
        if servo is not None:
            watched = servo.restore_positions(watched)
        written = replace(what, info=info)
        frames = _write_estimates(out, written, notes, stream, watched, on_remark)
    if servo is not None:
        on_remark(servo.describe_use())
    if not frames or stream.plan is None:
        problem = "the session has no frames" + (
            "" if part.has_all_rows_and_columns else " in that time"
        )
        raise FileFormatError(problem, where=str(source))
    found = () if judged is None else judged.finish(stream.plan)
    return EstimateResult(frames, stream.plan, span_ns[0], *found)


def _write_estimates(
    out: Path,
    prepared_estimate: PreparedEstimate,
    notes: Mapping[str, object],
    stream: EstimateStream,
    batches: Iterable[BatchWithColumns],
    on_remark: Callable[[str], None],
) -> int:
    """Write frames with estimates; in a session's folder also the stances file.

    Args:
        out: the file.
        prepared_estimate: the resolved request.
        notes: notes of the session.
        stream: the estimator; its plan must exist once the first batch is yielded.
        batches: all batches with their columns.
        on_remark: called if the stances cannot be written.

    Returns:
        Number of frames; with none, no file is written.

    Raises:
        FootTileError: from `batches`, or the file cannot be written.
    """
    left = iter(batches)
    first = next(left, None)
    if first is None:
        return 0
    assert stream.plan is not None  # noqa: S101  # it exists before the first output
    options = prepared_estimate.options
    notes = {
        **{name: note for name, note in notes.items() if name != _ESTIMATOR_NOTE},
        **make_estimate_metadata(stream.plan, stream.rounding, options.tares),
    }
    if options.estimator is not ModelEstimator:
        notes[_ESTIMATOR_NOTE] = options.estimator.name
    stances, frames = StancesWriter(), 0
    with SealedFileWriter(out, prepared_estimate.info, notes) as writer:
        for batch, extra in chain((first,), left):
            writer.append_frames(batch, extra)
            frames += len(batch)
            stances.try_add_frames(batch.seq, batch.t_ns, extra)
    if out.name == FRAMES_NAME:  # in a session's folder
        stances.try_write_or_delete_file(out.parent, compute_sha256(out))
        if stances.problem is not None:
            on_remark(stances.problem)
    return frames


class _FindingsObserver:
    """Observer of estimated frames, for findings and the effect of omitted models."""

    def __init__(self, what: PreparedEstimate) -> None:
        self._found = EstimateSummarizer(
            has_truth=all(c.name in what.kept_columns for c in TRUTH_COLUMNS)
        )
        options = what.options
        # Another estimator could not take a further model.
        models = options.models if options.estimator is ModelEstimator else MODEL_NAMES
        self._asking = OmittedModelEffect(what.info, options.calibration, models)

    def observe(
        self, pieces: Iterable[BatchWithColumns], stream: EstimateStream
    ) -> Iterator[BatchWithColumns]:
        for batch, extra in pieces:
            self._found.add_frames(batch, extra)
            if stream.tare is not None:
                self._asking.add_frames(stream.tare, batch, extra["contact"] == 1)
            yield batch, extra

    def finish(self, plan: EstimationPlan) -> tuple[EstimateSummary, Mapping[str, float]]:
        return self._found.finish_summary(
            plan
        ), self._asking.compute_notable_mean_grf_effects_by_model_n()


def _restrict_to_part(
    session: SealedFileReader, info: ArrayInfo, options: EstimateOptions, part: Slice
) -> tuple[EstimateOptions, EstimationRange]:
    """Return options with the tares in force in a part, and the range to read."""
    stream, tares = EstimateStream(info, options), options.tares
    if not tares:
        ordered = iterate_checking_order(session.read_batches(), where=str(session.path))
        tares = (stream.find_tare_in_first_frames(ordered),)
    stretch = compute_estimation_range(session, part, stream.make_plan(tares[0]))
    if not stretch.axis.is_shifted:  # tares are on the node's time axis
        tares = select_tares_in_force(tares, stretch.run_from_ns)
    return replace(options, tare_s=None, tares=tares), stretch


def _make_part_notes(
    session: SealedFileReader, notes: Mapping[str, object], part: Slice, stretch: EstimationRange
) -> dict[str, object]:
    """Return the notes that hold for a part of the session."""
    notes = {name: note for name, note in notes.items() if name not in _WHOLE_SESSION_NOTES}
    seconds = {"start_s": part.start_s, "end_s": part.end_s, "warm_up_s": stretch.warm_up_s}
    return {**notes, "part_of": {**session.session_id_and_hashes, **seconds}}


NEEDED_SUFFIXES = ("json", "npz")
"""Suffixes of the files that the next chunk needs; joining needs the Parquet files too."""


@dataclass(frozen=True)
class _ChunkIndex:
    """Index of a finished chunk.

    Attributes:
        number: index, from 0.
        groups: number of the session's row groups up to its end.
        frames: number of its output frames.
        sha256: hashes of its files by suffix.
    """

    number: int
    groups: int
    frames: int
    sha256: dict[str, str]


def needs_chunks(source: Path, request: EstimateRequest, chunk_frames: int) -> bool:
    """Return whether a session is longer than one chunk.

    Raises:
        FileFormatError: the file is no session.
    """
    if not request.part.has_all_rows_and_columns:
        return False
    with SealedFileReader(source, only_slices=True) as session:
        return session.frame_count > chunk_frames and len(session.footer.rows_by_group) > 1


def estimate_next_chunk(
    source: Path,
    chunks_folder: Path,
    request: EstimateRequest,
    *,
    chunk_frames: int = CHUNK_FRAMES,
    on_remark: Callable[[str], None],
) -> bool:
    """Estimate the next chunk of a session.

    Args:
        source: the session.
        chunks_folder: folder with the earlier chunks, at least their `NEEDED_SUFFIXES`; the new
            chunk is written to it.
        request: options of the estimate.
        chunk_frames: approximate number of frames; row groups are not split.
        on_remark: called with each remark.

    Returns:
        False if all chunks existed already.

    Raises:
        FootTileError: the session, scene, calibration or tare is not usable.
    """
    before = _list_finished_chunks(chunks_folder)
    done, number = (before[-1].groups if before else 0), len(before)
    with SealedFileReader(source, only_slices=bool(before)) as session:
        rows = session.footer.rows_by_group
        if done == len(rows):
            return False
        what = prepare_estimate(session, request, on_remark)
        stream = _resume_stream(what, chunks_folder, before)
        taken: list[int] = []

        def source_frames() -> Iterator[BatchWithColumns]:
            """Yield row groups until the chunk is full and a tare was found."""
            for group in range(done, len(rows)):
                is_full = sum(rows[each] for each in (*taken, group)) > chunk_frames
                if taken and is_full and stream.plan is not None:
                    return
                taken.append(group)
                yield from session.read_batches(*what.kept_columns, row_groups=[group])

        def yield_estimates() -> Iterator[BatchWithColumns]:
            yield from stream.estimate_batches(
                iterate_checking_order(source_frames(), where=str(source)),
                warm_up=read_warm_up_or_remark(session, EstimationRange(), on_remark),
                is_final=False,
            )
            if done + len(taken) == len(rows):
                yield from stream.estimate_batches((), is_final=True)

        frames = _write_frames(chunks_folder / f"{number:04}.parquet", what, yield_estimates())
    with open_for_atomic_write(chunks_folder / f"{number:04}.npz") as file:
        np.savez(file, allow_pickle=False, **stream.state_dict())
    made = _ChunkIndex(number, done + len(taken), frames, {})
    made.sha256.update(
        {
            end: compute_sha256(chunks_folder / f"{number:04}.{end}")
            for end in _list_suffixes(made)
            if end != "json"
        }
    )
    text = append_json_checksum(json.dumps(vars(made)).encode())
    write_atomically(chunks_folder / f"{number:04}.json", text)
    return True


def join_chunks(
    source: Path,
    chunks_folder: Path,
    out: Path,
    request: EstimateRequest,
    *,
    on_remark: Callable[[str], None],
) -> EstimateResult:
    """Join all chunks into one session, identical to the output of `estimate_session`.

    Raises:
        FootTileError: as for `estimate_session`; or a chunk is damaged.
    """
    pieces = _list_finished_chunks(chunks_folder)
    with SealedFileReader(source, only_slices=True) as session:
        if not pieces or pieces[-1].groups != len(session.footer.rows_by_group):
            raise FileFormatError("chunks are missing", where=str(chunks_folder))
        what = prepare_estimate(session, request, on_remark)
        stream = _resume_stream(what, chunks_folder, pieces)
        ordered = iterate_checking_order(
            _read_chunks(what, chunks_folder, pieces), where=str(source)
        )
        frames = _write_estimates(out, what, session.notes, stream, ordered, on_remark)
        begin_t_ns = session.read_span_on_axis_ns()[0]
    assert stream.plan is not None  # noqa: S101  # it goes on with one
    return EstimateResult(frames, stream.plan, begin_t_ns)


def _write_frames(path: Path, what: PreparedEstimate, given: Iterator[BatchWithColumns]) -> int:
    first = next(given, None)
    if first is None:  # no output yet: the look-ahead is longer than the chunk
        return 0
    frames = 0
    with SealedFileWriter(path, what.info, {}) as writer:
        for batch, extra in chain((first,), given):
            writer.append_frames(batch, extra)
            frames += len(batch)
    return frames


def _read_chunks(
    what: PreparedEstimate, folder: Path, pieces: list[_ChunkIndex]
) -> Iterator[BatchWithColumns]:
    names = (*what.kept_columns, *(column.name for column in ESTIMATE_COLUMNS))
    for piece in pieces:
        if piece.frames:
            with SealedFileReader(_verify_file(folder, piece, "parquet")) as session:
                yield from session.read_batches(*names)


def _resume_stream(
    what: PreparedEstimate, folder: Path, before: list[_ChunkIndex]
) -> EstimateStream:
    stream = EstimateStream(what.info, what.options)
    if before:
        path = _verify_file(folder, before[-1], "npz")
        with np.load(path, allow_pickle=False) as kept:
            columns: ColumnDict = dict(kept)
        try:
            stream.load_state(columns)
        except (KeyError, ValueError) as error:
            raise DamagedFileError(f"is of another session: {error}", where=str(path)) from error
    return stream


def _list_finished_chunks(folder: Path) -> list[_ChunkIndex]:
    """Return the finished chunks from the first one to the first gap."""
    found: list[_ChunkIndex] = []
    while True:
        path = folder / f"{len(found):04}.json"
        try:
            index: dict[str, Any] = json.loads(
                verify_and_strip_json_checksum(read_small_file(path), where=str(path))
            )
        except FileNotFoundError:
            return found
        found.append(_ChunkIndex(**index))


def _verify_file(folder: Path, piece: _ChunkIndex, ending: str) -> Path:
    path = folder / f"{piece.number:04}.{ending}"
    try:
        is_same = compute_sha256(path) == piece.sha256[ending]
    except FileNotFoundError:
        is_same = False
    if not is_same:
        raise DamagedFileError(
            "a chunk of a session has another hash than its index states",
            where=str(path),
            remedy="Delete its folder; the session is then estimated from its begin",
        )
    return path


def _list_suffixes(piece: _ChunkIndex) -> tuple[str, ...]:
    return (*NEEDED_SUFFIXES, "parquet") if piece.frames else NEEDED_SUFFIXES
