"""Reader of recorded loads, from any table of forces; implausible loads are refused.

Columns, in any case: `time_s`, and either `fz_n, cop_x_m, cop_y_m` or one force per tile, `cell1_n,
cell2_n, ...`; optionally `angle_rad`. Others are ignored. A FootTile session, sealed or exported,
has `t_ns` instead, and is converted. Force platforms and OpenSim's ground reactions are read like
references.

True loads of an emulation (`true_*`) take precedence over estimates, and forces of tiles
(`force_n_0`, ...) over GRF with centre of pressure (`grf_n`). An unloaded reference tile has no
column. Leading and trailing rows with an unknown number are dropped, as before the tare or the
servo's first answer; the reader of the trace refuses such rows in between.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa

from devices.arrays import Floats
from devices.emulation.ground.load_trace import LoadTrace
from devices.errors import FileFormatError, LoadTraceError, UsageError
from storage.formats.readers.parquet import read_time_axis_or_node_axis
from storage.formats.readers.registry import read_table
from storage.formats.readers.table import (
    INSTANT_COLUMN,
    STANDARD_UNITS,
    Column,
    ForceTable,
    fit_constant_rate_if_times_repeat,
)
from storage.formats.reference import PLAUSIBLE_MAX, ReferenceOptions, table_to_reference
from storage.schema import read_array_info
from storage.sessions.time_axis import NODE_AXIS, TimeAxis

_SESSION_COLUMN_PATTERN = re.compile(r"t_ns|part|(true_)?(force_n_\d+|grf_n|cop_[xy]_m|angle_rad)")
"""Pattern of the needed columns."""

_TOTAL_FORCE_COLUMNS = ("grf_n", "cop_x_m", "cop_y_m")


def _extract_trimmed_load_trace(
    columns: Mapping[str, Column],
    schema: pa.Schema | None,
    *,
    where: str,
    axis: TimeAxis = NODE_AXIS,
) -> dict[str, Column]:
    """Return `time_s` and `cell1_n, ...` or `fz_n, cop_x_m, cop_y_m`, and `angle_rad` if known.

    Rows before the first load and after the last are left out.

    Args:
        columns: columns of a session that match `_SESSION_COLUMN_PATTERN`.
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


VALUES_MAX = 20_000_000
"""Limit of rows times columns: an hour of eight cells at 500 Hz, 160 MB in memory."""

_TRACE_COLUMN_PATTERN = re.compile(r"time_s|fz_n|cop_[xy]_m|angle_rad|cell\d+_n")
"""Pattern of the columns that are read."""

_MAP_REMEDY = "Or name them: --map time_s=COLUMN,grf_n=COLUMN,cop_x_m=COLUMN,cop_y_m=COLUMN"
_UNITS = {"time": "time_s", "fz": "fz_n", "cop_x": "cop_x_m", "cop_y": "cop_y_m"}


def read_load_to_emulate(path: Path, options: ReferenceOptions | None = None) -> LoadTrace:
    """Read a load trace.

    Args:
        path: path of the file.
        options: options of the user. With columns, units, sign or rate the file is read like a
            reference.

    Raises:
        LoadTraceError: unreadable, a session whose bytes differ from the sealed ones, a column
            is missing or in another unit, times do not rise, or a force is not a number.
    """
    where = str(path)
    columns, names = _read_columns(path, options or ReferenceOptions())

    def numbers(name: str, *, may_be_empty: bool = False) -> Floats:
        return _require_column(columns, names, name, where, may_be_empty=may_be_empty)

    time_s = fit_constant_rate_if_times_repeat(numbers("time_s")).time_s
    _check_rising_times(time_s, where)
    cells = _list_cell_columns(columns, where)
    has_total = "fz_n" in columns
    if not cells and not has_total:
        raise LoadTraceError(
            f"no load in its columns ({', '.join(names)})",
            where=where,
            expected=_other_unit_hint(names, "fz_n") or "fz_n, or cell1_n, cell2_n, ...",
            remedy=_MAP_REMEDY,
        )
    fz_n = numbers("fz_n") if has_total else None
    cells_n = np.stack([numbers(name) for name in cells], axis=1) if cells else None
    pressed_n = cells_n if cells_n is not None else fz_n
    if pressed_n is not None and pressed_n.sum() < 0.0:
        raise LoadTraceError(
            "the load is mostly negative",
            where=where,
            expected="the force of the ground on the foot, positive under load",
            remedy="Change its sign",
        )
    cop_m = None
    if has_total and not cells:
        cop_m = np.stack(
            [numbers("cop_x_m", may_be_empty=True), numbers("cop_y_m", may_be_empty=True)], axis=1
        )
    return LoadTrace(
        where=where,
        time_s=time_s,
        cells_n=cells_n,
        fz_n=fz_n,
        cop_m=cop_m,
        angle_rad=numbers("angle_rad") if "angle_rad" in columns else None,
    )


