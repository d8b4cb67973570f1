"""Load of a FootTile session, sealed or exported, as columns of a load trace.

True loads of an emulation (`true_*`) take precedence over estimates, and forces of tiles
(`force_n_0`, ...) over GRF with centre of pressure (`grf_n`). An unloaded reference tile has no
column. Leading and trailing rows with an unknown number are dropped, as before the tare or the
servo's first answer; the reader of the trace refuses such rows in between.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import pyarrow as pa

from devices.errors import FileFormatError, LoadTraceError
from storage.formats.readers.table import INSTANT_COLUMN, Column
from storage.schema import read_array_info
from storage.sessions.time_axis import NODE_AXIS, TimeAxis

SESSION_COLUMN_PATTERN = re.compile(
    r"t_ns|part|(true_)?(force_n_\d+|grf_n|cop_[xy]_m|angle_rad)",
)
"""Pattern of the needed columns."""

_TOTAL_FORCE_COLUMNS = ("grf_n", "cop_x_m", "cop_y_m")


def extract_trimmed_load_trace(
    columns: Mapping[str, Column],
    schema: pa.Schema | None,
    *,
    where: str,
    axis: TimeAxis = NODE_AXIS,
) -> dict[str, Column]:
    """Return `time_s` and `cell1_n, ...` or `fz_n, cop_x_m, cop_y_m`, and `angle_rad` if known.

    Rows before the first load and after the last are left out.

    Args:
        columns: columns of a session that match `SESSION_COLUMN_PATTERN`.
        schema: schema of its Parquet file, which may describe the array; None for text.
        where: path of the file, for errors.
        axis: time axis of the session.

    Raises:
        LoadTraceError: no column has a load, no row has all numbers, or `t_ns` is not int64.
    """
    found: dict[str, Column] = {}
    for stem in ("true_", ""):
        if cells := _load_bearing_forces(columns, schema, stem, where=where):
            found = {f"cell{i + 1}_n": column for i, column in enumerate(cells)}
        elif all(stem + name in columns for name in _TOTAL_FORCE_COLUMNS):
            names = ("fz_n", *_TOTAL_FORCE_COLUMNS[1:])
            found = {
                name: columns[stem + old]
                for name, old in zip(names, _TOTAL_FORCE_COLUMNS, strict=True)
            }
            found |= _across_row(found)
        if found:
            break
    if not found:
        raise LoadTraceError(
            f"it is a session without any load in its columns ({', '.join(columns)})",
            where=where,
            expected="force_n_0, force_n_1, ..., or grf_n with cop_x_m and cop_y_m",
            remedy="Estimate it first, with `foottile estimate`",
        )
    for name in ("true_angle_rad", "angle_rad"):
        if name in columns and not np.isnan(columns[name]).all():
            found["angle_rad"] = columns[name]
            break
    t_ns = columns[INSTANT_COLUMN]
    if t_ns.dtype.kind != "i":
        raise LoadTraceError("t_ns are no instants", where=where, expected="nanoseconds")
    if axis.is_shifted:  # only in sealed files, where each row has a part
        t_ns = axis.shift_to_axis(np.asarray(t_ns, np.int64), columns["part"].astype(np.int64))
    found["time_s"] = np.asarray((t_ns - t_ns[:1]) * 1e-9, dtype=np.float64)
    # Rows without load need no centre of pressure.
    needed = [column for name, column in found.items() if not name.startswith("cop_")]
    rows = np.flatnonzero(~np.any([np.isnan(column) for column in needed], axis=0))
    if not len(rows):
        raise LoadTraceError("no row of it has a load", where=where)
    begin, end = int(rows[0]), int(rows[-1]) + 1
    return {name: column[begin:end] for name, column in found.items()}


def _across_row(found: Mapping[str, Column]) -> dict[str, Column]:
    """Return 0 for the coordinate of the COP that one row of tiles does not measure.

    Any constant gives the same load: a trace's COP counts from its mean.
    """
    stated = {name: ~np.isnan(found[name]) for name in _TOTAL_FORCE_COLUMNS[1:]}
    if not any(rows.any() for rows in stated.values()):
        return {}
    return {name: np.zeros(len(rows)) for name, rows in stated.items() if not rows.any()}


def _load_bearing_forces(
    columns: Mapping[str, Column], schema: pa.Schema | None, stem: str, *, where: str
) -> list[Column]:
    """Return the forces of the load-bearing tiles, in order of their numbers."""
    numbers = sorted(
        int(match[1]) for name in columns if (match := re.fullmatch(rf"{stem}force_n_(\d+)", name))
    )
    if numbers != list(range(len(numbers))):
        raise LoadTraceError(
            f"forces of tiles {', '.join(map(str, numbers))} only",
            where=where,
            expected=f"{stem}force_n of all tiles",
        )
    bare = _reference_tile_numbers(schema)
    cells = []
    for i in numbers:
        estimated = columns.get(f"force_n_{i}")
        is_empty = estimated is not None and bool(np.isnan(estimated).all())
        if not (is_empty if bare is None else i in bare):
            cells.append(columns[f"{stem}force_n_{i}"])
    return cells


def _reference_tile_numbers(schema: pa.Schema | None) -> set[int] | None:
    """Return the numbers of reference tiles; None if the file has no array info, as CSV."""
    if schema is None:
        return None
    try:
        tiles = read_array_info(schema, where="").tiles
    except FileFormatError:
        return None
    return {i for i, tile in enumerate(tiles) if tile.reference}
