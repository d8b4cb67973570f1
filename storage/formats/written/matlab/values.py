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
from storage.schema import KNOWN, Array, Column, numpy_dtype


def quantities_of(export: Export) -> list[Column]:
    """Return the selected quantities in the order of their columns, without markers."""
    chosen = dict.fromkeys(export.chosen().values())
    return [KNOWN[of] for of in chosen if of not in ("time_utc", "event")]


def names_of(export: Export, column: Column) -> list[str]:
    """Return the selected columns of a quantity; its own name if no column is selected."""
    return [name for name, of in export.chosen().items() if of == column.name] or [column.name]


def class_of(column: Column) -> npt.DTypeLike:
    """Return the class of a quantity's numbers; for a text, of the codes of its kinds."""
    kind = column.type
    if pa.types.is_string(kind):
        return np.uint16
    plain = numpy_dtype(kind)
    if pa.types.is_floating(kind) or column.missing is None or kind.bit_width == 64:
        return plain
    return np.float32 if kind.bit_width <= 16 else np.float64


def values_of(export: Export, column: Column) -> Mapping[str, Array]:
    """Read a quantity as a variable by name, (frames, columns); for a text with its kinds."""
    names = names_of(export, column)
    pieces = list(_plain(export, column).pieces(names))
    flat = [np.concatenate([piece[name] for piece in pieces]) for name in names]
    if pa.types.is_string(column.type):
        kinds, codes = np.unique(flat[0].astype(str), return_inverse=True)
        numbers = (codes + 1).astype(class_of(column))[:, None]
        return {column.name: numbers, f"{column.name}_kinds": np.array(kinds, dtype=object)}
    return {column.name: np.stack([_known(column, values) for values in flat], axis=1)}


def pieces_of(export: Export, column: Column) -> Iterator[Array]:
    """Read the numbers of a quantity in chunks, column after column."""
    for name in names_of(export, column):
        for piece in _plain(export, column).pieces([name]):
            yield _known(column, piece[name])


def _plain(export: Export, column: Column) -> Export:
    """Return the export without markers, and without a clock unless the quantity needs it."""
    is_server = column.name.startswith("t_server")
    return replace(export, marks=None, clock=export.clock if is_server else None)


def _known(column: Column, values: Array) -> Array:
    """Return the numbers in the quantity's class, NaN where unknown."""
    found = values.astype(class_of(column))
    if column.missing is not None and found.dtype.kind == "f":
        found[values == column.missing] = np.nan
    return found


def facts_of(export: Export) -> dict[str, Any]:
    """Return the file's metadata; values that are no text are JSON."""
    facts = {
        **export.about,
        "array_info": export.info.model_dump(mode="json"),
        "notes": export.all_notes,
        "begin_t_ns": np.int64(export.content.begin_t_ns),
        "software": export.info.software,
    }
    return {name: _text(value) for name, value in facts.items()}


def _text(value: object) -> object:
    if value is None or isinstance(value, bool | dict | list):
        return json.dumps(value)
    return value


def tiles_of(export: Export) -> dict[str, Any]:
    """Return serials and positions of the tiles."""
    tiles = export.info.tiles
    places = np.array([(t.x_m, t.y_m, t.z_m) for t in tiles], dtype=np.float64)
    return {
        "serial": np.array([tile.serial for tile in tiles], dtype=object),
        "position_m": places.reshape(len(tiles), 3),
    }


def marks_of(export: Export) -> dict[str, Any]:
    """Return labels, instants in the server's UTC, and rows of the markers.

    Rows count from 1; NaN: no frame of this file.
    """
    marks = export.marks.all if export.marks is not None else ()
    keys = ["seq", "part"] if "part" in export.content.names else ["seq"]
    pieces = list(replace(export, marks=None, clock=None).pieces(keys))
    seq = np.concatenate([piece["seq"] for piece in pieces])
    part = np.concatenate([piece.get("part", np.zeros(len(piece["seq"]))) for piece in pieces])
    rows = []
    for mark in marks:
        of_part, number = mark.frame or (-1, 0)
        at = np.flatnonzero((part == of_part) & (seq == number))
        rows.append(float(at[0] + 1) if len(at) else np.nan)
    return {
        "label": np.array([mark.event.label for mark in marks], dtype=object),
        "t_ns": np.array([mark.event.t_ns for mark in marks], dtype=np.int64),
        "row": np.array(rows, dtype=np.float64),
    }
