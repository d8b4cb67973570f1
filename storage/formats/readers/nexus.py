"""Reader of Vicon Nexus's ASCII export: sections of devices, joints and trajectories.

A section has a title, a rate, a line of devices, a line of names (`Frame`, `Sub Frame`, ...), a
line of units, and lines of numbers up to an empty line. A force plate is three devices, such as
`AMTI #1 - Force`, `AMTI #1 - Moment` and `AMTI #1 - CoP`, in the axes of the laboratory, z up. The
sign of the force is inferred from the load, as in C3D.
"""

from __future__ import annotations

import re

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.formats.readers.device_columns import (
    FORCE_UNITS,
    DeviceColumn,
    get_vertical_force_and_cop_columns,
    group_lower_case_columns_by_plate,
    make_plate_signals_in_file_units,
    parse_device_columns,
)
from storage.formats.readers.plate_signals import PlateSignals, make_table_of_separate_plates
from storage.formats.readers.table import ForceTable
from storage.formats.readers.text import split_trimmed_cells_without_empty_end

FORM = "a section Devices: its rate, lines of devices, names and units, lines of numbers"
_NAMES = re.compile(r"^\"?Frame\"?(?P<delimiter>[,;\t])\"?Sub ?Frame\"?", re.I | re.M)
_KIND = re.compile(r"(?P<device>.*?)[ -]*\b(force|moment|cop)", re.IGNORECASE)
_COMBINED = "combined"
"""Device that Nexus adds: the sum of all plates."""


def is_nexus(head: str) -> bool:
    """Return whether a text is an ASCII export of Nexus."""
    return _NAMES.search(head) is not None


def parse_nexus_force_and_cop(text: str, where: str, values_max: int) -> ForceTable:
    """Parse the vertical force and centre of pressure of each plate, at the rate of the devices.

    Raises:
        FileFormatError: no section has a force plate, or numbers do not fit its head.
    """
    refusal: FileFormatError | None = None
    for found in _NAMES.finditer(text):
        delimiter = found["delimiter"]
        above = [
            split_trimmed_cells_without_empty_end(line, delimiter)
            for line in text[: found.start()].split("\n")[-4:-1]
        ]
        line, _, below = text[found.start() :].partition("\n")
        units, _, rows = below.partition("\n")
        columns = _make_device_columns(
            above[-1] if above else [],
            split_trimmed_cells_without_empty_end(line, delimiter),
            [
                cell.strip("[]() ")
                for cell in split_trimmed_cells_without_empty_end(units, delimiter)
            ],
        )
        try:
            groups = group_lower_case_columns_by_plate(columns, where)
        except FileFormatError as error:
            refusal = refusal or error
            continue
        rate_hz = _parse_rate_hz(above, where)
        groups = [
            group
            for group in groups
            if len(groups) != 2 or columns[group["fz"]].device.lower() != _COMBINED
        ]
        end = re.search(rf"^[\"{delimiter} ]*$", rows, re.MULTILINE)
        rows = rows[: end.start()] if end else rows
        needed = [
            0,
            1,
            *(
                i
                for group in groups
                for i in {*get_vertical_force_and_cop_columns(group), *_shear_columns(group)}
            ),
        ]
        numbers = parse_device_columns(rows, delimiter, columns, needed, values_max, where)
        time_s = _sample_times_s(numbers[0], numbers[1], rate_hz, where)
        plates = [
            _make_plate(i + 1, group, columns, numbers, where) for i, group in enumerate(groups)
        ]
        return make_table_of_separate_plates(where, time_s, plates)
    raise refusal or FileFormatError("it has no section", where=where, expected=FORM)


def _make_device_columns(
    devices: list[str], names: list[str], units: list[str]
) -> list[DeviceColumn]:
    """Return the head of each column; only the first column of a device has its name."""
    columns, device = [], ""
    for i, name in enumerate(names):
        device = devices[i] if i < len(devices) and devices[i] else device
        kind = _KIND.fullmatch(device)
        unit = units[i] if i < len(units) else ""
        # Channels of electrodes or joints may be named Fz as well.
        is_force = name.lower() != "fz" or unit.lower() in FORCE_UNITS
        of_plate = i > 1 and is_force
        plate = kind["device"] or "plate" if kind and of_plate else ""
        columns.append(DeviceColumn(plate, name, unit))
    return columns


def _parse_rate_hz(above: list[list[str]], where: str) -> float:
    stated = above[-2][0] if len(above) > 1 and above[-2] else ""
    try:
        rate_hz = float(stated)
    except ValueError:
        rate_hz = 0.0
    if not 0.0 < rate_hz < np.inf:
        raise FileFormatError(
            f"the rate of its devices is {stated!r}", where=where, expected="samples a second"
        )
    return rate_hz


def _shear_columns(group: dict[str, int]) -> list[int]:
    return [group[name] for name in ("fx", "fy") if name in group]


def _sample_times_s(frames: Floats, subframes: Floats, rate_hz: float, where: str) -> Floats:
    """Return the times of samples, computed from frame numbers and subframe numbers from 0."""
    numbers = frames * (np.nanmax(subframes, initial=0.0) + 1.0) + subframes
    if len(numbers) == 0 or not (np.diff(numbers) > 0.0).all():
        raise FileFormatError(
            "its frames do not rise from line to line", where=where, expected=FORM
        )
    return np.asarray((numbers - numbers[0]) / rate_hz, dtype=np.float64)


def _make_plate(
    number: int,
    group: dict[str, int],
    columns: list[DeviceColumn],
    numbers: dict[int, Floats],
    where: str,
) -> PlateSignals:
    """Return a plate.

    Raises:
        FileFormatError: z is not the vertical axis.
    """
    plate = make_plate_signals_in_file_units(f"plate{number}", group, columns, numbers)
    peak = np.max(np.abs(plate.fz), initial=0.0, where=np.isfinite(plate.fz))
    for i in _shear_columns(group):
        shear = numbers[i]
        if np.max(np.abs(shear), initial=0.0, where=np.isfinite(shear)) > peak:
            raise FileFormatError(
                f"{columns[i].name} of {columns[i].device!r} is greater than its Fz",
                where=where,
                expected="a laboratory with z up",
                remedy="Export it with z up, or as C3D",
            )
    return plate
