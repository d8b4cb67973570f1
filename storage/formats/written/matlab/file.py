"""MATLAB writer: .mat of version 5, a variable for each quantity; Octave and scipy read it too.

Variables follow one another in the file: `load("session.mat", "t_ns", "grf_n")` reads only these.
A matrix is written while it is read, a chunk of a column at a time; scipy writes all else. Several
sessions are an array of structs, `sessions`, with the same names in each; one field is in memory at
a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import pyarrow as pa

from devices.errors import UsageError
from storage.formats.export import Export
from storage.formats.written.format import Format
from storage.formats.written.matlab.elements import (
    BYTES_MAX,
    HEADER_BYTES,
    Field,
    matrix,
    saved,
    struct_array,
    struct_bytes,
    variable,
)
from storage.formats.written.matlab.values import (
    class_of,
    facts_of,
    marks_of,
    names_of,
    pieces_of,
    quantities_of,
    tiles_of,
    values_of,
)
from storage.formats.written.together import instants_of
from storage.schema import SERVER_TIME, Array, Column

FRAMES_MAX = 6_000_000
"""Limit of frames: three hours at 544 Hz; with four tiles, a variable has 24 million numbers."""
_VALUES_MAX = 4 * FRAMES_MAX
_TEXT = 116
"""Length of the header's descriptive text in bytes."""


def _write(export: Export) -> Iterator[bytes]:
    quantities = quantities_of(export)
    # Refuses too many frames before the first chunk.
    frames = len(_t_ns(export)["t_ns"])
    yield _header(export) + variable("about", facts_of(export))
    yield from _meanings(quantities)
    yield variable("tiles", tiles_of(export))
    if export.marks is not None:
        yield variable("marks", marks_of(export))
    for column in quantities:
        if pa.types.is_string(column.type):
            for name, values in values_of(export, column).items():
                yield variable(name, values)
            continue
        shape = frames, len(names_of(export, column))
        yield from matrix(column.name, shape, class_of(column), pieces_of(export, column))


def _write_together(exports: Sequence[Export]) -> Iterator[bytes]:
    found = [_fields(export) for export in exports]
    if (size := struct_bytes(found)) > BYTES_MAX:
        raise UsageError(
            f"there are {size} bytes in these sessions, and {BYTES_MAX} in a variable at most",
            expected="fewer columns, or a slice",
        )
    yield _header(exports[0])
    yield from _meanings([column for export in exports for column in _on_one_axis(export)])
    yield from struct_array("sessions", found)


def _fields(export: Export) -> dict[str, Field]:
    rows = len(instants_of(export, _t_ns(export)))
    fields = {"node": Field.of(export.info.node), "about": Field.of(facts_of(export))}
    fields["tiles"] = Field.of(tiles_of(export))
    if export.marks is not None:
        fields["marks"] = Field.of(marks_of(export))
    for column in _on_one_axis(export):
        if pa.types.is_string(column.type):
            fields |= {name: Field.of(v) for name, v in values_of(export, column).items()}
            continue
        width = len(names_of(export, column))
        make = partial(_values, export, column)
        fields[column.name] = Field.matrix((rows, width), class_of(column), make)
    return fields


def _on_one_axis(export: Export) -> list[Column]:
    """Return the selected quantities, and always the server's time, the sessions' common axis."""
    return list(dict.fromkeys([*quantities_of(export), *SERVER_TIME]))


def _values(export: Export, column: Column) -> Array:
    return values_of(export, column)[column.name]


def _t_ns(export: Export) -> dict[str, Array]:
    """Return the instants of the frames by each requested clock."""
    limit = min(FRAMES_MAX, _VALUES_MAX // max(len(export.info.tiles), 1))
    asked = ["t_ns", *(["part"] if "part" in export.content.names else [])]
    asked += [] if export.clock is None else ["t_server_ns"]
    return export.whole(asked, frames_max=limit)


def _meanings(quantities: Sequence[Column]) -> Iterator[bytes]:
    yield variable("units", {column.name: column.unit for column in quantities})
    yield variable("meaning", {column.name: column.description for column in quantities})


def _header(export: Export) -> bytes:
    """Return scipy's header without the time of day in its text: equal exports are equal files."""
    text = f"MATLAB 5.0 MAT-file, written by {export.info.software}"
    shown = text.encode("ascii", "replace")[:_TEXT].ljust(_TEXT)
    return shown + saved({})[_TEXT:HEADER_BYTES]


MATLAB = Format(
    "mat",
    "MATLAB",
    "MATLAB, Octave, scipy",
    "application/x-matlab-data",
    _write,
    write_together=_write_together,
    options=("times",),
    needs_sealed=True,
    frames_max=FRAMES_MAX,
    extra="server",
    packages=("scipy",),
)
