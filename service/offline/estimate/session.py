"""Re-estimation of a sealed session into a new file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

from devices.errors import FileFormatError, UsageError
from devices.frames import ArrayInfo
from service.estimation.model_sensitivity import OmittedModelEffect
from service.estimation.pipeline.plan import EstimationPlan
from service.offline.estimate.estimation_range import (
    BatchWithColumns,
    EstimationRange,
    compute_estimation_range,
    select_tares_in_force,
)
from service.offline.estimate.preparation import PreparedEstimate, prepare_estimate
from service.offline.estimate.request import EstimateRequest
from service.offline.estimate_summary import EstimateSummarizer, EstimateSummary
from service.sessions.pipeline import EstimateOptions, EstimateStream, make_estimate_metadata
from service.sessions.stances import StancesWriter
from storage.formats.slice import Slice
from storage.parquet_hash import compute_sha256
from storage.schema import TRUTH_COLUMNS
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.frame_order import iterate_checking_order
from storage.sessions.reader import SealedFileReader
from storage.sessions.time_axis import TIME_AXIS_NOTE
from storage.sessions.writer import SealedFileWriter

_WHOLE_SESSION_NOTES = frozenset({"session", "ledger"})
"""Notes of a session that do not hold for a part of it."""


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
) -> EstimateResult:
    """Estimate a session.

    Args:
        source: the session.
        out: the session to write; may be the same file unless a part is estimated.
        request: options of the estimate.
        on_remark: called with each remark.
        with_findings: True to compute findings, which doubles the run time.

    Raises:
        FootTileError: the session, scene, calibration or tare is not usable, or the part has no
            frame; `out` is unchanged.
    """
    part = request.part
    if not part.is_unrestricted and out.exists() and out.samefile(source):
        raise UsageError(
            f"--out {str(out)!r} is the session itself, of which a part would be left",
            expected="another file",
        )
    with SealedFileReader(source, only_slices=not part.is_unrestricted) as session:
        what = prepare_estimate(session, request, on_remark)
        begin_t_ns = session.read_span_ns()[0] if session.footer.rows_by_group else 0
        notes, stretch = dict(session.notes), EstimationRange()
        if session.time_axis.is_shifted:  # the output may have no clock table beside it
            notes[TIME_AXIS_NOTE] = session.time_axis.to_json_list()
        if not part.is_unrestricted:
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
        given = stretch.select_output(stream.estimate_batches(stretch.select_needed(ordered)))
        watched = given if judged is None else judged.observe(given, stream)
        frames = write_estimates(out, what, notes, stream, watched, on_remark)
    if not frames or stream.plan is None:
        problem = "the session has no frames" + ("" if part.is_unrestricted else " in that time")
        raise FileFormatError(problem, where=str(source))
    found = () if judged is None else judged.finish(stream.plan)
    return EstimateResult(frames, stream.plan, begin_t_ns, *found)


def write_estimates(
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
    notes = {
        **notes,
        **make_estimate_metadata(stream.plan, stream.rounding, prepared_estimate.options.tares),
    }
    stances, frames = StancesWriter(), 0
    with SealedFileWriter(out, prepared_estimate.info, notes) as writer:
        for batch, extra in chain((first,), left):
            writer.append_frames(batch, extra)
            frames += len(batch)
            stances.add_frames(batch.seq, batch.t_ns, extra)
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
        self._asking = OmittedModelEffect(what.info, what.options.calibration, what.options.models)

    def observe(
        self, pieces: Iterable[BatchWithColumns], stream: EstimateStream
    ) -> Iterator[BatchWithColumns]:
        for batch, extra in pieces:
            self._found.add_frames(batch, extra)
            if stream.tare is not None:
                self._asking.add_frames(stream.tare, batch, extra["contact"] == 1)
            yield batch, extra

    def finish(self, plan: EstimationPlan) -> tuple[EstimateSummary, Mapping[str, float]]:
        return self._found.finish_summary(plan), self._asking.compute_notable_mean_effects_n()


def _restrict_to_part(
    session: SealedFileReader, info: ArrayInfo, options: EstimateOptions, part: Slice
) -> tuple[EstimateOptions, EstimationRange]:
    """Return options with the tares in force in a part, and the range to read."""
    stream, tares = EstimateStream(info, options), options.tares
    if not tares:
        ordered = iterate_checking_order(session.read_batches(), where=str(session.path))
        tares = (stream.find_tare(ordered),)
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
    return {**notes, "part_of": {**session.source_reference, **seconds}}
