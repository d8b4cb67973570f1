"""MATLAB writer: .mat of version 5, a variable for each quantity; Octave and scipy read it too.

Variables follow one another in the file: `load("session.mat", "t_ns", "grf_n")` reads only these.
A matrix is written while it is read, a chunk of a column at a time; scipy writes all else. Several
sessions are an array of structs, `sessions`, with the same names in each. scipy writes a struct at
once. Here its fields are encoded one after the other, in chunks. The head of the struct is scipy's
head of a struct with empty fields, with the length replaced (MAT-File Format, "Level 5 MAT-File
Format", mxSTRUCT_CLASS).

A quantity of all tiles is a matrix of frames by tiles. Numbers that may be unknown are NaN, in a
float class that holds all of their values. An unknown `t_server_ns`, which no float holds, is
intmin("int64").
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.errors import UsageError
from storage.formats.export import Export
from storage.formats.writers.format import ExportFormat, get_instants_on_export_clock_ns
from storage.schema import COLUMNS_BY_NAME, SERVER_TIME_COLUMNS, Array, Column, numpy_dtype_of

_NUMBER_TYPES: Mapping[str, tuple[int, int]] = {
    "f8": (6, 9),
    "f4": (7, 7),
    "i1": (8, 1),
    "u1": (9, 2),
    "i2": (10, 3),
    "u2": (11, 4),
    "i4": (12, 5),
    "u4": (13, 6),
    "i8": (14, 12),
    "u8": (15, 13),
}
"""Class of array and type of data by numpy type, from MathWorks' "MAT-File Format"."""
_MATRIX, _FLAGS, _SIZE, _NAME = 14, 6, 5, 1
"""Types of elements, from the same tables."""
_HEADER_BYTES = 128
"""Length of a file's header; variables follow."""
BYTES_MAX = 2**31 - 1
"""Limit of a variable's length in MATLAB."""
_MATRIX_HEAD_BYTES = 56
"""Length of the head of a matrix without a name: tag, flags, size, name, tag of the numbers."""
_EMPTY = np.empty((0, 0))


def _encode_mat_file(variables: Mapping[str, object]) -> bytes:
    """Return a file of these variables, encoded by scipy."""
    from scipy.io import savemat

    file: Any = io.BytesIO()  # its stubs know names of files only
    savemat(file, dict(variables), long_field_names=True, oned_as="column")
    content: bytes = file.getvalue()
    return content


def _encode_mat_variable(name: str, value: object) -> bytes:
    """Return an encoded variable, without the file's header."""
    return _encode_mat_file({name: value})[_HEADER_BYTES:]


def _encode_mat_matrix(
    name: str, shape: tuple[int, int], number_type: npt.DTypeLike, chunks: Iterable[Array]
) -> Iterator[bytes]:
    """Yield an encoded variable of numbers while `chunks` is read.

    Args:
        name: name of the variable.
        shape: numbers of rows and columns.
        number_type: numpy type of the numbers.
        chunks: arrays of this type, column after column.

    Raises:
        RuntimeError: the chunks have another length than the shape; all that follows would be lost.
    """
    kind = np.dtype(number_type)
    of_class, of_data = _NUMBER_TYPES[kind.str[1:]]
    size = shape[0] * shape[1] * kind.itemsize
    text = name.encode("ascii")
    head = b"".join(
        (
            struct.pack("<IIII", _FLAGS, 8, of_class, 0),
            struct.pack("<IIii", _SIZE, 8, *shape),
            struct.pack("<II", _NAME, len(text)) + text + bytes(-len(text) % 8),
            struct.pack("<II", of_data, size),
        )
    )
    yield struct.pack("<II", _MATRIX, len(head) + size + -size % 8) + head
    written = 0
    for piece in chunks:
        data = piece.tobytes()
        written += len(data)
        yield data
    if written != size:
        raise RuntimeError(f"a variable has {written} bytes of numbers; its head states {size}")
    yield bytes(-size % 8)


@dataclass(frozen=True)
class _Variable:
    """Variable of the file, or field of a struct.

    Attributes:
        size_bytes: length of its element in a struct.
        encode: function of its name, empty in a struct, that yields the encoded variable.
    """

    size_bytes: int
    encode: Callable[[str], Iterable[bytes]]

    @classmethod
    def from_value(cls, value: object) -> _Variable:
        """Return a variable with a small value, encoded now."""
        element = _encode_element(value)
        return cls(
            len(element), lambda name: (_encode_mat_variable(name, value) if name else element,)
        )

    @classmethod
    def from_chunks(
        cls,
        shape: tuple[int, int],
        number_type: npt.DTypeLike,
        read_chunks: Callable[[], Iterable[Array]],
    ) -> _Variable:
        """Return a variable of numbers, read in chunks when it is written."""
        size = shape[0] * shape[1] * np.dtype(number_type).itemsize
        return cls(
            _MATRIX_HEAD_BYTES + size + -size % 8,
            lambda name: _encode_mat_matrix(name, shape, number_type, read_chunks()),
        )


