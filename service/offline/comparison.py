"""Comparison of a sealed session with a reference: reading, alignment, errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.errors import ComparisonError, FileFormatError, UsageError
from service.estimation.estimates import EstimateStatus
from service.offline.compare.align import Alignment, align
from service.offline.compare.clocks import ClockLag, clock_notes
from service.offline.compare.errors import Errors, errors_of
from service.offline.compare.pairs import COMPARED, Columns, Pairs, Reference, pair
from service.offline.compare.plausible import (
    check_force_unit,
    check_time_unit,
    cop_notes,
    far_notes,
    gain_notes,
)
from service.offline.compare.signals import Signal
from service.offline.compare.trials import Mark, trials_of
from storage.formats.reference import ReferenceData, Stated, read_reference
from storage.formats.sealed import marks_of
from storage.formats.slice import Slice
from storage.formats.tables.session import is_session
from storage.schema import NO_INSTANT
from storage.sessions.beside import EVENTS_NAME, clock_beside, read_events
from storage.sessions.reader import SessionReader

ROW = "row"
"""Column added to a session's columns: the frame's row in the file."""
ANGLE = "angle_rad"
"""Column of a foot with a servo, read beside the compared ones."""


@dataclass(frozen=True)
class CompareOptions:
    """Options of a comparison; see `foottile compare --help`."""

    stated: Stated
    lag_range_s: tuple[float, float] | None = None
    remove_offset: bool = False
    contact_n: float | None = None
    cop_offset_m: tuple[float, float] = (0.0, 0.0)
    reference_sigma_n: float | None = None
    reference_cop_sigma_m: float | None = None


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Attributes:
        session: path and identity of the session.
        reference: path of the reference.
        alignment: alignment of both.
        clock_lag: lag by the clock tables, if both are sessions of one server.
        pairs: our frames with the reference.
        force_n: (n, tiles), tile forces of these frames; NaN for a tile without dome.
        serials: serials of the tiles.
        errors: errors by trial and over trials.
        trials_are: definition of a trial, in words.
        notes: remarks on both recordings.
        advice: suggestions for a more informative comparison.
        options: options of the comparison.
    """

    session: Mapping[str, object]
    reference: str
    alignment: Alignment
    clock_lag: ClockLag | None
    pairs: Pairs
    force_n: Floats
    serials: tuple[str, ...]
    errors: Errors
    trials_are: str
    notes: tuple[str, ...]
    advice: tuple[str, ...]
    options: CompareOptions

    def as_dict(self) -> dict[str, object]:
        """Return the JSON representation."""
        alignment, pairs = self.alignment, self.pairs
        return {
            "session": self.session,
            "reference": self.reference,
            "notes": (*self.notes, *self.advice),
            "alignment": {
                "lag_s": alignment.lag_s,
                "clock_lag_s": self.clock_lag,
                "at_s": alignment.at_s,
                "drift_ppm": alignment.drift_ppm,
                "scale": alignment.scale,
                "offset_n": alignment.offset_n,
                "offset_in_flight_n": pairs.zero_n,
                "offset_removed": pairs.removed,
                "blocks": alignment.blocks,
                "ambiguity": alignment.ambiguity,
            },
            "contact_n": pairs.contact_n,
            "reference_sigma_n": self.options.reference_sigma_n,
            "reference_cop_sigma_m": self.options.reference_cop_sigma_m,
            "trials_are": self.trials_are,
            "figures": self.errors.figures,
            "trials": self.errors.trials,
        }


