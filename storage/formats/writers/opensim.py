"""OpenSim writer: loads of each foot as rows without gaps, and their files.

The zip file also has tables of filled stretches and of events, and metadata as text. Each of
several sessions is a separate force on a separate body, over one time.

OpenSim's axes: x forward, y up, z to the right. Points are in the ground's frame if the session
has it; else force and point are in the frame of the foot's body, which moves them. The ground frame
of each foot lies under its ankle, and relative positions of feet are unknown: for several feet, all
are in the frames of their bodies.

A `.mot` file has no value for unknown numbers, so they are filled. A table lists every filled
stretch, to distinguish it from measured values.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pacsv

from devices.arrays import Floats
from devices.errors import UsageError
from storage.formats.export import Export
from storage.formats.writers.force_gaps import (
    BridgedForce,
    TrialRows,
    bridge_force_gaps,
    fill_point_gaps,
    select_trial_rows,
)
from storage.formats.writers.format import (
    DrainedBuffer,
    ExportFormat,
    escape_xml_invalid_characters,
    format_largest_clock_bound,
    format_metadata,
    make_names_unique,
    to_ascii_line,
)
from storage.formats.writers.resampling import COP, GroundReaction, read_reactions_on_common_axis
from storage.formats.writers.tables import write_spreadsheet_safe_csv

LOAD_COLUMNS = (
    *(f"ground_force_v{axis}" for axis in "xyz"),
    *(f"ground_force_p{axis}" for axis in "xyz"),
    *(f"ground_torque_{axis}" for axis in "xyz"),
)
"""Columns of one foot, after `time`."""
GROUND_X = "cop_ground_x_m"
"""Ground x; the foot rolls about its y axis, so y is the same in both frames."""


_FILL_REASONS = {
    1: (
        "force and point",
        "force 0, point as before and behind, on a line between",
        "no contact",
    ),
    2: ("force", "line between the forces before and behind", "GRF not known"),
    3: ("force", "line between the forces before and behind", "no frame: lost or not taken"),
    4: ("point", "nearest of its stance, on a line between two", "no centre of pressure stated"),
}
_NOT_FILLED = 0
_UNLOADED, _LINE, _LINE_EMPTY, _POINT = _FILL_REASONS


@dataclass(frozen=True)
class FootLoads:
    """Loads on one foot in n rows of a `.mot` file, with a code for filled rows.

    Attributes:
        time_s: (n,), times since the first row.
        table: (n, 9), loads in the order of `LOAD_COLUMNS`; no NaN.
        fill_code: (n,), reason for filling: a key of `_FILL_REASONS`; 0 if the row is not filled.
        estimate_flags: (n,), `estimate_flags`, NaN without a frame.
        frame: frame of forces and points, "ground" or "foot".
    """

    time_s: Floats
    table: Floats
    fill_code: npt.NDArray[np.uint8]
    estimate_flags: Floats
    frame: str

    def list_filled_stretches(self) -> pa.Table:
        """Return the table of filled stretches: from, to, what, by what, why, and flags."""
        edges = np.flatnonzero(np.diff(self.fill_code)) + 1
        begins, ends = np.append(0, edges), np.append(edges, len(self.fill_code))
        is_filled = self.fill_code[begins] != _NOT_FILLED
        begins, ends = begins[is_filled], ends[is_filled]
        reasons = [_FILL_REASONS[int(self.fill_code[begin])] for begin in begins]
        stretches = zip(begins, ends, strict=True)
        columns = [
            pa.array(self.time_s[begins]),
            pa.array(self.time_s[ends - 1]),
            pa.array(ends - begins, pa.int64()),
            *(pa.array([reason[i] for reason in reasons], pa.string()) for i in range(3)),
            pa.array([_combined_flags(self.estimate_flags[a:b]) for a, b in stretches], pa.int64()),
        ]
        names = ["from_s", "to_s", "rows", "filled", "with", "because", "estimate_flags"]
        return pa.table(columns, names=names)


def _compute_foot_loads(
    reaction: GroundReaction,
    force: BridgedForce,
    export: Export,
    rows: slice,
    *,
    is_only_foot: bool,
) -> FootLoads:
    """Compute the loads on the foot in rows with a known force, with unknown points filled.

    Args:
        reaction: ground reaction of the session.
        force: its force.
        export: export of the session.
        rows: rows of the file, of all samples.
        is_only_foot: True for a single foot; only then loads may be in the ground's frame.

    Raises:
        UsageError: no frame has a centre of pressure.
    """
    places = [tile.z_m for tile in export.array_info.tiles if not tile.reference]
    points = [reaction.columns[name].astype(np.float64) for name in COP]
    is_ground = False
    if is_only_foot and GROUND_X in reaction.columns:
        ground_x_m = reaction.columns[GROUND_X].astype(np.float64)
        is_ground = bool(np.isfinite(ground_x_m).any())
        points[0] = ground_x_m if is_ground else points[0]
    if not np.isfinite(points).all(axis=0).any():
        raise UsageError(
            "no centre of pressure is stated in it, and a force without a point is no load",
            where=export.session_and_node_text,
            remedy="Ask for C3D, Parquet, Arrow or CSV",
        )
    x_m, left_m = fill_point_gaps(reaction, points)
    stated = np.isfinite([reaction.resampling.interpolate(values) for values in points]).all(axis=0)
    code = np.zeros(len(reaction.resampling), dtype=np.uint8)
    code[~stated] = _POINT
    code[reaction.resample_column("contact") == 0.0] = _UNLOADED
    code[force.is_bridged] = np.where(reaction.resampling.has_frames, _LINE, _LINE_EMPTY)[
        force.is_bridged
    ]
    nothing = np.zeros(len(code))
    up_m = nothing if is_ground else np.full(len(code), float(np.mean(places)))
    columns = [nothing, force.force_n, nothing, x_m, up_m, -left_m, nothing, nothing, nothing]
    return FootLoads(
        reaction.resampling.elapsed_s[rows],
        np.stack(columns, axis=1)[rows],
        code[rows],
        reaction.resample_column("estimate_flags")[rows],
        "ground" if is_ground else "foot",
    )


def _combined_flags(flags: Floats) -> int | None:
    there = flags[np.isfinite(flags)].astype(np.int64)
    return int(np.bitwise_or.reduce(there)) if len(there) else None


FRAMES_MAX = 2_000_000
"""Limit of frames of all sessions: an hour at 544 Hz."""
DEFAULT_BODY = "foot"
"""Default body of the model; for several sessions with the node's name as prefix."""

