"""Readers of texts of insoles: Moticon OpenGo, Novel Loadsol and Loadpad; Novel pedar is refused.

OpenGo: lines of facts begin with `#`; the last one has the names: `left total force[N]`, `left
center of pressure X[-0.5...+0.5]`. X is a fraction of the sole's length, towards the toes, Y of its
width. The software does not state the direction of Y. In its recordings the roll-over passes below
zero in mid-stance and ends above zero on both feet, and of sensors 9 to 12 in a row across the ball
those at the first metatarsal are above zero: Y is positive medially. Almost without load, the
software writes (0, 0).

Loadsol: a line of soles, `PGV247-L::heel` or `PGV247-L`, precedes a line of quantities,
`Time[secs]` and `Force[N]`. Each sole has a column of times, forces of its regions if any, and
their sum. A lost packet is -1 in each region, and 0 in the sum.

pedar: pressures without areas. These differ by sensor and by size, and are in the insole's file,
not in the `.asc` file that the software saves.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NoReturn

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.formats.readers.table import (
    SOLE_FRACTION,
    Column,
    ColumnFilter,
    ForceTable,
    PlateSignals,
    make_table_of_separate_plates,
)
from storage.formats.readers.text import TextLayout, parse_columns

OPENGO_FORM = "facts behind #, a line of names that begins with # time, lines of numbers"
LOADSOL_FORM = "a line of soles over a line of Time[secs] and Force[N], over lines of numbers"
_OPENGO_HEAD_LINES = 50
_LOADSOL_HEAD_LINES = 10
SOLE_FRACTION_UNIT = "-0.5...+0.5"
"""Unit of a centre of pressure given as fractions of the sole."""
STEP_MAX_S = 0.5
"""Largest step of times in s; larger steps are ms, as insoles sample at 10 to 100 Hz."""
LOST_PACKET_FORCE = -1.0
"""Force of a lost packet."""
_TIME_DIFFERENCE_PACKETS = 1.5
"""Largest difference of two soles' times in one line, in packets: rounding to a packet."""
_OPENGO_NAMES = re.compile(r"#\s*time\t.*total force\[", re.IGNORECASE)
_OPENGO_FORCE = re.compile(r"(left|right) total force\[(.*)\]", re.IGNORECASE)
_OPENGO_COP = re.compile(r"(left|right) center of pressure ([XY])\[(.*)\]", re.IGNORECASE)
_DURATION = re.compile(r"^#\s*Duration:\s*(?:(\d+):)?(\d+):(\d+(?:\.\d+)?)\s*$", re.MULTILINE)
_TIME = re.compile(r"Time\s*\[(s|secs?|ms)\]", re.IGNORECASE)
_FORCE = re.compile(r"Force\s*\[(\w+)\]", re.IGNORECASE)
_SIDE = re.compile(r"[-_ ]([LR])$")
_SIDES = {"L": "left", "R": "right"}
_PEDAR_HEAD = re.compile(r"^sensor type:.*\n(?:.*\n){0,4}pressure values in\s+(\w+)", re.MULTILINE)
_PEDAR_NAMES = re.compile(r"^time\[secs\][ \t]+1[ \t].*$", re.MULTILINE)


def is_opengo(head: str) -> bool:
    """Return whether a text is an export of Moticon's OpenGo software."""
    return _find_opengo_names(head) is not None


