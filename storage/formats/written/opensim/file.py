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
from storage.formats.written.csv_text import write_csv
from storage.formats.written.described import ascii_of, clock_bound, described
from storage.formats.written.format import Format
from storage.formats.written.opensim.loads import COLUMNS, GROUND_X, Loads, loads_of
from storage.formats.written.reaction import Reaction, reactions_of
from storage.formats.written.sink import Sink
from storage.formats.written.together import distinct
from storage.formats.written.xml_text import xml_text

FRAMES_MAX = 2_000_000
"""Limit of frames of all sessions: an hour at 544 Hz."""
BODY = "foot"
"""Default body of the model; for several sessions with the node's name as prefix."""

_NOT_IN_NAMES = re.compile(r"[^0-9A-Za-z._-]")
_ROWS = 1 << 15
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
"""Constant date: the same session gives the same bytes."""


@dataclass(frozen=True)
class Foot:
    """One foot of the export, with its session.

    Attributes:
        export: export of the session.
        found: ground reaction of the session.
        loads: loads on the foot.
        name: name of the node in characters valid for files and models; empty for a single foot.
        body: body of the model.
    """

    export: Export
    found: Reaction
    loads: Loads
    name: str
    body: str

    @property
    def prefix(self) -> str:
        """Prefix of the foot's columns."""
        return f"{self.name}_" if self.name else ""

    @property
    def frame(self) -> str:
        """Name of the body in whose frame force and point are expressed."""
        return "ground" if self.loads.frame == "ground" else self.body


def _write(export: Export) -> Iterator[bytes]:
    return _write_together([export])


def _write_together(exports: Sequence[Export]) -> Iterator[bytes]:
    feet = _feet(exports)
    named = ascii_of(str(exports[0].about.get("session") or "session"))
    stem = _NOT_IN_NAMES.sub("_", named if len(feet) == 1 else f"{named}-and-{len(feet) - 1}-more")
    filled = [foot.loads.filled() for foot in feet]
    foot_notes = [_said(foot, table) for foot, table in zip(feet, filled, strict=True)]
    events = [_events(foot.found) for foot in feet]
    time_s = feet[0].found.steady.time_s
    table = np.concatenate([time_s[:, None], *(foot.loads.table for foot in feet)], axis=1)
    sink = Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        file.writestr(_entry(f"{stem}.xml"), external_loads(f"{stem}.mot", feet))
        file.writestr(_entry(f"{stem}_filled.csv"), _csv(_of_feet(filled, feet)))
        file.writestr(_entry(f"{stem}_events.csv"), _csv(_of_feet(events, feet)))
        notes = foot_notes[0] if len(foot_notes) == 1 else {"SESSIONS": foot_notes}
        file.writestr(_entry(f"{stem}_notes.json"), json.dumps(notes, indent=1))
        with file.open(_entry(f"{stem}.mot"), "w", force_zip64=True) as entry:
            names = ["time", *(foot.prefix + name for foot in feet for name in COLUMNS)]
            entry.write(_head(stem, len(table), names))
            for begin in range(0, len(table), _ROWS):
                entry.write(_text(table[begin : begin + _ROWS], names))
                yield sink.taken()
    yield sink.taken()