_INVALID_IN_NAMES = re.compile(r"[^0-9A-Za-z._-]")
_CHUNK_ROWS = 1 << 15
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
"""Constant date: the same session gives the same bytes."""


@dataclass(frozen=True)
class ExportedFoot:
    """One foot of the export, with its session.

    Attributes:
        export: export of the session.
        reaction: ground reaction of the session.
        loads: loads on the foot.
        name: name of the node in characters valid for files and models; empty for a single foot.
        body: body of the model.
    """

    export: Export
    reaction: GroundReaction
    loads: FootLoads
    name: str
    body: str

    @property
    def column_prefix(self) -> str:
        """Prefix of the foot's columns."""
        return f"{self.name}_" if self.name else ""

    @property
    def frame_body(self) -> str:
        """Name of the body in whose frame force and point are expressed."""
        return "ground" if self.loads.frame == "ground" else self.body


def _encode(exports: Sequence[Export]) -> Iterator[bytes]:
    feet, trial = _make_feet(exports)
    if trial.is_remarkable:
        exports[0].remarks.append(trial.text)
    named = to_ascii_line(str(exports[0].provenance_and_slice_metadata.get("session") or "session"))
    stem = _INVALID_IN_NAMES.sub(
        "_", named if len(feet) == 1 else f"{named}-and-{len(feet) - 1}-more"
    )
    filled = [foot.loads.list_filled_stretches() for foot in feet]
    foot_notes = [_make_notes(foot, table, trial) for foot, table in zip(feet, filled, strict=True)]
    events = [_make_event_table(foot) for foot in feet]
    time_s = feet[0].loads.time_s
    table = np.concatenate([time_s[:, None], *(foot.loads.table for foot in feet)], axis=1)
    sink = DrainedBuffer()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        notes = foot_notes[0] if len(foot_notes) == 1 else {"SESSIONS": foot_notes}
        entries: dict[str, str | bytes] = {
            ".xml": make_external_loads_xml(f"{stem}.mot", feet),
            "_filled.csv": _encode_csv(_join_tables(filled, feet)),
            "_events.csv": _encode_csv(_join_tables(events, feet)),
            "_notes.json": json.dumps(notes, indent=1),
        }
        for ending, content in entries.items():
            file.writestr(_make_zip_entry(stem + ending), content)
        with file.open(_make_zip_entry(f"{stem}.mot"), "w", force_zip64=True) as entry:
            names = ["time", *(foot.column_prefix + name for foot in feet for name in LOAD_COLUMNS)]
            entry.write(_encode_mot_head(stem, len(table), names, trial.text))
            for begin in range(0, len(table), _CHUNK_ROWS):
                entry.write(_encode_mot_rows(table[begin : begin + _CHUNK_ROWS], names))
                yield sink.drain()
    yield sink.drain()