def parse_opengo_force_and_cop(text: str, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Parse force and centre of pressure of each sole: `left_fz`, `left_cop_x`, `left_cop_y`.

    Raises:
        FileFormatError: a cell is no number, or times are longer than the recording.
    """
    at = _find_opengo_names(text)
    if at is None:
        raise FileFormatError("there is no line of names")
    lines = text.split("\n", at + 2)
    names = [name.strip() for name in lines[at].lstrip("# ").split("\t")]
    width = lines[at + 1].count("\t") + 1 if len(lines) > at + 1 and lines[at + 1] else 0
    names += [""] * (width - len(names))
    cops = {name: match for name in names if (match := _OPENGO_COP.fullmatch(name))}
    forces = {name: match for name in names if (match := _OPENGO_FORCE.fullmatch(name))}
    needed = [
        names[0],
        *forces,
        *(name for name, match in cops.items() if match[3] == SOLE_FRACTION_UNIT),
    ]
    layout = TextLayout(tuple(names), "\t", at + 1, {})
    columns = parse_columns(text, layout, needed, values_max)
    plates = []
    for name, match in forces.items():
        side = match[1].lower()
        axes = {found[2].upper(): found for found in cops.values() if found[1].lower() == side}
        is_part = [axis in axes and axes[axis][3] == SOLE_FRACTION_UNIT for axis in "XY"]
        cop: Floats | None = None
        notes: tuple[str, ...] = ()
        if all(is_part):
            cop = np.stack([columns[axes[axis][0]] for axis in "XY"])
            cop[:, (cop == 0.0).all(axis=0)] = np.nan
            if side == "left":  # medial is to its right, and y to the left
                cop[1] *= -1.0
        elif axes:
            notes = ("its centre of pressure is in units that are not read",)
        fz = np.asarray(columns[name], dtype=np.float64)
        plates.append(PlateSignals(side, fz, cop, match[2], SOLE_FRACTION, True, notes))
    return make_table_of_separate_plates(_to_seconds(columns[names[0]], text), plates)


def _to_seconds(time: Column, text: str) -> Floats:
    """Return times in seconds; the file has seconds or milliseconds.

    Raises:
        FileFormatError: the times exceed the duration that the file states.
    """
    if not len(time):
        return np.empty(0)
    step = float(np.nanmedian(np.diff(time))) if len(time) > 1 else 0.0
    time_s = np.asarray(time / (1e3 if step > STEP_MAX_S else 1.0), dtype=np.float64)
    stated = _DURATION.search(text, 0, 1 << 16)
    if stated:
        duration_s = 3600.0 * int(stated[1] or 0) + 60.0 * int(stated[2]) + float(stated[3])
        span_s = float(np.nanmax(time_s) - np.nanmin(time_s))
        if span_s > 1.1 * duration_s + 1.0:
            raise FileFormatError(
                f"times go over {span_s:g} s, where Duration is {duration_s:g} s",
                expected="times in seconds or milliseconds, within the duration",
            )
    return time_s


def _find_opengo_names(text: str) -> int | None:
    """Return the number of the line of names; None for another text."""
    lines = text.split("\n", _OPENGO_HEAD_LINES)[:_OPENGO_HEAD_LINES]
    return next((at for at, line in enumerate(lines) if _OPENGO_NAMES.match(line)), None)


def is_loadsol(head: str) -> bool:
    """Return whether a text is an export of Novel's Loadsol app."""
    return _find_loadsol_names(head) is not None


def parse_loadsol_forces(text: str, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Parse the force of each sole as `left_fz`, `right_fz`, at the times of the needed soles.

    Raises:
        FileFormatError: a cell is no number, or the needed soles differ in their times.
    """
    lines = text.split("\n", _LOADSOL_HEAD_LINES + 1)
    found = _find_loadsol_names(text)
    if found is None:
        raise FileFormatError("there is no line of soles")
    at, delimiter = found
    sensors, quantities = (_split_cells(lines[line], delimiter) for line in (at - 1, at))
    first = lines[at + 1] if at + 1 < len(lines) else ""
    width = max(len(quantities), first.count(delimiter) + 1 if first else 0)
    times = [i for i, name in enumerate(quantities) if _TIME.fullmatch(name)]
    forces = [i for i, name in enumerate(quantities) if _FORCE.fullmatch(name)]
    if nameless := [i for i in forces if not (sensors[i : i + 1] and sensors[i])]:
        raise FileFormatError(f"the force in column {nameless[0] + 1} belongs to no sole")
    names = [""] * width
    for i in times:
        names[i] = f"Time[secs] in column {i + 1}"
    for i in forces:
        names[i] = f"{sensors[i]} in column {i + 1}"
    layout = TextLayout(tuple(names), delimiter, at + 1, {})
    needed = [names[i] for i in sorted((*times, *forces))]
    columns = parse_columns(text, layout, needed, values_max)
    plates: list[PlateSignals] = []
    times_s: list[Floats] = []
    for sole in dict.fromkeys(sensors[i].partition("::")[0] for i in forces):
        own = [i for i in forces if sensors[i].partition("::")[0] == sole]
        total = [columns[names[i]] for i in own if "::" not in sensors[i]]
        regions = [columns[names[i]] for i in own if "::" in sensors[i]]
        if len(total) > 1:
            raise FileFormatError(f"sole {sole} is there twice")
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
        raise FileFormatError("two soles are of one side", expected="one of each")
    time_s = _needed_times(plates, times_s, is_needed)
    return make_table_of_separate_plates(time_s, plates)


def _needed_times(
    plates: Sequence[PlateSignals], times_s: Sequence[Floats], is_needed: ColumnFilter
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
                expected="times of one and the same clock, to add soles up",
                remedy="Compare each sole alone",
            )
    return first


def _find_loadsol_names(text: str) -> tuple[int, str] | None:
    """Return the number of the line of quantities, and its delimiter; None for another text."""
    lines = text.split("\n", _LOADSOL_HEAD_LINES)[:_LOADSOL_HEAD_LINES]
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


def is_pedar(head: str) -> bool:
    """Return whether a text has the pressures of pedar's sensors."""
    return _PEDAR_HEAD.search(head) is not None and _PEDAR_NAMES.search(head) is not None


def refuse_pedar(text: str, is_needed: ColumnFilter, values_max: int) -> NoReturn:
    """Refuse pressures without areas.

    Raises:
        FileFormatError: always.
    """
    names, unit = _PEDAR_NAMES.search(text), _PEDAR_HEAD.search(text)
    count = len(names[0].split()) - 1 if names else 0
    raise FileFormatError(
        f"it has pressures of {count} sensors in {unit[1] if unit else 'kPa'}, and does not state "
        "their areas: no force follows from them",
        expected="forces, of each foot",
        remedy="Let pedar's software compute the force, and save that as a table",
    )
