"""Readers of texts of force plates: Kistler BioWare, Vicon Nexus, AMTI NetForce, and OpenSim.

BioWare: lines of facts, a line of names that begins with a time, lines of numbers. The line
`Device:` has the device of each column. Forces act on the plate and are positive under load. `Ax`
and `Ay` are the centre of pressure on the surface, from its middle, in the plate's axes.

Nexus: sections of devices, joints and trajectories. A section has a title, a rate, a line of
devices, a line of names (`Frame`, `Sub Frame`, ...), a line of units, and lines of numbers up to an
empty line. A force plate is three devices, such as `AMTI #1 - Force`, `AMTI #1 - Moment` and
`AMTI #1 - CoP`, in the axes of the laboratory, z up. The sign of the force is inferred from the
load, as in C3D.

NetForce: six numbers a line and plate, separated by commas, no head: Fx, Fy, Fz, Mx, My and Mz. The
file states neither times nor units, nor the height of the surface above the origin of the moments.

OpenSim's `.mot` and `.sto`: a header ends with the line `endheader`; a line of names and lines of
numbers follow. Times are in s, forces in N, positions in m, and y points up. Cells of three numbers
(`DataType=Vec3`) become three columns: `ground_force_v` becomes `ground_force_vx` and so on.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from pathlib import Path

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.formats.readers.force_plate import compute_cop_from_moments
from storage.formats.readers.table import (
    ColumnFilter,
    ForceTable,
    PlateSignals,
    make_table_of_separate_plates,
    make_table_with_lowercase_standard_names,
    select_needed_names_or_empty,
)
from storage.formats.readers.text import (
    BLANKS,
    TextLayout,
    is_number,
    parse_columns,
    parse_text_table,
    read_decoded_text,
    split_csv_cells,
    split_trimmed_cells_without_empty_end,
)

BIOWARE_FORM = "lines of facts, a line of names that begins with a time, lines of numbers"
NEXUS_FORM = "a section Devices: its rate, lines of devices, names and units, lines of numbers"
_BIOWARE_NAMES = re.compile(
    r"^\"?(?:\w+\.? )?time(?: *[\[(](?P<unit>\w+)[\])])?\"?(?P<delimiter>[\t;,])", re.I | re.M
)
_NEXUS_NAMES = re.compile(r"^\"?Frame\"?(?P<delimiter>[,;\t])\"?Sub ?Frame\"?", re.I | re.M)
_NEXUS_KIND = re.compile(r"(?P<device>.*?)[ -]*\b(force|moment|cop)", re.IGNORECASE)
_NEXUS_HEAD_CHARACTERS = 65_536
"""Most characters of a section's lines above its names: no section copies all text above it."""
_NEXUS_COMBINED = "combined"
"""Device that Nexus adds: the sum of all plates."""
_NETFORCE_CHANNELS = 6
_NETFORCE_LINES = 20
"""Number of lines by which NetForce's format is recognised."""
OPENSIM_FORM = "a header to the line endheader, a line of names, lines of numbers"
_OPENSIM_END = re.compile(r"^[ \t]*endheader[ \t]*$", re.IGNORECASE | re.MULTILINE)
_OPENSIM_VECTOR = re.compile(r"[^,]*,[^,]*,[^,]*")
_OPENSIM_UNITS = (
    (re.compile(r"_v[xyz]?(_\d+)?$"), "N"),
    (re.compile(r"_p[xyz]?(_\d+)?$"), "m"),
)
_SECONDS = {"": 1.0, "s": 1.0, "ms": 1e-3}
_FORCE_UNITS = {"n": "N", "kn": "kN"}
_LENGTH_UNITS = frozenset(("m", "cm", "mm"))
_COP_NAMES = (("ax", "ay"), ("cx", "cy"))
"""Names of the centre of pressure's coordinates in programs' texts, in lower case."""


def is_bioware(head: str) -> bool:
    """Return whether a text is an export of BioWare."""
    return re.match(r"\s*\"?bioware\b", head, re.IGNORECASE) is not None


