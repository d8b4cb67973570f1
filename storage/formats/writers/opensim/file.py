"""OpenSim writer: a zip file with a `.mot` file and the `ExternalLoads` that name its columns.

The zip file also has tables of filled stretches and of events, and metadata as text. Each of
several sessions is a separate force on a separate body, over one time.
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
import pyarrow as pa
import pyarrow.csv as pacsv

from devices.arrays import Floats
from devices.errors import UsageError
from storage.formats.export import Export
from storage.formats.writers.csv_text import write_spreadsheet_safe_csv
from storage.formats.writers.drained_buffer import DrainedBuffer
from storage.formats.writers.format import ExportFormat
from storage.formats.writers.ground_reaction import GroundReaction, read_reactions_on_common_axis
from storage.formats.writers.multi_session import make_names_unique
from storage.formats.writers.opensim.loads import (
    GROUND_X,
    LOAD_COLUMNS,
    FootLoads,
    compute_gapless_foot_loads,
)
from storage.formats.writers.text_metadata import (
    format_largest_clock_bound,
    format_metadata,
    to_ascii_line,
)
from storage.formats.writers.xml_text import escape_xml_invalid_characters

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


def _encode(export: Export) -> Iterator[bytes]:
    return _encode_together([export])


def _encode_together(exports: Sequence[Export]) -> Iterator[bytes]:
    feet = _make_feet(exports)
    named = to_ascii_line(str(exports[0].metadata.get("session") or "session"))
    stem = _INVALID_IN_NAMES.sub(
        "_", named if len(feet) == 1 else f"{named}-and-{len(feet) - 1}-more"
    )
    filled = [foot.loads.list_filled_stretches() for foot in feet]
    foot_notes = [_make_notes(foot, table) for foot, table in zip(feet, filled, strict=True)]
    events = [_make_event_table(foot.reaction) for foot in feet]
    time_s = feet[0].reaction.resampling.elapsed_s
    table = np.concatenate([time_s[:, None], *(foot.loads.table for foot in feet)], axis=1)
    sink = DrainedBuffer()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        file.writestr(_make_zip_entry(f"{stem}.xml"), make_external_loads_xml(f"{stem}.mot", feet))
        file.writestr(
            _make_zip_entry(f"{stem}_filled.csv"), _encode_csv(_join_tables(filled, feet))
        )
        file.writestr(
            _make_zip_entry(f"{stem}_events.csv"), _encode_csv(_join_tables(events, feet))
        )
        notes = foot_notes[0] if len(foot_notes) == 1 else {"SESSIONS": foot_notes}
        file.writestr(_make_zip_entry(f"{stem}_notes.json"), json.dumps(notes, indent=1))
        with file.open(_make_zip_entry(f"{stem}.mot"), "w", force_zip64=True) as entry:
            names = ["time", *(foot.column_prefix + name for foot in feet for name in LOAD_COLUMNS)]
            entry.write(_encode_mot_head(stem, len(table), names))
            for begin in range(0, len(table), _CHUNK_ROWS):
                entry.write(_encode_mot_rows(table[begin : begin + _CHUNK_ROWS], names))
                yield sink.drain()
    yield sink.drain()


def _make_feet(exports: Sequence[Export]) -> list[ExportedFoot]:
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
                + ", ".join(each.display_name for each in exports),
            )
    found = read_reactions_on_common_axis(exports, [GROUND_X], FRAMES_MAX // len(exports))
    loads = [
        compute_gapless_foot_loads(each, export, is_only_foot=is_alone)
        for each, export in zip(found, exports, strict=True)
    ]
    return [
        ExportedFoot(*of_foot) for of_foot in zip(exports, found, loads, names, bodies, strict=True)
    ]


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


def _make_notes(foot: ExportedFoot, filled: pa.Table) -> dict[str, object]:
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
    bound = (
        {}
        if foot.reaction.server_time_bound_s is None
        else format_largest_clock_bound(foot.reaction.server_time_bound_s)
    )
    return {
        **format_metadata(foot.export, steady.begin_ns),
        "AXES": to_ascii_line(axes),
        "RESAMPLED": steady.describe(),
        "FILLED": "unknown numbers, as the format has no number for them: every stretch is in the "
        "table of filled stretches",
        "BODY": foot.body,
        "COLUMNS": f"{foot.column_prefix}ground_force_vx and the eight behind it",
        "NOT_MEASURED": "shear and free moment: 0",
        "ROWS": len(foot.loads.table),
        "FILLED_ROWS": dict(by_reason),
        "MARKS": foot.reaction.marker_count,
        **bound,
    }


def _encode_mot_head(name: str, rows: int, columns: Sequence[str]) -> bytes:
    head = f"{name}\nversion=1\nnRows={rows}\nnColumns={len(columns)}\ninDegrees=no\nendheader\n"
    return (head + "\t".join(columns) + "\n").encode()


def _encode_mot_rows(rows: Floats, columns: Sequence[str]) -> bytes:
    digits = [9, *([6] * (len(columns) - 1))]
    arrays = [np.round(rows[:, i], digits[i]) + 0.0 for i in range(len(columns))]
    table = pa.table(arrays, names=list(columns))
    sink = BytesIO()
    options = pacsv.WriteOptions(include_header=False, delimiter="\t", quoting_style="none")
    pacsv.write_csv(table, sink, options)
    return sink.getvalue()


def _make_event_table(reaction: GroundReaction) -> pa.Table:
    times = pa.array([at_s for at_s, _ in reaction.events], pa.float64())
    labels = pa.array([label for _, label in reaction.events], pa.string())
    kinds = ["marker"] * reaction.marker_count + ["contact"] * (
        len(reaction.events) - reaction.marker_count
    )
    return pa.table([times, labels, pa.array(kinds, pa.string())], names=["time", "event", "kind"])


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
    group_encoder=_encode_together,
    suffix="opensim.zip",
    options=("body",),
    takes_columns=False,
    needs_forces=True,
    frames_max=FRAMES_MAX,
)
