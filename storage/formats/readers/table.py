"""Table of a file's columns of numbers, with the units that the file states, and of its plates."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from devices.arrays import Floats, Ints
from devices.errors import FileFormatError

Column = Floats | Ints
"""(n,), float64 with NaN in empty cells; int64 for instants in nanoseconds."""
ColumnFilter = Callable[[str], bool]
"""Predicate of column names; only columns for which it is true are read."""

TEXT_BYTES_MAX = 256 << 20
VALUES_MAX = 50_000_000
"""Limit of rows times columns: 400 MB in memory."""
STANDARD_UNITS: Mapping[str, str] = {
    "time_s": "s",
    "grf_n": "N",
    "fz_n": "N",
    "cop_x_m": "m",
    "cop_y_m": "m",
}
"""Units of the standard column names, which state unit and sign, in upper or lower case."""
SOLE_FRACTION = "sole"
"""Unit of a centre of pressure given as fractions of the sole's length and width."""
SOLE_UNITS = ("sole lengths", "sole widths")
"""Units of the coordinates x and y of such a centre of pressure."""
INSTANT_COLUMN = "t_ns"
"""Name of a session's column of instants, which need all 64 bits."""


@dataclass(frozen=True)
class ForceTable:
    """Table of a file's columns, in the units of the file.

    Attributes:
        names: names of all columns of the file.
        columns: the needed columns by name.
        units: unit of each column whose unit the file states.
        positive_forces: names of forces that the file states to be positive under load.
        plate_forces: names of plates' forces, whose sign is inferred from the load.
        epoch_ns: UTC of time zero; None if the file does not state it.
        notes: remarks for the user.
        expected_form: expected form of the file, for errors; empty for binary formats.
        schema: Arrow schema of a Parquet file.
        where: path of the file; `read_table` states it.
    """

    names: tuple[str, ...]
    columns: Mapping[str, Column]
    units: Mapping[str, str] = field(default_factory=dict)
    positive_forces: frozenset[str] = frozenset()
    plate_forces: frozenset[str] = frozenset()
    epoch_ns: int | None = None
    notes: tuple[str, ...] = ()
    expected_form: str = ""
    schema: pa.Schema | None = None
    where: str = ""


def make_table_with_lowercase_standard_names(
    names: Iterable[str],
    columns: Mapping[str, Column],
    *,
    units: Mapping[str, str] | None = None,
    notes: tuple[str, ...] = (),
    expected_form: str = "",
    schema: pa.Schema | None = None,
) -> ForceTable:
    """Return a table; columns with a standard name in any case get that name and its unit.

    `fz_n` is `grf_n` as well, if the file has no `grf_n`.

    Raises:
        FileFormatError: two names differ only in case.
    """
    found = dict(columns)
    for name in columns:
        if name.lower() in STANDARD_UNITS and name.lower() != name:
            if name.lower() in found:
                raise make_repeated_name_error([name.lower()])
            found[name.lower()] = columns[name]
    if "fz_n" in found and "grf_n" not in found:
        found["grf_n"] = found["fz_n"]
    ours = {name: unit for name, unit in STANDARD_UNITS.items() if name in found}
    cased = {
        name: STANDARD_UNITS[name.lower()] for name in columns if name.lower() in STANDARD_UNITS
    }
    forces = {name for name, unit in (cased | ours).items() if unit == "N"}
    return ForceTable(
        tuple(names),
        found,
        {**(units or {}), **cased, **ours},
        frozenset(forces),
        notes=notes,
        expected_form=expected_form,
        schema=schema,
    )


def select_needed_names_or_empty(
    column_names: Collection[str], is_needed: ColumnFilter
) -> list[str]:
    """Return the names of the columns to read.

    Raises:
        FileFormatError: two columns have one of these names.
    """
    needed = [name for name in column_names if name and is_needed(name)]
    if twice := sorted({name for name in needed if needed.count(name) > 1}):
        raise make_repeated_name_error(twice)
    return needed


def make_repeated_name_error(repeated_names: Collection[str]) -> FileFormatError:
    """Return the error for names that two columns have."""
    return FileFormatError(
        f"column {', '.join(repeated_names)} is there twice",
        expected="a name of its own for each column, whatever its case",
    )


def check_table_size(row_count: int, column_count: int, values_max: int) -> None:
    """Refuse a table that is too large for memory.

    Raises:
        FileFormatError: rows times columns exceed `values_max`.
    """
    if row_count * column_count > values_max:
        raise FileFormatError(
            f"{row_count} rows of {column_count} columns are too many for memory",
            expected=f"up to {values_max} numbers",
            remedy="Cut out the part that is needed",
        )


