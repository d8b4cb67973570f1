"""OpenSim: ground reactions as a `.mot` file with the `ExternalLoads` that name its columns.

Both come in one zip file, for neither is of use without the other, with what was filled as a table
and what else there is to know as text. OpenSim's axes: x forward, y up, z to the right. Points are
in the ground's frame where the session knows it; else force and point are in that of the foot, as
a body of the model, which moves them.

A `.mot` file has no number for what is not known. So that nobody takes what was put there for a
measurement, every stretch of it is in the table.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections import Counter
from collections.abc import Iterator
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
from storage.formats.written.csv_text import write_csv
from storage.formats.written.described import ascii_of, described
from storage.formats.written.format import Format
from storage.formats.written.reaction import Reaction, reaction_of
from storage.formats.written.sink import Sink

FRAMES_MAX = 2_000_000
"""An hour at 544 Hz."""
LINE_S = 0.02
"""A GRF that is not known for longer is 0, and not on a line between what is known."""
BODY = "foot"
"""Of the model, if nobody says which."""

COLUMNS = (
    "time",
    *(f"ground_force_v{axis}" for axis in "xyz"),
    *(f"ground_force_p{axis}" for axis in "xyz"),
    *(f"ground_torque_{axis}" for axis in "xyz"),
)
_GROUND = ("cop_ground_x_m", "cop_ground_y_m")
_FOOT = ("cop_x_m", "cop_y_m")
_NOT_IN_NAMES = re.compile(r"[^0-9A-Za-z._-]")
_ROWS = 1 << 15
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
"""The same session has the same bytes."""

_WHY = {
    1: (
        "force and point",
        "force 0, point on a line between those before and behind",
        "no contact",
    ),
    2: ("force", "line between the forces before and behind", "GRF not known"),
    3: ("force", "0", "GRF not known"),
    4: ("force", "line between the forces before and behind", "no frame: lost or not taken"),
    5: ("force", "0", "no frame: lost or not taken"),
    6: ("point", "line between the points before and behind", "no centre of pressure stated"),
}
_NOTHING = 0
_UNLOADED, _LINE, _ZERO, _LINE_EMPTY, _ZERO_EMPTY, _POINT = _WHY


@dataclass(frozen=True)
class Loads:
    """Rows of a `.mot` file, n of them, and what of them was filled.

    Attributes:
        table: (n, 10), in the order of `COLUMNS`; no NaN.
        code: (n,), what was filled: a key of `_WHY`, or 0.
        status: (n,), `estimate_status`, NaN where there is no frame.
        frame: "ground" or "foot".
    """

    table: Floats
    code: npt.NDArray[np.uint8]
    status: Floats
    frame: str

    def filled(self) -> pa.Table:
        """A row for each stretch: from, to, what, with what, why, and the flags there."""
        edges = np.flatnonzero(np.diff(self.code)) + 1
        begins, ends = np.append(0, edges), np.append(edges, len(self.code))
        kept = self.code[begins] != _NOTHING
        begins, ends = begins[kept], ends[kept]
        said = [_WHY[int(self.code[begin])] for begin in begins]
        flags = [_all_bits(self.status[a:b]) for a, b in zip(begins, ends, strict=True)]
        time_s = self.table[:, 0]
        columns = {
            "from_s": time_s[begins],
            "to_s": time_s[ends - 1],
            "rows": ends - begins,
            "filled": [what for what, _, _ in said],
            "with": [how for _, how, _ in said],
            "because": [why for _, _, why in said],
            "estimate_status": flags,
        }
        types = [pa.float64(), pa.float64(), pa.int64(), *[pa.string()] * 3, pa.int64()]
        return pa.table(
            [
                pa.array(values, type_)
                for values, type_ in zip(columns.values(), types, strict=True)
            ],
            names=list(columns),
        )


def loads_of(found: Reaction, export: Export) -> Loads:
    """What acts on the foot, at each sample.

    Raises:
        UsageError: no centre of pressure is stated in it.
    """
    places = [tile.z_m for tile in export.info.tiles if not tile.reference]
    ground = [found.at(name) for name in _GROUND if name in found.columns]
    is_ground = len(ground) == 2 and bool(np.isfinite(ground).all(axis=0).any())
    points = ground if is_ground else [found.at(name) for name in _FOOT]
    stated = np.isfinite(points).all(axis=0)
    if not stated.any():
        raise UsageError(
            "no centre of pressure is stated in it, and a force without a point is no load",
            remedy="Ask for C3D, Parquet, Arrow or CSV",
        )
    contact = found.at("contact")
    unloaded = contact == 0.0
    known_n = found.steady.between(found.grf_n)
    known_n[unloaded] = 0.0
    known = np.isfinite(known_n)
    empty = ~found.steady.is_there
    time_s = found.steady.time_s
    force_n, bridged = _bridged(time_s, known_n, known)
    at = np.flatnonzero(stated)
    x_m, left_m = (np.interp(time_s, time_s[at], values[at]) for values in points)
    code = np.zeros(len(time_s), dtype=np.uint8)
    code[~stated] = _POINT
    code[~known] = np.where(bridged, _LINE, _ZERO)[~known]
    code[empty] = np.where(bridged, _LINE_EMPTY, _ZERO_EMPTY)[empty]
    code[unloaded] = _UNLOADED
    nothing = np.zeros(len(time_s))
    up_m = nothing if is_ground else np.full(len(time_s), float(np.mean(places)))
    columns = [time_s, nothing, force_n, nothing, x_m, up_m, -left_m, nothing, nothing, nothing]
    return Loads(
        np.stack(columns, axis=1),
        code,
        found.at("estimate_status"),
        "ground" if is_ground else "foot",
    )


def _bridged(
    time_s: Floats, force_n: Floats, known: npt.NDArray[np.bool_]
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Forces without NaN, and where they are on a line between two that are known."""
    at = np.flatnonzero(known)
    after = np.searchsorted(at, np.arange(len(time_s)))
    inside = (after > 0) & (after < len(at)) & ~known
    before_at, after_at = at[np.maximum(after - 1, 0)], at[np.minimum(after, len(at) - 1)]
    bridged = inside & (time_s[after_at] - time_s[before_at] <= LINE_S)
    line_n = np.interp(time_s, time_s[at], force_n[at])
    return np.where(known, force_n, np.where(bridged, line_n, 0.0)), bridged