def _encode_mat_struct_array(
    name: str, structs: Sequence[Mapping[str, _Variable]]
) -> Iterator[bytes]:
    """Yield an encoded array of structs; each has the fields of all, missing ones are empty.

    Args:
        name: name of the variable.
        structs: fields of each struct by name.
    """
    names = list(dict.fromkeys(key for element in structs for key in element))
    plain = np.empty((1, len(structs)), dtype=[(key, object) for key in names])
    for key in names:
        for i in range(len(structs)):
            plain[key][0, i] = _EMPTY
    head = bytearray(_encode_mat_variable(name, plain))
    del head[len(head) - _MATRIX_HEAD_BYTES * plain.size * len(names) :]
    nothing = _Variable.from_value(_EMPTY)
    fields = [element.get(key, nothing) for element in structs for key in names]
    struct.pack_into("<I", head, 4, len(head) - 8 + sum(field.size_bytes for field in fields))
    yield bytes(head)
    for field in fields:
        yield from field.encode("")


def _encode_element(value: object) -> bytes:
    """Return a value encoded as in a struct, without a name."""
    empty = len(_encode_mat_variable("s", {"f": _EMPTY})) - _MATRIX_HEAD_BYTES
    return _encode_mat_variable("s", {"f": value})[empty:]


def _list_mat_quantities(export: Export) -> list[Column]:
    """Return the selected quantities in column order, without `marker` and `time_utc`."""
    chosen = dict.fromkeys(export.map_columns_to_quantities().values())
    return [COLUMNS_BY_NAME[of] for of in chosen if of not in ("time_utc", "marker")]


def _list_selected_columns_or_name(export: Export, quantity: Column) -> list[str]:
    """Return the selected columns of a quantity; its own name if no column is selected."""
    return [
        name for name, of in export.map_columns_to_quantities().items() if of == quantity.name
    ] or [quantity.name]


def _choose_mat_number_type(quantity: Column) -> npt.DTypeLike:
    """Return the class of a quantity's numbers."""
    kind = quantity.type
    plain = numpy_dtype_of(kind)
    if pa.types.is_floating(kind) or quantity.missing_value is None or kind.bit_width == 64:
        return plain
    return np.float32 if kind.bit_width <= 16 else np.float64


def _make_text_variables(export: Export, quantity: Column, frames: int) -> dict[str, _Variable]:
    """Return a text as two variables: the number of its kind in each frame, and its kinds."""
    found = {kind for texts in _read_texts(export, quantity) for kind in np.unique(texts).tolist()}
    kinds = np.array(sorted(found), dtype=np.str_)

    def read_numbers() -> Iterator[Array]:
        for texts in _read_texts(export, quantity):
            yield (np.searchsorted(kinds, texts) + 1).astype(np.uint16)

    return {
        quantity.name: _Variable.from_chunks((frames, 1), np.uint16, read_numbers),
        f"{quantity.name}_kinds": _Variable.from_value(kinds.astype(object)),
    }


def _read_texts(export: Export, quantity: Column) -> Iterator[Array]:
    for piece in _minimal_export(export, quantity).read_chunks([quantity.name]):
        yield piece[quantity.name].astype(str)


def _read_chunks_column_by_column(export: Export, quantity: Column) -> Iterator[Array]:
    """Read the numbers of a quantity in chunks, column after column: one pass for each column."""
    for name in _list_selected_columns_or_name(export, quantity):
        for piece in _minimal_export(export, quantity).read_chunks([name]):
            yield _to_number_type(quantity, piece[name])


def _minimal_export(export: Export, column: Column) -> Export:
    """Return the export without markers, and without a clock unless the quantity needs it."""
    is_server = column.name.startswith("t_server")
    return replace(export, markers=None, clock=export.clock if is_server else None)


def _to_number_type(column: Column, values: Array) -> Array:
    """Return the numbers in the quantity's class, NaN where unknown."""
    found = values.astype(_choose_mat_number_type(column))
    if column.missing_value is not None and found.dtype.kind == "f":
        found[values == column.missing_value] = np.nan
    return found


def _make_about_struct(export: Export) -> dict[str, Any]:
    """Return the file's metadata; values that are no text are JSON."""
    facts = {
        **export.provenance_and_slice_metadata,
        "array_info": export.array_info.model_dump(mode="json"),
        "notes": export.notes_with_clock_and_markers,
        "begin_t_ns": np.int64(export.frame_source.begin_t_ns),
        "software": export.array_info.software,
    }
    return {name: _to_text(value) for name, value in facts.items()}


def _to_text(value: object) -> object:
    if value is None or isinstance(value, bool | dict | list):
        return json.dumps(value)
    return value