def compare_session(path: Path, reference_path: Path, options: CompareOptions) -> Comparison:
    """Compare a sealed session with a reference.

    Raises:
        FileFormatError: a file cannot be read, or the session has no estimates.
        UsageError: a unit or sign of the reference is not stated.
        ComparisonError: the two cannot be compared.
    """
    if is_session(reference_path) and not is_session(path):
        raise FileFormatError(
            f"it is not a session, and {reference_path.name} is one",
            where=str(path),
            expected="SESSION first, and what it is compared with behind --reference",
            remedy="Were they swapped?",
        )
    data = read_reference(reference_path, options.stated)
    with SessionReader(path) as session:
        columns, force_n = _columns(session)
        marks, notes = _marks(session, path, columns)
        notes += [remark] if (remark := session.axis.remark()) else []
        tiles, identity = session.info.tiles, session.identity
    known = np.isfinite(columns["grf_n"])
    if not known.any():
        raise ComparisonError("no frame of the session has a GRF", where=str(path))
    t_ns = columns["t_ns"]
    reference = _reference(data, int(t_ns[0]), options.cop_offset_m)
    ours = Signal(
        (t_ns[known] - t_ns[0]) * 1e-9, columns["grf_n"][known], columns["grf_sigma_n"][known]
    )
    check_time_unit(ours, reference.force)
    alignment = align(ours, reference.force, lag_range_s=options.lag_range_s)
    check_force_unit(alignment)
    pairs = pair(
        columns,
        reference,
        alignment,
        remove_offset=options.remove_offset,
        contact_n=options.contact_n,
    )
    places_m = np.array([(tile.x_m, tile.y_m) for tile in tiles if not tile.reference])
    notes += [*data.notes, *cop_notes(pairs, places_m), *far_notes(alignment)]
    notes += [*_remarks(alignment, pairs, options)]
    at_ns = int(t_ns[0]) + round(1e9 * alignment.at_s)
    by_clocks = _clock_lag(path, reference_path, at_ns) if is_session(reference_path) else None
    notes += clock_notes(alignment, by_clocks)
    trials, what = trials_of(pairs.columns["t_ns"], pairs.columns["part"], marks)
    return Comparison(
        session={"file": str(path), **identity},
        reference=data.where,
        alignment=alignment,
        clock_lag=by_clocks,
        pairs=pairs,
        force_n=force_n[pairs.columns[ROW]],
        serials=tuple(tile.serial for tile in tiles),
        errors=errors_of(
            pairs,
            trials,
            reference_sigma_n=options.reference_sigma_n,
            reference_cop_sigma_m=options.reference_cop_sigma_m,
        ),
        trials_are=what,
        notes=tuple(notes),
        advice=tuple(_advice(alignment, options)),
        options=options,
    )


def _columns(session: SessionReader) -> tuple[Columns, Floats]:
    """Read the compared columns, with `t_ns` on the session's time axis, and the tile forces."""
    wanted = [*COMPARED, "force_n"]
    if absent := [name for name in wanted if not session.has(name)]:
        raise FileFormatError(
            f"the session has no {', '.join(absent)}",
            where=str(session.path),
            remedy="Estimate it first, with `foottile estimate`",
        )
    if has_part := session.has("part"):
        wanted.append("part")
    if session.has(ANGLE):
        wanted.append(ANGLE)
    pieces = list(session.columns(*wanted))
    if not pieces:
        raise FileFormatError("the session has no frames", where=str(session.path))
    columns = {name: np.concatenate([piece[name] for piece in pieces]) for name in wanted}
    columns["t_ns"] = session.axis.at(columns["t_ns"], columns.get("part"))
    if (np.diff(columns["t_ns"]) <= 0).any():
        raise ComparisonError(
            "time decreases within a part of the session",
            where=str(session.path),
            expected="frames whose t_ns rises",
            remedy="Check it with foottile verify",
        )
    force_n = columns.pop("force_n").astype(np.float64)
    columns["grf_n"] = columns["grf_n"].astype(np.float64)
    columns["grf_sigma_n"] = columns["grf_sigma_n"].astype(np.float64)
    if not has_part:
        columns["part"] = np.zeros(len(force_n), dtype=np.uint16)
    columns[ROW] = np.arange(len(force_n))
    return columns, force_n


def _marks(session: SessionReader, path: Path, columns: Columns) -> tuple[list[Mark], list[str]]:
    """Read a session's markers at their frames; also return notes on those without a frame."""
    beside = path.with_name(EVENTS_NAME)
    if not beside.is_file():
        return [], []
    placed = marks_of(session, read_events(beside).events, Slice())
    marks = []
    for mark in placed.all:
        if mark.frame is not None:
            at = (columns["part"] == mark.frame[0]) & (columns["seq"] == mark.frame[1])
            marks.append(Mark(mark.event.label, int(columns["t_ns"][at][0])))
    lost = [f"mark {one.event.label!r} begins no trial: {one.left_out}" for one in placed.left_out]
    return marks, lost


