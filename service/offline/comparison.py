"""Comparison of a sealed session with a reference: reading, alignment, errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.arrays import Columns, Floats
from devices.errors import ComparisonError, FileFormatError, UsageError
from devices.flags import EstimateFlag
from service.json_output import to_json_text
from service.offline.compare.alignment import (
    ClockLag,
    ReferenceAlignment,
    align_signals,
    describe_clock_contradiction,
)
from service.offline.compare.error_figures import ComparisonErrors, compute_errors
from service.offline.compare.paired_frames import (
    COMPARED_COLUMNS,
    PairedFrames,
    ReferenceSignals,
    TrialMarker,
    pair_frames,
    split_into_trials,
)
from service.offline.compare.plausibility import (
    advise_on_scale,
    check_cop_position,
    check_force_unit,
    check_time_unit,
    describe_implausible_alignment,
)
from service.offline.compare.report import (
    FIGURES_WITH_LOWER_LIMIT,
    format_comparison_report,
    plot_comparison,
)
from service.offline.compare.signals import ForceSignal
from storage.documents import write_checksummed_json
from storage.durable_files import write_atomically
from storage.formats.markers import place_session_markers
from storage.formats.readers.parquet import is_sealed_session_file
from storage.formats.reference import ReferenceData, ReferenceOptions, read_reference
from storage.formats.slice import Slice
from storage.schema import UNKNOWN_T_NS, numpy_dtype_of
from storage.sessions.comparisons import (
    MAX_SERIES_ROWS,
    REPORT_NAME,
    SERIES_NAME,
    SERIES_SCHEMA,
    write_comparison_series,
)
from storage.sessions.metadata import MARKERS_NAME, load_clock_table, read_existing_markers
from storage.sessions.reader import SealedFileReader

ROW_COLUMN = "row"
"""Column added to a session's columns: the frame's row in the file."""
ANGLE_COLUMN = "angle_rad"
"""Column of a foot with a servo, read beside the compared ones."""


@dataclass(frozen=True)
class CompareOptions:
    """Options of a comparison; see `foottile compare --help`."""

    stated: ReferenceOptions
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
        tile_force_n: (n, tiles), tile forces of these frames; NaN for a tile without dome.
        serials: serials of the tiles.
        errors: errors by trial and over trials.
        trial_definition: definition of a trial, in words.
        notes: remarks on both recordings.
        advice: suggestions for a more informative comparison.
        options: options of the comparison.
    """

    session: Mapping[str, object]
    reference: str
    alignment: ReferenceAlignment
    clock_lag: ClockLag | None
    pairs: PairedFrames
    tile_force_n: Floats
    serials: tuple[str, ...]
    errors: ComparisonErrors
    trial_definition: str
    notes: tuple[str, ...]
    advice: tuple[str, ...]
    options: CompareOptions

    def as_dict(self) -> dict[str, object]:
        """Return the content that `service.json_output.to_json_value` converts."""
        alignment, pairs = self.alignment, self.pairs
        return {
            "session": self.session,
            "reference": self.reference,
            "notes": (*self.notes, *self.advice),
            "alignment": {
                "lag_s": alignment.lag_s,
                "clock_lag_s": self.clock_lag,
                "at_s": alignment.mid_t_s,
                "drift_ppm": alignment.drift_ppm,
                "scale": alignment.scale,
                "offset_n": alignment.offset_n,
                "offset_in_flight_n": pairs.reference_zero_n,
                "offset_removed": pairs.is_zero_removed,
                "blocks": alignment.block_count,
                "ambiguity": alignment.ambiguity,
            },
            "contact_n": pairs.contact_threshold_n,
            "reference_sigma_n": self.options.reference_sigma_n,
            "reference_cop_sigma_m": self.options.reference_cop_sigma_m,
            "trials_are": self.trial_definition,
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
    if is_sealed_session_file(reference_path) and not is_sealed_session_file(path):
        raise FileFormatError(
            f"it is not a session, and {reference_path.name} is one",
            where=str(path),
            expected="SESSION first, and what it is compared with behind --reference",
            remedy="Were they swapped?",
        )
    data = read_reference(reference_path, options.stated)
    with SealedFileReader(path) as session:
        columns, force_n = _read_columns(session)
        markers, notes = _read_trial_markers(session, path, columns)
        notes += [remark] if (remark := session.time_axis.explain_shift_or_empty()) else []
        tiles, identity = session.info.tiles, session.session_id_and_hashes
    known = np.isfinite(columns["grf_n"])
    if not known.any():
        raise ComparisonError("no frame of the session has a GRF", where=str(path))
    t_ns = columns["t_ns"]
    reference = _make_reference_signals(data, int(t_ns[0]), options.cop_offset_m)
    ours = ForceSignal(
        (t_ns[known] - t_ns[0]) * 1e-9, columns["grf_n"][known], columns["grf_sigma_n"][known]
    )
    check_time_unit(ours, reference.force)
    alignment = align_signals(ours, reference.force, lag_range_s=options.lag_range_s)
    check_force_unit(alignment)
    pairs = pair_frames(
        columns,
        reference,
        alignment,
        remove_offset=options.remove_offset,
        contact_n=options.contact_n,
    )
    places_m = np.array([(tile.x_m, tile.y_m) for tile in tiles if not tile.reference])
    notes += [
        *data.notes,
        *check_cop_position(pairs, places_m, options.reference_cop_sigma_m),
        *describe_implausible_alignment(alignment),
    ]
    notes += [*_describe_limitations(alignment, pairs, options)]
    at_ns = int(t_ns[0]) + round(1e9 * alignment.mid_t_s)
    by_clocks = (
        _compute_clock_lag(path, reference_path, at_ns)
        if is_sealed_session_file(reference_path)
        else None
    )
    notes += describe_clock_contradiction(alignment, by_clocks)
    trials, what = split_into_trials(pairs.columns["t_ns"], pairs.columns["part"], markers)
    return Comparison(
        session={"file": str(path), **identity},
        reference=data.where,
        alignment=alignment,
        clock_lag=by_clocks,
        pairs=pairs,
        tile_force_n=force_n[pairs.columns[ROW_COLUMN]],
        serials=tuple(tile.serial for tile in tiles),
        errors=compute_errors(
            pairs,
            trials,
            reference_sigma_n=options.reference_sigma_n,
            reference_cop_sigma_m=options.reference_cop_sigma_m,
        ),
        trial_definition=what,
        notes=tuple(notes),
        advice=tuple(_give_advice(alignment, options)),
        options=options,
    )


def _read_columns(session: SealedFileReader) -> tuple[Columns, Floats]:
    """Read the compared columns, with `t_ns` on the session's time axis, and the tile forces."""
    wanted = [*COMPARED_COLUMNS, "force_n"]
    if absent := [name for name in wanted if not session.has_columns(name)]:
        raise FileFormatError(
            f"the session has no {', '.join(absent)}",
            where=str(session.path),
            remedy="Estimate it first, with `foottile estimate`",
        )
    if has_part := session.has_columns("part"):
        wanted.append("part")
    if session.has_columns(ANGLE_COLUMN):
        wanted.append(ANGLE_COLUMN)
    pieces = list(session.read_quantities(*wanted))
    if not pieces:
        raise FileFormatError("the session has no frames", where=str(session.path))
    columns = {name: np.concatenate([piece[name] for piece in pieces]) for name in wanted}
    columns["t_ns"] = session.time_axis.shift_to_axis(columns["t_ns"], columns.get("part"))
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
    columns[ROW_COLUMN] = np.arange(len(force_n))
    return columns, force_n


def _read_trial_markers(
    session: SealedFileReader, path: Path, columns: Columns
) -> tuple[list[TrialMarker], list[str]]:
    """Read a session's markers at their frames; also return notes on those without a frame."""
    beside = path.with_name(MARKERS_NAME)
    if not beside.is_file():
        return [], []
    placed = place_session_markers(session, read_existing_markers(beside), Slice())
    markers = []
    for marker in placed.markers:
        if marker.frame is not None:
            at = (columns["part"] == marker.frame[0]) & (columns["seq"] == marker.frame[1])
            markers.append(TrialMarker(marker.marker.label, int(columns["t_ns"][at][0])))
    lost = [
        f"marker {one.marker.label!r} begins no trial: {one.exclusion_reason}"
        for one in placed.excluded
    ]
    return markers, lost


def _compute_clock_lag(path: Path, reference_path: Path, at_ns: int) -> ClockLag | None:
    """Compute the lag from two sessions' clock tables; None if either has no row at `at_ns`."""
    found = [_compute_server_offset_ns(one, at_ns) for one in (path, reference_path)]
    if found[0] is None or found[1] is None:
        return None
    (own_ns, own_within_ns), (their_ns, their_within_ns) = found[0], found[1]
    return ClockLag(1e-9 * (own_ns - their_ns), 1e-9 * (own_within_ns + their_within_ns))


def _compute_server_offset_ns(path: Path, at_ns: int) -> tuple[int, int] | None:
    """Return server time minus session time at the nearest frame, and its bound, in ns."""
    with SealedFileReader(path) as session:
        try:
            clock = load_clock_table(session)
        except (UsageError, FileFormatError):
            return None
        wanted = ("t_mono_ns", "t_ns", *(("part",) if session.has_columns("part") else ()))
        nearest: dict[str, npt.NDArray[Any]] | None = None
        for piece in session.read_quantities(*wanted):
            piece["axis_ns"] = session.time_axis.shift_to_axis(piece["t_ns"], piece.get("part"))
            row = int(np.argmin(np.abs(piece["axis_ns"] - at_ns)))
            one = {name: values[row : row + 1] for name, values in piece.items()}
            apart_ns = abs(int(one["axis_ns"][0]) - at_ns)
            if nearest is None or apart_ns < abs(int(nearest["axis_ns"][0]) - at_ns):
                nearest = one
    assert nearest is not None  # noqa: S101  # both have been compared
    server_times = clock.compute_server_time_columns_or_unknown(
        nearest["t_mono_ns"], nearest["t_ns"], nearest.get("part")
    )
    server_ns = int(server_times["t_server_ns"][0])
    if server_ns == UNKNOWN_T_NS:
        return None
    return server_ns - int(nearest["axis_ns"][0]), int(server_times["t_server_uncertainty_ns"][0])


def _make_reference_signals(
    data: ReferenceData, begin_ns: int, cop_offset_m: tuple[float, float]
) -> ReferenceSignals:
    since_s = 0.0 if data.epoch_ns is None else (data.epoch_ns - begin_ns) * 1e-9
    force = ForceSignal(data.time_s + since_s, data.grf_n)
    return ReferenceSignals(
        force, None if data.cop_m is None else data.cop_m + np.array(cop_offset_m)
    )


def _describe_limitations(
    alignment: ReferenceAlignment, pairs: PairedFrames, options: CompareOptions
) -> Sequence[str]:
    notes = []
    if alignment.ambiguity is not None:
        other = alignment.ambiguity
        notes.append(
            f"a lag of {other.lag_s:.3f} s fits nearly as well (correlation "
            f"{other.correlation:.3f}, {other.best_correlation:.3f} at the one taken): chance "
            "does not explain the difference"
        )
    if options.remove_offset and not pairs.is_zero_removed:
        notes.append(
            "no flight is long enough to estimate the reference's offset; it is not removed"
        )
    elif not pairs.is_zero_removed and pairs.reference_zero_n is not None:
        low_n, high_n = pairs.reference_zero_n.interval_95
        if low_n > 0.0 or high_n < 0.0:
            notes.append(
                f"the reference reads {pairs.reference_zero_n.value:.3f} N in flight, which is in "
                "every error: --remove-offset takes it off"
            )
    if not pairs.is_counted.all():
        notes.append("the reference is slower than ours: the frame nearest to each sample counts")
    if (pairs.columns["estimate_flags"] & np.uint16(EstimateFlag.ASSUMED_SCALE)).any():
        notes.append("our newtons rest on an assumed scale: the calibration was not measured")
    return notes


def _give_advice(alignment: ReferenceAlignment, options: CompareOptions) -> list[str]:
    if options.reference_sigma_n is not None:
        return advise_on_scale(alignment)
    hint = "coverage is not computed: --reference-sigma-n is not given"
    return [*advise_on_scale(alignment), hint]


_MISSING_FIGURE_HINTS = {
    **dict.fromkeys(
        ("grf_coverage_95",), ": give the reference's uncertainty with --reference-sigma-n"
    ),
    **dict.fromkeys(
        ("cop_coverage_x_95", "cop_coverage_y_95"),
        ": give the reference's COP uncertainty with --reference-cop-sigma-m",
    ),
    **dict.fromkeys(
        ("cop_mean_m", "cop_p95_m", "cop_bias_x_m", "cop_bias_y_m", "cop_p95_about_mean_m"),
        ": the reference has no centre of pressure under load",
    ),
}
"""Requirement of each figure that may be missing, appended to error messages."""


@dataclass(frozen=True)
class WrittenComparison:
    """Files of a comparison that were written.

    Attributes:
        content: content of `compare.json`.
        report_text: content of `compare.md`.
        missed_limits: descriptions of missed limits.
    """

    content: Mapping[str, Any]
    report_text: str
    missed_limits: tuple[str, ...]


def write_comparison(
    session_path: Path,
    reference_path: Path,
    options: CompareOptions,
    limits: Mapping[str, float],
    folder: Path,
    title: str,
) -> WrittenComparison:
    """Compare a sealed session with a reference; write figures, report, plot and series.

    `series.parquet` is not written if it would exceed `ROWS_MAX`.

    Args:
        session_path: the session's frames file.
        reference_path: the reference file.
        options: options of the comparison.
        limits: limits of figures' means, by name.
        folder: folder to write to.
        title: title of report and plot.

    Raises:
        FootTileError: as for `compare_session`; or a file cannot be written.
    """
    found = compare_session(session_path, reference_path, options)
    figures = found.errors.figures
    missed = tuple(
        missed_limit
        for name, limit in limits.items()
        if (missed_limit := _describe_missed_limit(name, figures[name].mean, limit)) is not None
    )
    text = format_comparison_report(
        title,
        found.alignment,
        found.clock_lag,
        found.pairs,
        found.errors,
        found.trial_definition,
        (*found.notes, *found.advice),
    )
    png = plot_comparison(title, found.pairs, found.tile_force_n, found.serials, found.errors)
    content = {**found.as_dict(), "limits": limits, "missed": missed}
    write_checksummed_json(folder / REPORT_NAME, to_json_text(content).encode())
    write_atomically(folder / "compare.md", text.encode())
    write_atomically(folder / "compare.png", png)
    if len(found.pairs.t_s) <= MAX_SERIES_ROWS:
        write_comparison_series(folder / SERIES_NAME, _build_series(found.pairs))
    else:  # of an earlier comparison
        (folder / SERIES_NAME).unlink(missing_ok=True)
    return WrittenComparison(content, text, missed)


def _build_series(pairs: PairedFrames) -> pa.Table:
    """Build the table of our frames at which the reference is known."""
    cop_m = np.where(pairs.reference_contact[:, None], pairs.reference_cop_m, np.nan)
    columns = {
        "t_ns": pairs.columns["t_ns"],
        "grf_n": pairs.columns["grf_n"],
        "reference_grf_n": pairs.reference_n,
        "reference_cop_x_m": cop_m[:, 0],
        "reference_cop_y_m": cop_m[:, 1],
    }
    return pa.table(
        [
            # from_pandas: NaN is null
            pa.array(columns[field.name].astype(numpy_dtype_of(field.type)), from_pandas=True)
            for field in SERIES_SCHEMA
        ],
        schema=SERIES_SCHEMA,
    )


def _describe_missed_limit(name: str, mean: float, limit: float) -> str | None:
    """Describe a missed limit; None if it is met."""
    if math.isnan(mean):
        hint = _MISSING_FIGURE_HINTS.get(name, "")
        return f"{name} is not known here, and was limited to {limit:g}{hint}"
    if name in FIGURES_WITH_LOWER_LIMIT:
        kept, words = mean >= limit, "at least"
    else:
        kept, words = abs(mean) <= limit, "at most"
    return None if kept else f"{name} is {mean:.4g}, and was to be {words} {limit:g}"
