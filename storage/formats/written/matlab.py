"""MATLAB's .mat of version 5, which Octave and scipy read too: a variable for each quantity.

scipy writes each variable, and they stand one after the other in the file, so that one is in memory
at a time and `load("session.mat", "t_ns", "grf_n")` reads no more than that. A quantity of all
tiles is a matrix of frames by tiles. Numbers that may be unknown are NaN, in a class that has room
for all of their values; `t_server_ns`, which no float holds, is intmin("int64") then.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from storage.formats.export import Export
from storage.formats.written.format import Format
from storage.schema import KNOWN, Array, Column

FRAMES_MAX = 6_000_000
"""Three hours at 544 Hz; four tiles of them are the 24 million numbers of a variable at most."""
_VALUES_MAX = 4 * FRAMES_MAX
_HEADER = 128
_TEXT = 116
"""Of the header's bytes so many are for people."""


def _write(export: Export) -> Iterator[bytes]:
    tiles = len(export.info.tiles)
    chosen = export.chosen()
    quantities = [of for of in dict.fromkeys(chosen.values()) if of != "time_utc"]
    limit = min(FRAMES_MAX, _VALUES_MAX // max(tiles, 1))
    export.whole(["t_ns"], frames_max=limit)  # refuses more, before anything is given away
    yield _header(export) + _variable("about", _texts(export))
    yield _variable("units", {of: KNOWN[of].unit for of in quantities})
    yield _variable("meaning", {of: KNOWN[of].description for of in quantities})
    yield _variable("tiles", _tiles(export))
    if export.marks is not None:
        yield _variable("marks", _marks(export))
    for quantity in quantities:
        if quantity != "event":  # it is in the marks
            names = [name for name, of in chosen.items() if of == quantity]
            yield from _quantity(export, KNOWN[quantity], names)


def _quantity(export: Export, column: Column, names: Sequence[str]) -> Iterator[bytes]:
    is_server = column.name.startswith("t_server")
    plain = replace(export, marks=None, clock=export.clock if is_server else None)
    pieces = list(plain.pieces(names))
    flat = [np.concatenate([piece[name] for piece in pieces]) for name in names]
    if pa.types.is_string(column.type):
        kinds, codes = np.unique(flat[0].astype(str), return_inverse=True)
        yield _variable(column.name, codes.astype(np.uint16) + 1)
        yield _variable(f"{column.name}_kinds", np.array(kinds, dtype=object))
        return
    yield _variable(column.name, np.stack([_known(column, v) for v in flat], axis=1))


def _known(column: Column, values: Array) -> Array:
    """Numbers with NaN for what is not known, in the least class that holds them all."""
    kind = column.type
    if pa.types.is_floating(kind):
        return values.astype(kind.to_pandas_dtype())
    if column.missing is None or kind.bit_width == 64:
        return values
    found = values.astype(np.float32 if kind.bit_width <= 16 else np.float64)
    found[values == column.missing] = np.nan
    return found


def _variable(name: str, value: object) -> bytes:
    """A variable as it stands in a file, behind the header."""
    from scipy.io import savemat

    file: Any = io.BytesIO()  # its stubs know names of files only
    savemat(file, {name: value}, long_field_names=True, oned_as="column")
    content: bytes = file.getvalue()
    return content[_HEADER:]


def _header(export: Export) -> bytes:
    """scipy's, but for the text, in which the time of day would make each file another one."""
    from scipy.io import savemat

    file: Any = io.BytesIO()  # its stubs know names of files only
    savemat(file, {})
    text = f"MATLAB 5.0 MAT-file, written by {export.info.software}"
    shown = text.encode("ascii", "replace")[:_TEXT].ljust(_TEXT)
    rest: bytes = file.getvalue()[_TEXT:_HEADER]
    return shown + rest


def _texts(export: Export) -> dict[str, Any]:
    facts = {
        **export.about,
        "node": export.info.node,
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


def _tiles(export: Export) -> dict[str, Any]:
    tiles = export.info.tiles
    places = np.array([(t.x_m, t.y_m, t.z_m) for t in tiles], dtype=np.float64)
    return {
        "serial": np.array([tile.serial for tile in tiles], dtype=object),
        "position_m": places.reshape(len(tiles), 3),
    }


def _marks(export: Export) -> dict[str, Any]:
    """Labels, instants in the server's UTC, and rows, from 1; NaN: at no frame of this file."""
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


MATLAB = Format(
    "mat",
    "MATLAB",
    "MATLAB, Octave, scipy",
    "application/x-matlab-data",
    _write,
    options=("times",),
    needs_sealed=True,
    frames_max=FRAMES_MAX,
    extra="server",
    packages=("scipy",),
)