@dataclass(frozen=True)
class PlateSignals:
    """Signals of one plate or sole in the units of the file; n samples.

    Attributes:
        name: prefix of its columns, such as `plate1` or `left`: `plate1_fz`, `plate1_cop_x`.
        fz: (n,), force along the plate's normal.
        cop: (2, n), centre of pressure, NaN where unknown; None if the file has none. Its values
            without load are ignored.
        force_unit: unit of the force; None if the file does not state it.
        length_unit: unit of the centre of pressure, or `SOLE_FRACTION`; None if the file does not
            state it.
        is_positive_under_load: True if the force is positive under load; else the load tells its
            sign.
        notes: remarks for the user.
    """

    name: str
    fz: Floats
    cop: Floats | None
    force_unit: str | None
    length_unit: str | None
    is_positive_under_load: bool = False
    notes: tuple[str, ...] = ()


def make_table_of_separate_plates(
    time_s: Floats, plates: Sequence[PlateSignals], notes: Sequence[str] = ()
) -> ForceTable:
    """Return a table of plates; a single plate with units gets the standard names as well."""
    columns: dict[str, Floats] = {}
    units = {"time_s": "s"}
    all_notes = [*notes]
    for plate in plates:
        all_notes += [f"{plate.name}: {note}" for note in plate.notes]
        columns[f"{plate.name}_fz"] = plate.fz
        if plate.force_unit is not None:
            units[f"{plate.name}_fz"] = plate.force_unit
        for axis, cop, part in zip(
            "xy", () if plate.cop is None else plate.cop, SOLE_UNITS, strict=False
        ):
            columns[f"{plate.name}_cop_{axis}"] = np.where(plate.fz == 0.0, np.nan, cop)
            if plate.length_unit is not None:
                units[f"{plate.name}_cop_{axis}"] = (
                    part if plate.length_unit == SOLE_FRACTION else plate.length_unit
                )
    positive = {f"{plate.name}_fz" for plate in plates if plate.is_positive_under_load}
    signed_by_load = {f"{plate.name}_fz" for plate in plates if not plate.is_positive_under_load}
    if len(plates) == 1:
        (plate,) = plates
        for ours, theirs in (("grf_n", "fz"), ("cop_x_m", "cop_x"), ("cop_y_m", "cop_y")):
            found = f"{plate.name}_{theirs}"
            if found in units and units[found] not in SOLE_UNITS:
                columns[ours], units[ours] = columns[found], units[found]
        (positive if plate.is_positive_under_load else signed_by_load).add("grf_n")
    elif len(plates) > 1:
        names = ", ".join(plate.name for plate in plates)
        all_notes.append(f"there are {len(plates)} plates or soles ({names}): --map says which one")
    columns["time_s"] = time_s
    return ForceTable(
        tuple(columns),
        columns,
        units,
        positive_forces=frozenset(positive),
        plate_forces=frozenset(signed_by_load),
        notes=tuple(all_notes),
    )


SAMPLES_MIN = 10
DEVIATION_MAX_STEPS = 1.5
"""Largest deviation from a constant rate, in smallest steps of the times."""


class SpacedTimes(NamedTuple):
    """Times (n,), and a note about a change; empty: unchanged."""

    time_s: Floats
    note: str


def fit_constant_rate_if_times_repeat(time_s: Floats) -> SpacedTimes:
    """Replace all times by times at a constant rate if rounding made some equal.

    Times are returned unchanged unless the rate is clear: no time falls, and all deviate from a
    constant rate by rounding only.
    """
    steps_s = np.diff(time_s)
    repeated = int((steps_s == 0.0).sum())
    if not repeated or len(time_s) < SAMPLES_MIN or not (steps_s >= 0.0).all():
        return SpacedTimes(time_s, "")
    since_s = time_s - time_s[0]
    number = np.arange(len(time_s))
    step_s, begin_s = np.polyfit(number, since_s, 1)
    even_s = begin_s + step_s * number
    if np.ptp(since_s - even_s) > DEVIATION_MAX_STEPS * float(
        steps_s[steps_s > 0.0].min(initial=np.inf)
    ):
        return SpacedTimes(time_s, "")
    note = f"{repeated} of {len(time_s)} times are repeated, as rounding makes them: all are spread"
    return SpacedTimes(time_s[0] + even_s, f"{note} evenly, at {1.0 / step_s:.6g} Hz")