def _make_tile_struct(export: Export) -> dict[str, Any]:
    """Return serials and positions of the tiles."""
    tiles = export.array_info.tiles
    places = np.array([(t.x_m, t.y_m, t.z_m) for t in tiles], dtype=np.float64)
    return {
        "serial": np.array([tile.serial for tile in tiles], dtype=object),
        "position_m": places.reshape(len(tiles), 3),
    }


def _make_marker_struct(export: Export) -> dict[str, Any]:
    """Return labels, instants in the server's UTC, and rows of the markers.

    Rows count from 1; NaN: no frame of this file.
    """
    markers = export.markers.markers if export.markers is not None else ()
    keys = ["seq", "part"] if "part" in export.frame_source.quantity_names else ["seq"]
    pieces = list(replace(export, markers=None, clock=None).read_chunks(keys))
    seq = np.concatenate([piece["seq"] for piece in pieces])
    part = np.concatenate([piece.get("part", np.zeros(len(piece["seq"]))) for piece in pieces])
    rows = []
    for marker in markers:
        of_part, number = marker.frame or (-1, 0)
        at = np.flatnonzero((part == of_part) & (seq == number))
        rows.append(float(at[0] + 1) if len(at) else np.nan)
    return {
        "label": np.array([marker.marker.label for marker in markers], dtype=object),
        "t_ns": np.array([marker.marker.t_ns for marker in markers], dtype=np.int64),
        "row": np.array(rows, dtype=np.float64),
    }


FRAMES_MAX = 6_000_000
"""Limit of frames: three hours at 544 Hz; with four tiles, a variable has 24 million numbers."""
_VALUES_MAX = 4 * FRAMES_MAX
_HEADER_TEXT_BYTES = 116
"""Length of the header's descriptive text in bytes."""


def _encode(exports: Sequence[Export]) -> Iterator[bytes]:
    (export,) = exports
    quantities = _list_mat_quantities(export)
    # Refuses too many frames before the first chunk.
    variables = _make_variables(export, quantities, len(_read_instants(export)["t_ns"]))
    about = variables.pop("about")
    yield b"".join((_encode_header(export), *about.encode("about")))
    yield from _encode_meanings(quantities)
    for name, variable in variables.items():
        yield from variable.encode(name)


def _encode_together(exports: Sequence[Export]) -> Iterator[bytes]:
    # The server's time is always there, the sessions' common axis.
    quantities = [
        list(dict.fromkeys([*_list_mat_quantities(export), *SERVER_TIME_COLUMNS]))
        for export in exports
    ]
    structs = [
        {"node": _Variable.from_value(export.array_info.node)}
        | _make_variables(
            export, own, len(get_instants_on_export_clock_ns(export, _read_instants(export)))
        )
        for export, own in zip(exports, quantities, strict=True)
    ]
    size = sum(field.size_bytes for fields in structs for field in fields.values())
    if size > BYTES_MAX:
        raise UsageError(
            f"there are {size} bytes in these sessions, and {BYTES_MAX} in a variable at most",
            expected="fewer columns, or a slice",
        )
    yield _encode_header(exports[0])
    yield from _encode_meanings([column for own in quantities for column in own])
    yield from _encode_mat_struct_array("sessions", structs)


def _make_variables(
    export: Export, quantities: Sequence[Column], frames: int
) -> dict[str, _Variable]:
    """Return the variables of a session by name."""
    values: dict[str, object] = {
        "about": _make_about_struct(export),
        "tiles": _make_tile_struct(export),
    }
    if export.markers is not None:
        values["markers"] = _make_marker_struct(export)
    variables = {name: _Variable.from_value(value) for name, value in values.items()}
    for column in quantities:
        if pa.types.is_string(column.type):
            variables |= _make_text_variables(export, column, frames)
            continue
        variables[column.name] = _Variable.from_chunks(
            (frames, len(_list_selected_columns_or_name(export, column))),
            _choose_mat_number_type(column),
            partial(_read_chunks_column_by_column, export, column),
        )
    return variables


def _read_instants(export: Export) -> dict[str, Array]:
    """Return the instants of the frames by each requested clock, without their uncertainty."""
    limit = min(FRAMES_MAX, _VALUES_MAX // max(len(export.array_info.tiles), 1))
    names = [name for name in export.instant_columns if name != "t_server_uncertainty_ns"]
    return export.read_all(names, frames_max=limit)


def _encode_meanings(quantities: Sequence[Column]) -> Iterator[bytes]:
    yield _encode_mat_variable("units", {column.name: column.unit for column in quantities})
    yield _encode_mat_variable(
        "meaning", {column.name: column.description for column in quantities}
    )


def _encode_header(export: Export) -> bytes:
    """Return scipy's header without the time of day in its text: equal exports are equal files."""
    text = f"MATLAB 5.0 MAT-file, written by {export.array_info.software}"
    shown = text.encode("ascii", "replace")[:_HEADER_TEXT_BYTES].ljust(_HEADER_TEXT_BYTES)
    return shown + _encode_mat_file({})[_HEADER_TEXT_BYTES:_HEADER_BYTES]


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