def _check_rising_times(time_s: Floats, where: str) -> None:
    if len(time_s) < 2:
        raise LoadTraceError(f"{len(time_s)} rows", where=where, expected="at least two")
    steps = np.flatnonzero(np.diff(time_s) <= 0.0)
    if len(steps):
        row = int(steps[0])
        raise LoadTraceError(
            f"time_s goes from {time_s[row]:g} to {time_s[row + 1]:g} at row {row + 2}",
            where=where,
            expected="times that rise from row to row",
            remedy="Sort the rows and remove repeated ones",
        )


def _list_cell_columns(names: Iterable[str], where: str) -> list[str]:
    """Return the columns of single cells in the order of their numbers."""
    cells = sorted(
        (int(match[1]), name) for name in names if (match := re.fullmatch(r"cell(\d+)_n", name))
    )
    if [number for number, _ in cells] != list(range(1, len(cells) + 1)):
        raise LoadTraceError(
            f"cell columns are numbered {', '.join(str(number) for number, _ in cells)}",
            where=where,
            expected="cell1_n, cell2_n, ... without a gap",
        )
    return [name for _, name in cells]


def _is_trace_column(name: str) -> bool:
    name = name.lower()
    return (
        bool(_TRACE_COLUMN_PATTERN.fullmatch(name) or _SESSION_COLUMN_PATTERN.fullmatch(name))
        or name in STANDARD_UNITS
    )


def _read_columns(path: Path, options: ReferenceOptions) -> tuple[dict[str, Column], list[str]]:
    """Return the columns of a trace by lower-case name, and the names of all columns."""
    named = options.source_columns
    try:
        table = read_table(
            path, lambda name: name in named or _is_trace_column(name), VALUES_MAX, options.text
        )
        names = [name.lower() for name in table.names if name]
        if options != ReferenceOptions(text=options.text):
            columns = _reference_to_columns(table, options)
            return columns, list(dict.fromkeys([*names, *columns]))
        columns = _lowercase_names(table)
        if INSTANT_COLUMN in columns:
            columns = _extract_trimmed_load_trace(
                columns, table.schema, where=table.where, axis=read_time_axis_or_node_axis(path)
            )
        elif "grf_n" in columns and "fz_n" not in columns and "cell1_n" not in columns:
            columns = _reference_to_columns(table, options)
    except (FileFormatError, UsageError) as error:
        raise LoadTraceError(
            error.what, where=error.where, expected=error.expected, remedy=error.remedy
        ) from error
    if not any(_TRACE_COLUMN_PATTERN.fullmatch(name) for name in columns):
        raise LoadTraceError(
            f"no load in its columns ({', '.join(names)[:200]})",
            where=table.where,
            expected=_other_unit_hint(names, "time_s")
            or "time_s, and fz_n or cell1_n, cell2_n, ...",
            remedy=_MAP_REMEDY,
        )
    return columns, list(dict.fromkeys([*names, *columns]))


def _reference_to_columns(table: ForceTable, options: ReferenceOptions) -> dict[str, Column]:
    found = table_to_reference(table, options)
    count = len(next(iter(table.columns.values())))
    if len(found.time_s) < count:
        raise LoadTraceError(
            f"{count - len(found.time_s)} samples have no force",
            where=table.where,
            expected="a force in each",
            remedy="Cut them out, or fill them from their neighbours on purpose",
        )
    columns: dict[str, Column] = {"time_s": found.time_s, "fz_n": found.grf_n}
    if found.cop_m is not None:
        columns |= {"cop_x_m": found.cop_m[:, 0], "cop_y_m": found.cop_m[:, 1]}
    return columns


def _lowercase_names(table: ForceTable) -> dict[str, Column]:
    columns: dict[str, Column] = {}
    for name, column in table.columns.items():
        if name.lower() in columns and columns[name.lower()] is not column:
            raise FileFormatError(
                f"column {name.lower()} is there twice, whatever its case", where=table.where
            )
        columns[name.lower()] = column
    return columns


def _require_column(
    columns: dict[str, Column], names: list[str], name: str, where: str, *, may_be_empty: bool
) -> Floats:
    if name not in columns:
        raise LoadTraceError(
            f"column {name} is missing (it has {', '.join(names)})",
            where=where,
            expected=_other_unit_hint(names, name) or name,
        )
    values = columns[name].astype(np.float64)
    bad = ~(np.abs(values) < PLAUSIBLE_MAX)  # NaN too
    if may_be_empty:
        bad &= ~np.isnan(values)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise LoadTraceError(
            f"column {name} is {values[row]:g} at row {row + 1}",
            where=where,
            expected=f"a number below {PLAUSIBLE_MAX:g} in every row",
            remedy="Cut the row out, or fill it from its neighbours on purpose",
        )
    return values


def _other_unit_hint(columns: Iterable[str], name: str) -> str:
    """Return the expected text of an error if the quantity exists in another unit; else empty."""
    stem = next((stem for stem, full in _UNITS.items() if full == name), None)
    for other in columns:
        if stem is not None and re.fullmatch(rf"{stem}(_[a-z]+)?", other):
            return f"{name}, converted from {other!r}: units are SI and part of the name"
    return ""