def _make_feet(exports: Sequence[Export]) -> tuple[list[ExportedFoot], TrialRows]:
    is_alone = len(exports) == 1
    nodes = make_names_unique(
        [_INVALID_IN_NAMES.sub("_", to_ascii_line(each.array_info.node)) for each in exports]
    )
    names = [""] if is_alone else nodes
    bodies = [DEFAULT_BODY] if is_alone else [f"{node}_{DEFAULT_BODY}" for node in nodes]
    if (requested := exports[0].options.body) is not None:
        bodies = requested.split(",")
        if len(bodies) != len(exports):
            raise UsageError(
                f"{len(bodies)} bodies for {len(exports)} sessions",
                expected="one for each, in their order, with commas between: "
                + ", ".join(each.session_and_node_text for each in exports),
            )
    found = read_reactions_on_common_axis(exports, [GROUND_X], FRAMES_MAX // len(exports))
    forces = [bridge_force_gaps(reaction) for reaction in found]
    trial = select_trial_rows(found, forces, exports)
    loads = [
        _compute_foot_loads(*of_foot, trial.rows, is_only_foot=is_alone)
        for of_foot in zip(found, forces, exports, strict=True)
    ]
    return [
        ExportedFoot(*of_foot) for of_foot in zip(exports, found, loads, names, bodies, strict=True)
    ], trial


def make_external_loads_xml(mot_name: str, feet: Sequence[ExportedFoot]) -> str:
    """Return the XML that maps the columns of a `.mot` file to forces on bodies."""
    forces = "".join(_make_external_force_xml(foot) for foot in feet)
    return (
        '<?xml version="1.0" encoding="UTF-8" ?>\n'
        '<OpenSimDocument Version="40000">\n'
        '\t<ExternalLoads name="foottile">\n'
        f"\t\t<objects>\n{forces}\t\t</objects>\n"
        f"\t\t<datafile>{escape(mot_name)}</datafile>\n"
        "\t</ExternalLoads>\n"
        "</OpenSimDocument>\n"
    )


def _make_external_force_xml(foot: ExportedFoot) -> str:
    tags = {
        "applied_to_body": foot.body,
        "force_expressed_in_body": foot.frame_body,
        "point_expressed_in_body": foot.frame_body,
        "force_identifier": f"{foot.column_prefix}ground_force_v",
        "point_identifier": f"{foot.column_prefix}ground_force_p",
        "torque_identifier": f"{foot.column_prefix}ground_torque_",
    }
    inside = "".join(
        f"\t\t\t\t<{tag}>{escape(escape_xml_invalid_characters(text))}</{tag}>\n"
        for tag, text in tags.items()
    )
    name = f"foottile_{foot.column_prefix}grf"
    return f'\t\t\t<ExternalForce name="{name}">\n{inside}\t\t\t</ExternalForce>\n'


def _make_notes(foot: ExportedFoot, filled: pa.Table, trial: TrialRows) -> dict[str, object]:
    by_reason = Counter[str]()
    for row in filled.to_pylist():
        by_reason[row["because"]] += row["rows"]
    axes = (
        "x forward, y up, z to the right; force and point in the ground's frame, the force "
        "upright, points at y = 0"
        if foot.frame_body == "ground"
        else "x forward, y up the segment, z to the right, origin at the ankle: the foot's own "
        f"frame, as the body {foot.body!r}; where the ground is in the model is not known"
    )
    steady = foot.reaction.resampling
    return {
        **format_metadata(foot.export, steady.axis.begin_ns),
        "AXES": to_ascii_line(axes),
        "RESAMPLED": steady.describe(),
        "FILLED": "unknown numbers, as the format has no number for them: every stretch is in the "
        "table of filled stretches",
        "GAPS": trial.text,
        "BODY": foot.body,
        "COLUMNS": f"{foot.column_prefix}ground_force_vx and the eight behind it",
        "NOT_MEASURED": "shear and free moment: 0",
        "ROWS": len(foot.loads.table),
        "FILLED_ROWS": dict(by_reason),
        "MARKS": _make_event_table(foot)["kind"].to_pylist().count("marker"),
        **format_largest_clock_bound(foot.reaction.server_time_bound_s),
    }


def _encode_mot_head(name: str, rows: int, columns: Sequence[str], gaps: str) -> bytes:
    head = f"{name}\nversion=1\nnRows={rows}\nnColumns={len(columns)}\ninDegrees=no\n"
    head += f"gaps={gaps}\nendheader\n"
    return (head + "\t".join(columns) + "\n").encode()


def _encode_mot_rows(rows: Floats, columns: Sequence[str]) -> bytes:
    digits = [9, *([6] * (len(columns) - 1))]
    arrays = [np.round(rows[:, i], digits[i]) + 0.0 for i in range(len(columns))]
    table = pa.table(arrays, names=list(columns))
    sink = BytesIO()
    options = pacsv.WriteOptions(include_header=False, delimiter="\t", quoting_style="none")
    pacsv.write_csv(table, sink, options)
    return sink.getvalue()


def _make_event_table(foot: ExportedFoot) -> pa.Table:
    """Return the events between the first row and the last."""
    reaction, time_s = foot.reaction, foot.loads.time_s
    period_s = reaction.resampling.axis.period_ns * 1e-9
    count = reaction.marker_count
    kinds = ["marker"] * count + ["contact"] * (len(reaction.events) - count)
    rows = [
        (at_s, label, kind)
        for (at_s, label), kind in zip(reaction.events, kinds, strict=True)
        if time_s[0] - period_s < at_s < time_s[-1] + period_s
    ]
    types = {"time": pa.float64(), "event": pa.string(), "kind": pa.string()}
    columns = zip(types.values(), range(len(types)), strict=True)
    arrays = [pa.array([row[i] for row in rows], type_) for type_, i in columns]
    return pa.table(arrays, names=list(types))


def _join_tables(tables: Sequence[pa.Table], feet: Sequence[ExportedFoot]) -> pa.Table:
    """Return one table; for several feet, a column `foot` tells the foot of each row."""
    if len(feet) == 1:
        return tables[0]
    return pa.concat_tables(
        table.append_column("foot", pa.array([foot.name] * len(table), pa.string()))
        for table, foot in zip(tables, feet, strict=True)
    )


def _encode_csv(table: pa.Table) -> bytes:
    sink = BytesIO()
    write_spreadsheet_safe_csv(sink, table)
    return sink.getvalue()


def _make_zip_entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, _ZIP_TIME)
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.external_attr = 0o644 << 16
    return entry


OPENSIM = ExportFormat(
    "opensim",
    "OpenSim",
    "OpenSim: .mot and ExternalLoads",
    "application/zip",
    _encode,
    group_encoder=_encode,
    suffix="opensim.zip",
    options=("body", "long_gap"),
    takes_columns=False,
    needs_forces=True,
    frames_max=FRAMES_MAX,
)
