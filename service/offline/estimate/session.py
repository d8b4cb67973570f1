"""Re-estimation of a sealed session into a new file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

from devices.errors import FileFormatError, UsageError
from devices.frames import ArrayInfo
from service.estimation.asked import Asking
from service.estimation.ladder.plan import EstimationPlan
from service.offline.estimate.prepared import Prepared, prepared
from service.offline.estimate.request import EstimateRequest
from service.offline.estimate.stretch import Piece, Stretch, since, stretch_of
from service.offline.findings import Findings, FindingsOf
from service.sessions.pipeline import EstimateOptions, EstimateStream, notes_of
from service.sessions.stances import StancesBeside
from storage.file_hash import sha256_of
from storage.formats.slice import Slice
from storage.schema import TRUTH
from storage.sessions.file import SessionWriter
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.frame_order import in_order
from storage.sessions.reader import SessionReader
from storage.sessions.time_axis import TIME_AXIS_NOTE

_OF_THE_WHOLE = frozenset({"session", "ledger"})
"""Notes of a session that do not hold for a part of it."""


@dataclass(frozen=True)
class Estimated:
    """Result of a re-estimation.

    Attributes:
        frames: number of frames.
        plan: initial constants of the estimate.
        begin_t_ns: UTC of the first frame of the session.
        findings: stances, and errors against the truth; empty if not requested.
        asked: omitted models with a considerable effect, with that effect in N; empty
            if not requested.
    """

    frames: int
    plan: EstimationPlan
    begin_t_ns: int
    findings: Findings = field(default_factory=Findings)
    asked: Mapping[str, float] = field(default_factory=dict)

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
    remark: Callable[[str], None],
    is_judged: bool = True,
) -> Estimated:
    """Estimate a session.

    Args:
        source: the session.
        out: the session to write; may be the same file unless a part is estimated.
        request: options of the estimate.
        remark: called with each remark.
        is_judged: True to compute findings, which doubles the run time.

    Raises:
        FootTileError: the session, scene, calibration or tare is not usable, or the part has no
            frame; `out` is unchanged.
    """
    part = request.part
    if not part.is_all and out.exists() and out.samefile(source):
        raise UsageError(
            f"--out {str(out)!r} is the session itself, of which a part would be left",
            expected="another file",
        )
    with SessionReader(source, only_slices=not part.is_all) as session:
        what = prepared(session, request, remark)
        begin_t_ns = session.span_ns()[0] if session.footer.group_rows else 0
        notes, stretch = dict(session.notes), Stretch()
        if session.axis.is_shifted:  # the output may have no clock table beside it
            notes[TIME_AXIS_NOTE] = session.axis.as_dicts()
        if not part.is_all:
            options, stretch = _of_part(session, what.info, what.options, part)
            notes, what = (
                _notes_of_part(session, notes, part, stretch),
                replace(what, options=options),
            )
        stream = EstimateStream(what.info, what.options)
        judged = _Judged(what) if is_judged else None
        ordered = in_order(session.batches(*what.kept, groups=stretch.groups), where=str(source))
        given = stretch.given(stream.run(stretch.needed(ordered)))
        watched = given if judged is None else judged.watched(given, stream)
        frames = write_estimated(out, what, notes, stream, watched, remark)
    if not frames or stream.plan is None:
        said = "the session has no frames" + ("" if part.is_all else " in that time")
        raise FileFormatError(said, where=str(source))
    found = () if judged is None else judged.finish(stream.plan)
    return Estimated(frames, stream.plan, begin_t_ns, *found)


def write_estimated(
    out: Path,
    what: Prepared,
    notes: Mapping[str, object],
    stream: EstimateStream,
    pieces: Iterable[Piece],
    remark: Callable[[str], None],
) -> int:
    """Write frames with estimates; in a session's folder also the stances file.

    Args:
        out: the file.
        what: the resolved request.
        notes: notes of the session.
        stream: the estimator; its plan must exist once the first batch is yielded.
        pieces: all batches with their columns.
        remark: called if the stances cannot be written.

    Returns:
        Number of frames; with none, no file is written.

    Raises:
        FootTileError: from `batches`, or the file cannot be written.
    """
    left = iter(pieces)
    first = next(left, None)
    if first is None:
        return 0
    assert stream.plan is not None  # noqa: S101  # it exists before the first output
    notes = {**notes, **notes_of(stream.plan, stream.rounding, what.options.tares)}
    stances, frames = StancesBeside(), 0
    with SessionWriter(out, what.info, notes) as writer:
        for batch, extra in chain((first,), left):
            writer.append(batch, extra)
            frames += len(batch)
            stances.feed(batch.seq, batch.t_ns, extra)
    if out.name == FRAMES_NAME:  # in a session's folder
        stances.write(out.parent, sha256_of(out))
        if stances.problem is not None:
            remark(stances.problem)
    return frames


class _Judged:
    """Observer of estimated frames, for findings and the effect of omitted models."""

    def __init__(self, what: Prepared) -> None:
        self._found = FindingsOf(judging=all(c.name in what.kept for c in TRUTH))
        self._asking = Asking(what.info, what.options.calibration, what.options.models)

    def watched(self, pieces: Iterable[Piece], stream: EstimateStream) -> Iterator[Piece]:
        for batch, extra in pieces:
            self._found.feed(batch, extra)
            if stream.tare is not None:
                self._asking.feed(stream.tare, batch, extra["contact"] == 1)
            yield batch, extra

    def finish(self, plan: EstimationPlan) -> tuple[Findings, Mapping[str, float]]:
        return self._found.finish(plan), self._asking.finish()


def _of_part(
    session: SessionReader, info: ArrayInfo, options: EstimateOptions, part: Slice
) -> tuple[EstimateOptions, Stretch]:
    """Return options with the tares in force in a part, and the range to read."""
    stream, tares = EstimateStream(info, options), options.tares
    if not tares:
        ordered = in_order(session.batches(), where=str(session.path))
        tares = (stream.find_tare(ordered),)
    stretch = stretch_of(session, part, stream.plan_of(tares[0]))
    if not stretch.axis.is_shifted:  # tares are on the node's time axis
        tares = since(tares, stretch.from_ns)
    return replace(options, tare_s=None, tares=tares), stretch


def _notes_of_part(
    session: SessionReader, notes: Mapping[str, object], part: Slice, stretch: Stretch
) -> dict[str, object]:
    """Return the notes that hold for a part of the session."""
    notes = {name: said for name, said in notes.items() if name not in _OF_THE_WHOLE}
    seconds = {"start_s": part.start_s, "end_s": part.end_s, "warm_up_s": stretch.warm_up_s}
    return {**notes, "part_of": {**session.identity, **seconds}}
