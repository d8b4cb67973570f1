"""Reader of Novel's Loadsol and Loadpad texts; pedar insoles are refused.

A line of soles, `PGV247-L::heel` or `PGV247-L`, precedes a line of quantities, `Time[secs]` and
`Force[N]`. Each sole has a column of times, forces of its regions if any, and their sum. A lost
packet is -1 in each region, and 0 in the sum.

The areas differ by sensor and by size. They are in the insole's file, not in the `.asc` file that
the software saves.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NoReturn

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.formats.readers.plate_signals import PlateSignals, make_table_of_separate_plates
from storage.formats.readers.table import ColumnFilter, ForceTable
from storage.formats.readers.text import TextLayout, parse_columns

FORM = "a line of soles over a line of Time[secs] and Force[N], over lines of numbers"
HEAD_LINES = 10
LOST_PACKET_FORCE = -1.0
"""Force of a lost packet."""
_TIME = re.compile(r"Time\s*\[(s|secs?|ms)\]", re.IGNORECASE)
_FORCE = re.compile(r"Force\s*\[(\w+)\]", re.IGNORECASE)
_SIDE = re.compile(r"[-_ ]([LR])$")
_SIDES = {"L": "left", "R": "right"}
_TIME_DIFFERENCE_PACKETS = 1.5
"""Largest difference of two soles' times in one line, in packets: rounding to a packet."""


def is_loadsol(head: str) -> bool:
    """Return whether a text is an export of Novel's Loadsol app."""
    return _find_names(head) is not None


def parse_loadsol_forces(
    text: str, where: str, is_time_source: ColumnFilter, values_max: int
) -> ForceTable:
    """Parse the force of each sole as `left_fz`, `right_fz`, at the times of the needed soles.

    Raises:
        FileFormatError: a cell is no number, or the needed soles differ in their times.
    """
    lines = text.split("\n", HEAD_LINES + 1)
    found = _find_names(text)
    if found is None:
        raise FileFormatError("there is no line of soles", where=where, expected=FORM)
    at, delimiter = found
    sensors, quantities = (_split_cells(lines[line], delimiter) for line in (at - 1, at))
    first = lines[at + 1] if at + 1 < len(lines) else ""
    width = max(len(quantities), first.count(delimiter) + 1 if first else 0)
    times = [i for i, name in enumerate(quantities) if _TIME.fullmatch(name)]
    forces = [i for i, name in enumerate(quantities) if _FORCE.fullmatch(name)]
    if nameless := [i for i in forces if not (sensors[i : i + 1] and sensors[i])]:
        raise FileFormatError(
            f"the force in column {nameless[0] + 1} belongs to no sole", where=where, expected=FORM
        )
    names = [""] * width
    for i in times:
        names[i] = f"Time[secs] in column {i + 1}"
    for i in forces:
        names[i] = f"{sensors[i]} in column {i + 1}"
    layout = TextLayout(tuple(names), delimiter, at + 1, {})
    needed = [names[i] for i in sorted((*times, *forces))]
    columns = parse_columns(text, layout, needed, values_max, where)
    plates: list[PlateSignals] = []
    times_s: list[Floats] = []
    for sole in dict.fromkeys(sensors[i].partition("::")[0] for i in forces):
        own = [i for i in forces if sensors[i].partition("::")[0] == sole]
        total = [columns[names[i]] for i in own if "::" not in sensors[i]]
        regions = [columns[names[i]] for i in own if "::" in sensors[i]]
        if len(total) > 1:
            raise FileFormatError(f"sole {sole} is there twice", where=where, expected=FORM)
        units = {match[1] for i in own if (match := _FORCE.fullmatch(quantities[i]))}
        lost = np.any([column == LOST_PACKET_FORCE for column in (*total, *regions)], axis=0)
        fz = np.where(lost, np.nan, total[0] if total else np.sum(regions, axis=0))
        side = _SIDE.search(sole)
        plates.append(
            PlateSignals(
                _SIDES[side[1]] if side else sole,
                fz,
                None,
                units.pop() if len(units) == 1 else None,
                None,
                is_positive_under_load=True,
                notes=(f"{lost.sum()} of {len(lost)} packets did not arrive",) * bool(lost.any()),
            )
        )
        stamp = max(i for i in times if i < own[0])
        scale = 1e-3 if quantities[stamp].lower().endswith("[ms]") else 1.0
        times_s.append(np.asarray(columns[names[stamp]] * scale, dtype=np.float64))
    if len({plate.name for plate in plates}) < len(plates):
        raise FileFormatError("two soles are of one side", where=where, expected="one of each")
    time_s = _needed_times(plates, times_s, is_time_source, where)
    return make_table_of_separate_plates(where, time_s, plates)


def _needed_times(
    plates: Sequence[PlateSignals], times_s: Sequence[Floats], is_needed: ColumnFilter, where: str
) -> Floats:
    """Return the times of the needed sole; of several soles the first one's, if they agree."""
    needed = [
        time_s
        for plate, time_s in zip(plates, times_s, strict=True)
        if is_needed(f"{plate.name}_fz")
    ]
    first = (needed or times_s)[0]
    steps_s = np.diff(first)
    packet_s = float(steps_s[steps_s > 0.0].min(initial=np.inf))
    for other in needed[1:]:
        apart_s = float(np.nanmax(np.abs(other - first), initial=0.0))
        if apart_s > _TIME_DIFFERENCE_PACKETS * packet_s:
            raise FileFormatError(
                f"the soles' times are up to {apart_s:.3g} s apart",
                where=where,
                expected="times of one and the same clock, to add soles up",
                remedy="Compare each sole alone",
            )
    return first


def _find_names(text: str) -> tuple[int, str] | None:
    """Return the number of the line of quantities, and its delimiter; None for another text."""
    lines = text.split("\n", HEAD_LINES)[:HEAD_LINES]
    for at in range(1, len(lines)):
        for delimiter in "\t;,":
            sensors, cells = (_split_cells(lines[line], delimiter) for line in (at - 1, at))
            if (
                len(sensors) > 1
                and len(cells) > 1
                and not sensors[0]
                and sensors[1]
                and _TIME.fullmatch(cells[0])
                and _FORCE.fullmatch(cells[1])
            ):
                return at, delimiter
    return None


def _split_cells(line: str, delimiter: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split(delimiter)]


_HEAD = re.compile(r"^sensor type:.*\n(?:.*\n){0,4}pressure values in\s+(\w+)", re.MULTILINE)
_NAMES = re.compile(r"^time\[secs\][ \t]+1[ \t].*$", re.MULTILINE)


def is_pedar(head: str) -> bool:
    """Return whether a text has the pressures of pedar's sensors."""
    return _HEAD.search(head) is not None and _NAMES.search(head) is not None


def refuse_pedar(text: str, where: str, values_max: int) -> NoReturn:
    """Refuse pressures without areas.

    Raises:
        FileFormatError: always.
    """
    names, unit = _NAMES.search(text), _HEAD.search(text)
    count = len(names[0].split()) - 1 if names else 0
    raise FileFormatError(
        f"it has pressures of {count} sensors in {unit[1] if unit else 'kPa'}, and does not state "
        "their areas: no force follows from them",
        where=where,
        expected="forces, of each foot",
        remedy="Let pedar's software compute the force, and save that as a table",
    )