def parse_bioware_force_and_cop(text: str, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Parse the vertical force and centre of pressure of every plate, needed or not.

    Raises:
        FileFormatError: names or force plates are missing, or numbers do not fit the names.
    """
    found = _BIOWARE_NAMES.search(text)
    if found is None:
        raise FileFormatError("there is no line of names")
    delimiter = found["delimiter"]
    facts = {
        cells[0].strip(" :").lower(): cells[1:]
        for line in text[: found.start()].split("\n")
        if (cells := split_trimmed_cells_without_empty_end(line, delimiter))
    }
    line, _, rows = text[found.start() :].partition("\n")
    names = split_trimmed_cells_without_empty_end(line, delimiter)[1:]
    devices = [*facts.get("device", []), *[""] * len(names)]
    units = [""] * (len(names) + 1)
    below = split_trimmed_cells_without_empty_end(rows.partition("\n")[0], delimiter)
    if not any(map(is_number, below)):
        units = [*(unit.strip("[]() ") for unit in below), *units]
        rows = rows.partition("\n")[2]
    time_unit = found["unit"] or units[0]
    second = _SECONDS.get(time_unit.lower())
    if second is None:
        raise FileFormatError(f"its time is in {time_unit}", expected="seconds")
    columns = [
        _DeviceColumn("", "abs time", "s"),
        *map(_DeviceColumn, [device or "plate" for device in devices], names, units[1:]),
    ]
    plates = _group_lower_case_columns_by_plate(columns)
    indices = [0, *(i for plate in plates for i in _get_vertical_force_and_cop_columns(plate))]
    numbers = _parse_device_columns(rows, delimiter, columns, indices, values_max)
    notes = []
    stated = next(iter(facts.get("samples (#)", [])), "")
    if stated.isdecimal() and int(stated) > len(numbers[0]):
        notes = [f"it holds {len(numbers[0])} of the {stated} samples that its head states"]
    signals = [
        replace(_make_plate(i, plate, columns, numbers), is_positive_under_load=True)
        for i, plate in enumerate(plates, 1)
    ]
    return make_table_of_separate_plates(numbers[0] * second, signals, notes)


def is_nexus(head: str) -> bool:
    """Return whether a text is an ASCII export of Nexus."""
    return _NEXUS_NAMES.search(head) is not None


def parse_nexus_force_and_cop(text: str, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Parse the vertical force and centre of pressure of each plate, at the rate of the devices.

    Raises:
        FileFormatError: no section has a force plate, or numbers do not fit its head.
    """
    refusal: FileFormatError | None = None
    for found in _NEXUS_NAMES.finditer(text):
        delimiter, begin = found["delimiter"], found.start()
        above = [
            split_trimmed_cells_without_empty_end(line, delimiter)
            for line in text[max(0, begin - _NEXUS_HEAD_CHARACTERS) : begin].rsplit("\n", 4)[-4:-1]
        ]
        line, at = _cut_line(text, begin)
        units, at = _cut_line(text, at)
        columns = _make_device_columns(
            above[-1] if above else [],
            split_trimmed_cells_without_empty_end(line, delimiter),
            split_trimmed_cells_without_empty_end(units, delimiter),
        )
        try:
            groups = _group_lower_case_columns_by_plate(columns)
        except FileFormatError as error:
            refusal = refusal or error
            continue
        rate_hz = _parse_rate_hz(above)
        groups = [
            group
            for group in groups
            if len(groups) != 2 or columns[group["fz"]].device.lower() != _NEXUS_COMBINED
        ]
        rows = text[at:]
        end = re.search(rf"^[\"{delimiter} ]*$", rows, re.MULTILINE)
        rows = rows[: end.start()] if end else rows
        needed = {0, 1}
        for group in groups:
            needed |= {*_get_vertical_force_and_cop_columns(group), *_shear_columns(group)}
        numbers = _parse_device_columns(rows, delimiter, columns, needed, values_max)
        time_s = _sample_times_s(numbers[0], numbers[1], rate_hz)
        plates = [
            _make_nexus_plate(i, group, columns, numbers) for i, group in enumerate(groups, 1)
        ]
        return make_table_of_separate_plates(time_s, plates)
    raise refusal or FileFormatError("it has no section")


def _cut_line(text: str, begin: int) -> tuple[str, int]:
    """Return the line that begins at `begin`, and where the next one begins."""
    end = text.find("\n", begin)
    return (text[begin:], len(text)) if end < 0 else (text[begin:end], end + 1)


def _make_device_columns(
    devices: list[str], names: list[str], units: list[str]
) -> list[_DeviceColumn]:
    """Return the head of each column; only the first column of a device has its name."""
    columns, device = [], ""
    for i, name in enumerate(names):
        device = devices[i] if i < len(devices) and devices[i] else device
        kind = _NEXUS_KIND.fullmatch(device)
        unit = units[i].strip("[]() ") if i < len(units) else ""
        # Channels of electrodes or joints may be named Fz as well.
        is_force = name.lower() != "fz" or unit.lower() in _FORCE_UNITS
        plate = kind["device"] or "plate" if kind and i > 1 and is_force else ""
        columns.append(_DeviceColumn(plate, name, unit))
    return columns


def _parse_rate_hz(above: list[list[str]]) -> float:
    stated = above[-2][0] if len(above) > 1 and above[-2] else ""
    try:
        rate_hz = float(stated)
    except ValueError:
        rate_hz = 0.0
    if not 0.0 < rate_hz < np.inf:
        raise FileFormatError(f"the rate of its devices is {stated!r}", expected="samples a second")
    return rate_hz


def _shear_columns(group: dict[str, int]) -> list[int]:
    return [group[name] for name in ("fx", "fy") if name in group]


def _sample_times_s(frames: Floats, subframes: Floats, rate_hz: float) -> Floats:
    """Return the times of samples, computed from frame numbers and subframe numbers from 0."""
    numbers = frames * (np.nanmax(subframes, initial=0.0) + 1.0) + subframes
    if len(numbers) == 0 or not (np.diff(numbers) > 0.0).all():
        raise FileFormatError("its frames do not rise from line to line")
    return np.asarray((numbers - numbers[0]) / rate_hz, dtype=np.float64)


def _make_nexus_plate(
    number: int, group: dict[str, int], columns: list[_DeviceColumn], numbers: dict[int, Floats]
) -> PlateSignals:
    """Return a plate, its force signed by the load.

    Raises:
        FileFormatError: z is not the vertical axis.
    """
    plate = _make_plate(number, group, columns, numbers)
    peak = np.max(np.abs(plate.fz), initial=0.0, where=np.isfinite(plate.fz))
    for i in _shear_columns(group):
        shear = numbers[i]
        if np.max(np.abs(shear), initial=0.0, where=np.isfinite(shear)) > peak:
            raise FileFormatError(
                f"{columns[i].name} of {columns[i].device!r} is greater than its Fz",
                expected="a laboratory with z up",
                remedy="Export it with z up, or as C3D",
            )
    return plate


def is_netforce(head: str) -> bool:
    """Return whether a text is an export of NetForce.

    A first column that rises from line to line is a time, not a force.
    """
    lines = islice((line for line in head.split("\n") if line.strip()), _NETFORCE_LINES)
    rows = [split_trimmed_cells_without_empty_end(line, ",") for line in lines]
    if len(rows) == _NETFORCE_LINES or not head.endswith("\n"):
        rows = rows[:-1]  # the last line may be truncated
    width = len(rows[0]) if rows else 0
    if len(rows) < 2 or not width or width % _NETFORCE_CHANNELS:
        return False
    if not all(len(row) == width and all(map(is_number, row)) for row in rows):
        return False
    first = [float(row[0]) for row in rows]
    return not all(a < b for a, b in pairwise(first))


def parse_netforce_force_and_cop_without_time(
    text: str, is_needed: ColumnFilter, values_max: int
) -> ForceTable:
    """Parse the vertical force and centre of pressure of each plate, beside the numbered columns.

    Raises:
        FileFormatError: lines have different numbers of cells, or a cell is no number.
    """
    raw = parse_text_table(text, lambda name: True, values_max)
    if len(raw.names) % _NETFORCE_CHANNELS:
        raise FileFormatError(f"it has {len(raw.names)} columns")
    channels = [np.asarray(raw.columns[name], dtype=np.float64) for name in raw.names]
    plates = [
        _make_netforce_plate(i // _NETFORCE_CHANNELS + 1, channels[i : i + _NETFORCE_CHANNELS])
        for i in range(0, len(channels), _NETFORCE_CHANNELS)
    ]
    note = (
        "6 columns without names are taken for Fx, Fy, Fz, Mx, My and Mz of a plate, as AMTI's "
        "NetForce saves them"
    )
    table = make_table_of_separate_plates(
        np.arange(len(channels[0]), dtype=np.float64), plates, [note]
    )
    found = {name: column for name, column in table.columns.items() if name != "time_s"}
    columns = {**found, **raw.columns}
    return replace(table, names=(*found, *raw.names), columns=columns, units={})


def _make_netforce_plate(number: int, channels: list[Floats]) -> PlateSignals:
    _, _, fz, mx, my, _ = channels
    cop = compute_cop_from_moments(fz, mx, my)
    note = (
        "COP is -My/Fz and Mx/Fz, at the height of the origin of its moments: how far the surface "
        "is above it the file does not state"
    )
    return PlateSignals(f"plate{number}", fz, cop, None, None, notes=(note,))


def read_opensim_table(path: Path, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Read time and the needed columns of a `.mot` or `.sto` file.

    Raises:
        FileFormatError: unreadable, header or names are missing, or numbers do not fit the names.
    """
    text = read_decoded_text(path)
    end = _OPENSIM_END.search(text)
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
    if len(first) > 1 and all(map(_OPENSIM_VECTOR.fullmatch, first[1:])):
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
    units = {name: unit for name in names for ending, unit in _OPENSIM_UNITS if ending.search(name)}
    table = make_table_with_lowercase_standard_names(
        names, columns, units=units | dict.fromkeys(times, "s"), expected_form=OPENSIM_FORM
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


@dataclass(frozen=True)
class _DeviceColumn:
    """Head of a column of numbers.

    Attributes:
        device: name of the plate; empty for times and frame numbers.
        name: name of the quantity, such as `Fz`.
        unit: stated unit; empty if the file states none.
    """

    device: str
    name: str
    unit: str


def _group_lower_case_columns_by_plate(columns: Sequence[_DeviceColumn]) -> list[dict[str, int]]:
    """Return the columns of each device with a vertical force: indices by lower-case name.

    Devices may share a name: a repeated quantity then begins the next device.

    Raises:
        FileFormatError: no device has a vertical force, or the grouping is ambiguous.
    """
    groups: dict[str, list[dict[str, int]]] = {}
    for i, column in enumerate(columns):
        if not (column.device and column.name):
            continue
        of_device = groups.setdefault(column.device, [{}])
        if column.name.lower() in of_device[-1]:
            of_device.append({})
        of_device[-1][column.name.lower()] = i
    groups = {
        device: found for device, found in groups.items() if any("fz" in one for one in found)
    }
    for device, found in groups.items():
        if any(one.keys() != found[0].keys() for one in found):
            raise FileFormatError(
                f"the columns of {device!r} cannot be assigned to devices",
                expected="a name of its own for each device, or the same columns for all",
            )
    plates = [one for found in groups.values() for one in found if "fz" in one]
    if not plates:
        names = ", ".join(dict.fromkeys(column.name for column in columns if column.name))
        raise FileFormatError(
            f"there is no force plate in it (its columns are {names[:200]})",
            expected="a column Fz",
            remedy="Export the forces as well",
        )
    return plates


def _parse_device_columns(
    rows: str,
    delimiter: str,
    columns: Sequence[_DeviceColumn],
    indices: Collection[int],
    values_max: int,
) -> dict[int, Floats]:
    """Return the numbers of the given columns by index.

    Raises:
        FileFormatError: a line has more numbers than names, a cell is no number, or there are no
            lines.
    """
    first = rows.partition("\n")[0]
    if not first.strip():
        raise FileFormatError("there are no numbers below the names", expected="a whole file")
    width = len(split_csv_cells(first, delimiter))
    filled = len(split_trimmed_cells_without_empty_end(first, delimiter))
    if filled > len(columns) or width <= max(indices):
        raise FileFormatError(
            f"there are {len(columns)} names for {width} columns of numbers",
            expected="a name over each column",
        )
    names = [f"{i} ({column.name})" for i, column in enumerate(columns[:width], 1)]
    names += [""] * (width - len(names))
    layout = TextLayout(tuple(names), delimiter, 0, {})
    found = parse_columns(rows, layout, [names[i] for i in indices], values_max)
    return {i: np.asarray(found[names[i]], dtype=np.float64) for i in indices}


def _get_vertical_force_and_cop_columns(plate_columns: dict[str, int]) -> list[int]:
    """Return the indices of a plate's vertical force and centre of pressure."""
    return [plate_columns["fz"], *_get_cop_columns(plate_columns)]


def _make_plate(
    number: int,
    plate_columns: dict[str, int],
    columns: Sequence[_DeviceColumn],
    numbers: dict[int, Floats],
) -> PlateSignals:
    """Return a plate made of its columns, in the file's units, with a note of its name there."""
    head = columns[plate_columns["fz"]]
    cop = _get_cop_columns(plate_columns)
    lengths = {columns[i].unit.lower() for i in cop}
    return PlateSignals(
        f"plate{number}",
        numbers[plate_columns["fz"]],
        np.stack([numbers[i] for i in cop]) if cop else None,
        _FORCE_UNITS.get(head.unit.lower()),
        lengths.pop() if len(lengths) == 1 and lengths <= _LENGTH_UNITS else None,
        notes=(f"{head.device!r} of the file",),
    )


def _get_cop_columns(plate_columns: dict[str, int]) -> list[int]:
    for names in _COP_NAMES:
        if plate_columns.keys() >= {*names}:
            return [plate_columns[name] for name in names]
    return []
