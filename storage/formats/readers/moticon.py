"""Reader of the text export of Moticon's OpenGo insoles.

Lines of facts begin with `#`; the last one has the names: `left total force[N]`, `left center of
pressure X[-0.5...+0.5]`. X is a fraction of the sole's length, towards the toes, Y of its width.
The software does not state the direction of Y. In its recordings the roll-over passes below zero in
mid-stance and ends above zero on both feet, and of sensors 9 to 12 in a row across the ball those
at the first metatarsal are above zero: Y is positive medially. Almost without load, the software
writes (0, 0).
"""

from __future__ import annotations

import re

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.formats.readers.plate_signals import PlateSignals, make_table_of_separate_plates
from storage.formats.readers.table import SOLE_FRACTION, Column, ForceTable
from storage.formats.readers.text import TextLayout, parse_columns

FORM = "facts behind #, a line of names that begins with # time, lines of numbers"
HEAD_LINES = 50
SOLE_FRACTION_UNIT = "-0.5...+0.5"
"""Unit of a centre of pressure given as fractions of the sole."""
STEP_MAX_S = 0.5
"""Largest step of times in s; larger steps are ms, as insoles sample at 10 to 100 Hz."""
_NAMES = re.compile(r"#\s*time\t.*total force\[", re.IGNORECASE)
_FORCE = re.compile(r"(left|right) total force\[(.*)\]", re.IGNORECASE)
_COP = re.compile(r"(left|right) center of pressure ([XY])\[(.*)\]", re.IGNORECASE)
_DURATION = re.compile(r"^#\s*Duration:\s*(?:(\d+):)?(\d+):(\d+(?:\.\d+)?)\s*$", re.MULTILINE)


def is_moticon(head: str) -> bool:
    """Return whether a text is an export of Moticon's OpenGo software."""
    return _find_names(head) is not None


def parse_moticon_force_and_cop(text: str, where: str, values_max: int) -> ForceTable:
    """Parse force and centre of pressure of each sole: `left_fz`, `left_cop_x`, `left_cop_y`.

    Raises:
        FileFormatError: a cell is no number, or times are longer than the recording.
    """
    at = _find_names(text)
    if at is None:
        raise FileFormatError("there is no line of names", where=where, expected=FORM)
    lines = text.split("\n", at + 2)
    names = [name.strip() for name in lines[at].lstrip("# ").split("\t")]
    width = lines[at + 1].count("\t") + 1 if len(lines) > at + 1 and lines[at + 1] else 0
    names += [""] * (width - len(names))
    cops = {name: match for name in names if (match := _COP.fullmatch(name))}
    forces = {name: match for name in names if (match := _FORCE.fullmatch(name))}
    needed = [
        names[0],
        *forces,
        *(name for name, match in cops.items() if match[3] == SOLE_FRACTION_UNIT),
    ]
    layout = TextLayout(tuple(names), "\t", at + 1, {})
    columns = parse_columns(text, layout, needed, values_max, where)
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
    return make_table_of_separate_plates(where, _to_seconds(columns[names[0]], text, where), plates)


def _to_seconds(time: Column, text: str, where: str) -> Floats:
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
                where=where,
                expected="times in seconds or milliseconds, within the duration",
            )
    return time_s


def _find_names(text: str) -> int | None:
    """Return the number of the line of names; None for another text."""
    lines = text.split("\n", HEAD_LINES)[:HEAD_LINES]
    return next((at for at, line in enumerate(lines) if _NAMES.match(line)), None)
