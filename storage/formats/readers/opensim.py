"""Reader of OpenSim's `.mot` and `.sto` files.

A header ends with the line `endheader`; a line of names and lines of numbers follow. Times are in
s, forces in N, positions in m, and y points up. Cells of three numbers (`DataType=Vec3`) become
three columns: `ground_force_v` becomes `ground_force_vx` and so on.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from devices.errors import FileFormatError
from storage.formats.readers.table import (
    ColumnFilter,
    ForceTable,
    make_table_with_lowercase_standard_names,
    select_needed_names_or_empty,
)
from storage.formats.readers.text import (
    BLANKS,
    TextLayout,
    parse_columns,
    read_decoded_text,
    split_trimmed_cells_without_empty_end,
)

FORM = "a header to the line endheader, a line of names, lines of numbers"
_END = re.compile(r"^[ \t]*endheader[ \t]*$", re.IGNORECASE | re.MULTILINE)
_VECTOR = re.compile(r"[^,]*,[^,]*,[^,]*")
_UNITS = ((re.compile(r"_v[xyz]?(_\d+)?$"), "N"), (re.compile(r"_p[xyz]?(_\d+)?$"), "m"))


def read_opensim_table(path: Path, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Read time and the needed columns of a `.mot` or `.sto` file.

    Raises:
        FileFormatError: unreadable, header or names are missing, or numbers do not fit the names.
    """
    text = read_decoded_text(path)
    end = _END.search(text)
    if end is None:
        raise FileFormatError("there is no line endheader")
    head, _, rows = text[end.end() :].lstrip().partition("\n")
    rows = rows.strip("\n")
    line = rows.partition("\n")[0]
    delimiter = "\t" if "\t" in head and "\t" in line else BLANKS
    names, first = (
        split_trimmed_cells_without_empty_end(head, delimiter),
        split_trimmed_cells_without_empty_end(line, delimiter),
    )
    if len(first) > 1 and all(map(_VECTOR.fullmatch, first[1:])):
        rows = rows.replace(",", delimiter)
        first = split_trimmed_cells_without_empty_end(rows.partition("\n")[0], delimiter)
        vectors = (name if name.endswith(("_v", "_p", "_m")) else f"{name}_" for name in names[1:])
        names = [*names[:1], *(f"{name}{axis}" for name in vectors for axis in "xyz")]
    if len(names) < 2 or (first and len(first) != len(names)):
        raise FileFormatError(f"there are {len(names)} names for {len(first)} columns of numbers")
    times = {name for name in names if name.lower() == "time"}
    alone = _single_force_columns(names)
    wanted = set(alone.values()) if is_needed("grf_n") and "grf_n" not in names else set()
    needed = select_needed_names_or_empty(
        names, lambda name: name in wanted | times or is_needed(name)
    )
    width = line.count("\t") + 1 if delimiter == "\t" else 0
    padded = (*names, *[""] * (width - len(names)))
    columns = parse_columns(rows, TextLayout(padded, delimiter, 0, {}), needed, values_max)
    for ours, name in alone.items():
        if name in wanted:  # OpenSim's z points right, the foot's y points left
            columns[ours] = -columns[name] if ours == "cop_y_m" else columns[name]
    for name in times:
        columns["time_s"] = columns[name]
    units = {name: unit for name in names for ending, unit in _UNITS if ending.search(name)}
    table = make_table_with_lowercase_standard_names(
        names, columns, units=units | dict.fromkeys(times, "s"), expected_form=FORM
    )
    forces = {name for name, unit in units.items() if unit == "N"}
    return replace(table, positive_forces=table.positive_forces | forces)


def _single_force_columns(names: Sequence[str]) -> dict[str, str]:
    """Return the columns of a file's only force by standard name; empty for several forces."""
    forces = [name for name in names if name.endswith("_vy")]
    if len(forces) != 1:
        return {}
    stem = forces[0].removesuffix("_vy")
    found = {"grf_n": forces[0]}
    if {f"{stem}_px", f"{stem}_pz"} <= set(names):
        found |= {"cop_x_m": f"{stem}_px", "cop_y_m": f"{stem}_pz"}
    return found