def _all_bits(status: Floats) -> int | None:
    there = status[np.isfinite(status)].astype(np.int64)
    return int(np.bitwise_or.reduce(there)) if len(there) else None


def _write(export: Export) -> Iterator[bytes]:
    found = reaction_of(export, _GROUND, FRAMES_MAX)
    loads = loads_of(found, export)
    body = export.options.body or BODY
    stem = _NOT_IN_NAMES.sub("_", ascii_of(str(export.about.get("session") or "session")))
    filled = loads.filled()
    said = {
        **described(export, found.steady.begin_ns),
        **_notes(found, loads, filled, body),
    }
    sink = Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        file.writestr(_entry(f"{stem}.xml"), external_loads(f"{stem}.mot", loads.frame, body))
        file.writestr(_entry(f"{stem}_filled.csv"), _csv(filled))
        file.writestr(_entry(f"{stem}_events.csv"), _csv(_events(found)))
        file.writestr(_entry(f"{stem}_notes.json"), json.dumps(said, indent=1))
        with file.open(_entry(f"{stem}.mot"), "w", force_zip64=True) as entry:
            entry.write(_head(stem, len(loads.table)))
            for begin in range(0, len(loads.table), _ROWS):
                entry.write(_text(loads.table[begin : begin + _ROWS]))
                yield sink.taken()
    yield sink.taken()


def external_loads(mot: str, frame: str, body: str) -> str:
    """The file that says what the columns of a `.mot` file are, and on which body they act."""
    within = "ground" if frame == "ground" else body
    tags = {
        "applied_to_body": body,
        "force_expressed_in_body": within,
        "point_expressed_in_body": within,
        "force_identifier": "ground_force_v",
        "point_identifier": "ground_force_p",
        "torque_identifier": "ground_torque_",
    }
    inside = "".join(f"\t\t\t\t<{tag}>{escape(text)}</{tag}>\n" for tag, text in tags.items())
    return (
        '<?xml version="1.0" encoding="UTF-8" ?>\n'
        '<OpenSimDocument Version="40000">\n'
        '\t<ExternalLoads name="foottile">\n'
        "\t\t<objects>\n"
        '\t\t\t<ExternalForce name="foottile_grf">\n'
        f"{inside}"
        "\t\t\t</ExternalForce>\n"
        "\t\t</objects>\n"
        f"\t\t<datafile>{escape(mot)}</datafile>\n"
        "\t</ExternalLoads>\n"
        "</OpenSimDocument>\n"
    )


def _notes(found: Reaction, loads: Loads, filled: pa.Table, body: str) -> dict[str, object]:
    by_reason = Counter[str]()
    for row in filled.to_pylist():
        by_reason[row["because"]] += row["rows"]
    axes = (
        "x forward, y up, z to the right; force and point in the ground's frame, the force "
        "upright, points at y = 0"
        if loads.frame == "ground"
        else "x forward, y up the segment, z to the right, origin at the ankle: the foot's own "
        f"frame, as the body {body!r}; the session does not know the ground's"
    )
    return {
        "AXES": ascii_of(axes),
        "BODY": body,
        "TIME_BASE": found.steady.says(),
        "NOT_MEASURED": "shear and free moment: 0",
        "ROWS": len(loads.table),
        "FILLED_ROWS": dict(by_reason),
        "MARKS": found.marks,
    }


def _head(name: str, rows: int) -> bytes:
    head = f"{name}\nversion=1\nnRows={rows}\nnColumns={len(COLUMNS)}\ninDegrees=no\nendheader\n"
    return (head + "\t".join(COLUMNS) + "\n").encode()


def _text(rows: Floats) -> bytes:
    digits = [9, *([6] * (len(COLUMNS) - 1))]
    arrays = [np.round(rows[:, i], digits[i]) + 0.0 for i in range(len(COLUMNS))]
    table = pa.table(arrays, names=list(COLUMNS))
    sink = BytesIO()
    options = pacsv.WriteOptions(include_header=False, delimiter="\t", quoting_style="none")
    pacsv.write_csv(table, sink, options)
    return sink.getvalue()


def _events(found: Reaction) -> pa.Table:
    times = pa.array([at_s for at_s, _ in found.events], pa.float64())
    labels = pa.array([label for _, label in found.events], pa.string())
    kinds = ["mark"] * found.marks + ["contact"] * (len(found.events) - found.marks)
    return pa.table([times, labels, pa.array(kinds, pa.string())], names=["time", "event", "kind"])


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
    suffix="opensim.zip",
    options=("body",),
    takes_columns=False,
    needs_forces=True,
    frames_max=FRAMES_MAX,
)
