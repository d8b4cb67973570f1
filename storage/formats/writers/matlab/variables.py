"""Variables of a session for MATLAB, and their numeric classes.

A quantity of all tiles is a matrix of frames by tiles. Numbers that may be unknown are NaN, in a
float class that holds all of their values. An unknown `t_server_ns`, which no float holds, is
intmin("int64").
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from storage.formats.export import Export
from storage.schema import COLUMNS_BY_NAME, Array, Column, numpy_dtype_of


def list_mat_quantities(export: Export) -> list[Column]:
    """Return the selected quantities in column order, without `marker` and `time_utc`."""
    chosen = dict.fromkeys(export.map_columns_to_quantities().values())
    return [COLUMNS_BY_NAME[of] for of in chosen if of not in ("time_utc", "marker")]


def list_selected_columns_or_name(export: Export, quantity: Column) -> list[str]:
    """Return the selected columns of a quantity; its own name if no column is selected."""
    return [
        name for name, of in export.map_columns_to_quantities().items() if of == quantity.name
    ] or [quantity.name]


def choose_mat_number_type(quantity: Column) -> npt.DTypeLike:
    """Return the class of a quantity's numbers; for a text, of the codes of its kinds."""
    kind = quantity.type
    if pa.types.is_string(kind):
        return np.uint16
    plain = numpy_dtype_of(kind)
    if pa.types.is_floating(kind) or quantity.missing_value is None or kind.bit_width == 64:
        return plain
    return np.float32 if kind.bit_width <= 16 else np.float64


def read_mat_variables(export: Export, quantity: Column) -> Mapping[str, Array]:
    """Read a quantity as a variable by name, (frames, columns); for a text with its kinds."""
    names = list_selected_columns_or_name(export, quantity)
    pieces = list(_minimal_export(export, quantity).read_chunks(names))
    flat = [np.concatenate([piece[name] for piece in pieces]) for name in names]
    if pa.types.is_string(quantity.type):
        kinds, codes = np.unique(flat[0].astype(str), return_inverse=True)
        numbers = (codes + 1).astype(choose_mat_number_type(quantity))[:, None]
        return {quantity.name: numbers, f"{quantity.name}_kinds": np.array(kinds, dtype=object)}
    return {quantity.name: np.stack([_to_number_type(quantity, values) for values in flat], axis=1)}


def read_chunks_column_by_column(export: Export, quantity: Column) -> Iterator[Array]:
    """Read the numbers of a quantity in chunks, column after column."""
    for name in list_selected_columns_or_name(export, quantity):
        for piece in _minimal_export(export, quantity).read_chunks([name]):
            yield _to_number_type(quantity, piece[name])


def _minimal_export(export: Export, column: Column) -> Export:
    """Return the export without markers, and without a clock unless the quantity needs it."""
    is_server = column.name.startswith("t_server")
    return replace(export, markers=None, clock=export.clock if is_server else None)


def _to_number_type(column: Column, values: Array) -> Array:
    """Return the numbers in the quantity's class, NaN where unknown."""
    found = values.astype(choose_mat_number_type(column))
    if column.missing_value is not None and found.dtype.kind == "f":
        found[values == column.missing_value] = np.nan
    return found


def make_about_struct(export: Export) -> dict[str, Any]:
    """Return the file's metadata; values that are no text are JSON."""
    facts = {
        **export.metadata,
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


def make_tile_struct(export: Export) -> dict[str, Any]:
    """Return serials and positions of the tiles."""
    tiles = export.array_info.tiles
    places = np.array([(t.x_m, t.y_m, t.z_m) for t in tiles], dtype=np.float64)
    return {
        "serial": np.array([tile.serial for tile in tiles], dtype=object),
        "position_m": places.reshape(len(tiles), 3),
    }


def make_marker_struct(export: Export) -> dict[str, Any]:
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