def _feet(exports: Sequence[Export]) -> list[Foot]:
    is_alone = len(exports) == 1
    nodes = distinct([_NOT_IN_NAMES.sub("_", ascii_of(each.info.node)) for each in exports])
    names = [""] if is_alone else nodes
    bodies = [BODY] if is_alone else [f"{node}_{BODY}" for node in nodes]
    if (asked := exports[0].options.body) is not None:
        bodies = asked.split(",")
        if len(bodies) != len(exports):
            raise UsageError(
                f"{len(bodies)} bodies for {len(exports)} sessions",
                expected="one for each, in their order, with commas between: "
                + ", ".join(each.called for each in exports),
            )
    found = reactions_of(exports, [GROUND_X], FRAMES_MAX // len(exports))
    loads = [
        loads_of(each, export, is_alone=is_alone)
        for each, export in zip(found, exports, strict=True)
    ]
    return [Foot(*of_foot) for of_foot in zip(exports, found, loads, names, bodies, strict=True)]


def external_loads(mot: str, feet: Sequence[Foot]) -> str:
    """Return the XML that maps the columns of a `.mot` file to forces on bodies."""
    forces = "".join(_external_force(foot) for foot in feet)
    return (
        '<?xml version="1.0" encoding="UTF-8" ?>\n'
        '<OpenSimDocument Version="40000">\n'
        '\t<ExternalLoads name="foottile">\n'
        f"\t\t<objects>\n{forces}\t\t</objects>\n"
        f"\t\t<datafile>{escape(mot)}</datafile>\n"
        "\t</ExternalLoads>\n"
        "</OpenSimDocument>\n"
    )


def _external_force(foot: Foot) -> str:
    tags = {
        "applied_to_body": foot.body,
        "force_expressed_in_body": foot.frame,
        "point_expressed_in_body": foot.frame,
        "force_identifier": f"{foot.prefix}ground_force_v",
        "point_identifier": f"{foot.prefix}ground_force_p",
        "torque_identifier": f"{foot.prefix}ground_torque_",
    }
    inside = "".join(
        f"\t\t\t\t<{tag}>{escape(xml_text(text))}</{tag}>\n" for tag, text in tags.items()
    )
    name = f"foottile_{foot.prefix}grf"
    return f'\t\t\t<ExternalForce name="{name}">\n{inside}\t\t\t</ExternalForce>\n'


def _said(foot: Foot, filled: pa.Table) -> dict[str, object]:
    by_reason = Counter[str]()
    for row in filled.to_pylist():
        by_reason[row["because"]] += row["rows"]
    axes = (
        "x forward, y up, z to the right; force and point in the ground's frame, the force "
        "upright, points at y = 0"
        if foot.frame == "ground"
        else "x forward, y up the segment, z to the right, origin at the ankle: the foot's own "
        f"frame, as the body {foot.body!r}; where the ground is in the model is not known"
    )
    steady = foot.found.steady
    bound = {} if foot.found.uncertainty_s is None else clock_bound(foot.found.uncertainty_s)
    return {
        **described(foot.export, steady.begin_ns),
        "AXES": ascii_of(axes),
        "RESAMPLED": steady.says(),
        "FILLED": "unknown numbers, as the format has no number for them: every stretch is in the "
        "table of filled stretches",
        "BODY": foot.body,
        "COLUMNS": f"{foot.prefix}ground_force_vx and the eight behind it",
        "NOT_MEASURED": "shear and free moment: 0",
        "ROWS": len(foot.loads.table),
        "FILLED_ROWS": dict(by_reason),
        "MARKS": foot.found.marks,
        **bound,
    }


def _head(name: str, rows: int, columns: Sequence[str]) -> bytes:
    head = f"{name}\nversion=1\nnRows={rows}\nnColumns={len(columns)}\ninDegrees=no\nendheader\n"
    return (head + "\t".join(columns) + "\n").encode()


def _text(rows: Floats, columns: Sequence[str]) -> bytes:
    digits = [9, *([6] * (len(columns) - 1))]
    arrays = [np.round(rows[:, i], digits[i]) + 0.0 for i in range(len(columns))]
    table = pa.table(arrays, names=list(columns))
    sink = BytesIO()
    options = pacsv.WriteOptions(include_header=False, delimiter="\t", quoting_style="none")
    pacsv.write_csv(table, sink, options)
    return sink.getvalue()


def _events(found: Reaction) -> pa.Table:
    times = pa.array([at_s for at_s, _ in found.events], pa.float64())
    labels = pa.array([label for _, label in found.events], pa.string())
    kinds = ["mark"] * found.marks + ["contact"] * (len(found.events) - found.marks)
    return pa.table([times, labels, pa.array(kinds, pa.string())], names=["time", "event", "kind"])


def _of_feet(tables: Sequence[pa.Table], feet: Sequence[Foot]) -> pa.Table:
    """Return one table; for several feet, a column `foot` tells the foot of each row."""
    if len(feet) == 1:
        return tables[0]
    return pa.concat_tables(
        table.append_column("foot", pa.array([foot.name] * len(table), pa.string()))
        for table, foot in zip(tables, feet, strict=True)
    )


def _csv(table: pa.Table) -> bytes:
    sink = BytesIO()
    write_csv(sink, table)
    return sink.getvalue()


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, _ZIP_TIME)
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.external_attr = 0o644 << 16
    return entry


OPENSIM = Format(
    "opensim",
    "OpenSim",
    "OpenSim: .mot and ExternalLoads",
    "application/zip",
    _write,
    write_together=_write_together,
    suffix="opensim.zip",
    options=("body",),
    takes_columns=False,
    needs_forces=True,
    frames_max=FRAMES_MAX,
)
