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
from storage.formats.writers.format import ExportFormat
from storage.formats.writers.matlab.elements import (
    BYTES_MAX,
    HEADER_BYTES,
    StructField,
    encode_mat_file,
    encode_mat_matrix,
    encode_mat_struct_array,
    encode_mat_variable,
    estimate_struct_array_bytes,
)
from storage.formats.writers.matlab.variables import (
    choose_mat_number_type,
    list_mat_quantities,
    list_selected_columns_or_name,
    make_about_struct,
    make_marker_struct,
    make_tile_struct,
    read_chunks_column_by_column,
    read_mat_variables,
)
from storage.formats.writers.multi_session import get_instants_on_export_clock_ns
from storage.schema import SERVER_TIME_COLUMNS, Array, Column

FRAMES_MAX = 6_000_000
"""Limit of frames: three hours at 544 Hz; with four tiles, a variable has 24 million numbers."""
_VALUES_MAX = 4 * FRAMES_MAX
_HEADER_TEXT_BYTES = 116
"""Length of the header's descriptive text in bytes."""


def _encode(export: Export) -> Iterator[bytes]:
    quantities = list_mat_quantities(export)
    # Refuses too many frames before the first chunk.
    frames = len(_read_instants(export)["t_ns"])
    yield _encode_header(export) + encode_mat_variable("about", make_about_struct(export))
    yield from _encode_meanings(quantities)
    yield encode_mat_variable("tiles", make_tile_struct(export))
    if export.markers is not None:
        yield encode_mat_variable("markers", make_marker_struct(export))
    for column in quantities:
        if pa.types.is_string(column.type):
            for name, values in read_mat_variables(export, column).items():
                yield encode_mat_variable(name, values)
            continue
        shape = frames, len(list_selected_columns_or_name(export, column))
        yield from encode_mat_matrix(
            column.name,
            shape,
            choose_mat_number_type(column),
            read_chunks_column_by_column(export, column),
        )


def _encode_together(exports: Sequence[Export]) -> Iterator[bytes]:
    found = [_make_struct_fields(export) for export in exports]
    if (size := estimate_struct_array_bytes(found)) > BYTES_MAX:
        raise UsageError(
            f"there are {size} bytes in these sessions, and {BYTES_MAX} in a variable at most",
            expected="fewer columns, or a slice",
        )
    yield _encode_header(exports[0])
    yield from _encode_meanings(
        [column for export in exports for column in _quantities_with_server_time(export)]
    )
    yield from encode_mat_struct_array("sessions", found)


def _make_struct_fields(export: Export) -> dict[str, StructField]:
    rows = len(get_instants_on_export_clock_ns(export, _read_instants(export)))
    fields = {
        "node": StructField.from_value(export.array_info.node),
        "about": StructField.from_value(make_about_struct(export)),
    }
    fields["tiles"] = StructField.from_value(make_tile_struct(export))
    if export.markers is not None:
        fields["markers"] = StructField.from_value(make_marker_struct(export))
    for column in _quantities_with_server_time(export):
        if pa.types.is_string(column.type):
            fields |= {
                name: StructField.from_value(v)
                for name, v in read_mat_variables(export, column).items()
            }
            continue
        width = len(list_selected_columns_or_name(export, column))
        make = partial(_read_values, export, column)
        fields[column.name] = StructField.from_matrix_function(
            (rows, width), choose_mat_number_type(column), make
        )
    return fields


def _quantities_with_server_time(export: Export) -> list[Column]:
    """Return the selected quantities, and always the server's time, the sessions' common axis."""
    return list(dict.fromkeys([*list_mat_quantities(export), *SERVER_TIME_COLUMNS]))


def _read_values(export: Export, column: Column) -> Array:
    return read_mat_variables(export, column)[column.name]


def _read_instants(export: Export) -> dict[str, Array]:
    """Return the instants of the frames by each requested clock."""
    limit = min(FRAMES_MAX, _VALUES_MAX // max(len(export.array_info.tiles), 1))
    requested = ["t_ns", *(["part"] if "part" in export.frame_source.quantity_names else [])]
    requested += [] if export.clock is None else ["t_server_ns"]
    return export.read_all(requested, frames_max=limit)


def _encode_meanings(quantities: Sequence[Column]) -> Iterator[bytes]:
    yield encode_mat_variable("units", {column.name: column.unit for column in quantities})
    yield encode_mat_variable("meaning", {column.name: column.description for column in quantities})


def _encode_header(export: Export) -> bytes:
    """Return scipy's header without the time of day in its text: equal exports are equal files."""
    text = f"MATLAB 5.0 MAT-file, written by {export.array_info.software}"
    shown = text.encode("ascii", "replace")[:_HEADER_TEXT_BYTES].ljust(_HEADER_TEXT_BYTES)
    return shown + encode_mat_file({})[_HEADER_TEXT_BYTES:HEADER_BYTES]


MATLAB = ExportFormat(
    "mat",
    "MATLAB",
    "MATLAB, Octave, scipy",
    "application/x-matlab-data",
    _encode,
    group_encoder=_encode_together,
    options=("times",),
    needs_sealed=True,
    frames_max=FRAMES_MAX,
    extra="server",
    packages=("scipy",),
)