def _clock_lag(path: Path, reference_path: Path, at_ns: int) -> ClockLag | None:
    """Compute the lag from two sessions' clock tables; None if either has no row at `at_ns`."""
    found = [_server_offset(one, at_ns) for one in (path, reference_path)]
    if found[0] is None or found[1] is None:
        return None
    (own_ns, own_within_ns), (their_ns, their_within_ns) = found[0], found[1]
    return ClockLag(1e-9 * (own_ns - their_ns), 1e-9 * (own_within_ns + their_within_ns))


def _server_offset(path: Path, at_ns: int) -> tuple[int, int] | None:
    """Return server time minus session time at the nearest frame, and its bound, in ns."""
    with SessionReader(path) as session:
        try:
            clock = clock_beside(session)
        except (UsageError, FileFormatError):
            return None
        wanted = ("t_mono_ns", "t_ns", *(("part",) if session.has("part") else ()))
        nearest: dict[str, npt.NDArray[Any]] | None = None
        for piece in session.columns(*wanted):
            piece["axis_ns"] = session.axis.at(piece["t_ns"], piece.get("part"))
            row = int(np.argmin(np.abs(piece["axis_ns"] - at_ns)))
            one = {name: values[row : row + 1] for name, values in piece.items()}
            apart_ns = abs(int(one["axis_ns"][0]) - at_ns)
            if nearest is None or apart_ns < abs(int(nearest["axis_ns"][0]) - at_ns):
                nearest = one
    assert nearest is not None  # noqa: S101  # both have been compared
    server_times = clock.columns(nearest["t_mono_ns"], nearest["t_ns"], nearest.get("part"))
    server_ns = int(server_times["t_server_ns"][0])
    if server_ns == NO_INSTANT:
        return None
    return server_ns - int(nearest["axis_ns"][0]), int(server_times["t_server_uncertainty_ns"][0])


def _reference(data: ReferenceData, begin_ns: int, cop_offset_m: tuple[float, float]) -> Reference:
    since_s = 0.0 if data.epoch_ns is None else (data.epoch_ns - begin_ns) * 1e-9
    force = Signal(data.time_s + since_s, data.grf_n)
    return Reference(force, None if data.cop_m is None else data.cop_m + np.array(cop_offset_m))


def _remarks(alignment: Alignment, pairs: Pairs, options: CompareOptions) -> Sequence[str]:
    notes = []
    if alignment.ambiguity is not None:
        other = alignment.ambiguity
        notes.append(
            f"a lag of {other.lag_s:.3f} s fits nearly as well (correlation "
            f"{other.correlation:.3f}, {other.best_correlation:.3f} at the one taken): chance "
            "does not explain the difference"
        )
    if options.remove_offset and not pairs.removed:
        notes.append(
            "no flight is long enough to estimate the reference's offset; it is not removed"
        )
    elif not pairs.removed and pairs.zero_n is not None:
        low_n, high_n = pairs.zero_n.interval_95
        if low_n > 0.0 or high_n < 0.0:
            notes.append(
                f"the reference reads {pairs.zero_n.value:.3f} N in flight, which is in every "
                "error: --remove-offset takes it off"
            )
    if not pairs.judged.all():
        notes.append("the reference is slower than ours: the frame nearest to each sample counts")
    if _any(pairs, EstimateStatus.ASSUMED_SCALE):
        notes.append("our newtons rest on an assumed scale: the calibration was not measured")
    return notes


def _advice(alignment: Alignment, options: CompareOptions) -> list[str]:
    if options.reference_sigma_n is not None:
        return gain_notes(alignment)
    hint = "coverage is not computed: --reference-sigma-n is not given"
    return [*gain_notes(alignment), hint]


def _any(pairs: Pairs, bit: EstimateStatus) -> bool:
    status: npt.NDArray[np.uint16] = pairs.columns["estimate_status"]
    return bool((status & np.uint16(bit)).any())
