"""Readers of two points of a leg over time: files of Kinovea, DeepLabCut, TRC and C3D.

- Kinovea, CSV (its source, ExporterCSVTrajectory): `Time`, then `NAME/0/X` and `NAME/0/Y` of each
  trajectory, y upwards; times as the user sets them, which have to be seconds.
- DeepLabCut, CSV: the rows scorer, bodyparts, coords; then a picture's number and x, y, likelihood
  of each point, y downwards.
- TRC (OpenSim), with tabs: rate, counts and unit in line 3, names in line 4, y upwards.
- C3D: points in mm, cm or m, z upwards.
"""

from __future__ import annotations

import csv
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError, UsageError
from storage.formats.readers.c3d import METRES, read_c3d_points
from storage.formats.readers.text import read_decoded_text

LIKELIHOOD_MIN = 0.6
"""Likelihood below which DeepLabCut itself shows no point (its `pcutoff`)."""
_OF_PICTURE = {"right": (0, 1.0), "left": (0, -1.0)}
Row = tuple[int, list[str]]
"""Number of a line, and its cells."""
_Value = TypeVar("_Value")


class LegPoints(NamedTuple):
    """Two points at n instants.

    Attributes:
        instants: (n,), rising: pictures from 0 on, or s from the file's begin.
        is_picture: True: pictures.
        places: (n, 2, 2), of the lower and the upper point, forward and up, in the file's unit;
            NaN where hidden.
    """

    instants: Floats
    is_picture: bool
    places: Floats


def read_leg_points(path: Path, names: tuple[str, str], forward: str | None) -> LegPoints:
    """Read the lower and the upper point.

    Args:
        path: the file; its suffix and its first cells name the format.
        names: of the lower and the upper point.
        forward: direction in which the foot rolls: `right` or `left` in a picture; `x`, `-x`, ...
            of points in space; None: `right`, or `x`.

    Raises:
        FileFormatError: unreadable, a point is missing, instants do not rise, a cell is no number,
            or the upper point is not above the lower one.
        UsageError: no such direction.
    """
    try:
        found = _read(path, names, forward)
    except FileFormatError as error:
        raise FileFormatError(
            error.what, where=str(path), expected=error.expected, remedy=error.remedy
        ) from error
    except (OSError, struct.error, csv.Error) as error:
        raise FileFormatError(f"cannot be read: {error}", where=str(path)) from error
    above = found.places[:, 1, 1] - found.places[:, 0, 1]
    if np.isnan(above).all():
        raise FileFormatError("at no instant are both points known", where=str(path))
    if np.nanmedian(above) <= 0.0:
        raise FileFormatError(
            f"{names[1]!r} is not above {names[0]!r}",
            where=str(path),
            expected="the lower point first, and z upwards in C3D, y in TRC and Kinovea",
        )
    return found


def _read(path: Path, names: tuple[str, str], forward: str | None) -> LegPoints:
    suffix = path.suffix.lower()
    if suffix == ".c3d":
        rate_hz, points = read_c3d_points(path)
        pair = [_select(points, name) for name in names]
        times_s = np.arange(len(pair[0])) / rate_hz
        return _orient(times_s, pair, forward, up=2)
    if suffix not in (".csv", ".trc"):
        raise FileFormatError(
            "a file of another kind",
            expected=".csv of Kinovea or DeepLabCut, .trc or .c3d",
            remedy="Export it from Kinovea as CSV (trajectories)",
        )
    text = read_decoded_text(path)
    first = text.partition("\n")[0]
    separators = "\t" if suffix == ".trc" else ",;"
    delimiter = max(separators, key=first.count)
    reader = csv.reader(text.splitlines(), delimiter=delimiter)
    rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    rows = [row for row in rows if any(row[1])]
    parse: Callable[[list[Row], tuple[str, str], str | None], LegPoints]
    if suffix == ".trc":
        parse = _parse_trc
    elif rows and rows[0][1][0] == "scorer":
        parse = _parse_deeplabcut
    elif rows and rows[0][1][0] == "Time":
        parse = _parse_kinovea
    else:
        raise FileFormatError(
            f"line 1 is {first[:40]!r}", expected="'Time' (Kinovea) or 'scorer' (DeepLabCut) first"
        )
    return parse(rows, names, forward)


def _parse_kinovea(rows: list[Row], names: tuple[str, str], forward: str | None) -> LegPoints:
    heads = rows[0][1]
    trajectories = {
        head.removesuffix("/X").removesuffix("/0"): i
        for i, head in enumerate(heads)
        if head.endswith("/X") and heads[i + 1 : i + 2] == [f"{head[:-1]}Y"]
    }
    columns = [_select(trajectories, name) for name in names]
    numbers = _parse_numbers(rows[1:], [0, *(c + i for c in columns for i in (0, 1))], len(heads))
    return _orient(numbers[:, 0], [numbers[:, 1:3], numbers[:, 3:5]], forward)


def _parse_deeplabcut(rows: list[Row], names: tuple[str, str], forward: str | None) -> LegPoints:
    if [row[1][0] for row in rows[:3]] != ["scorer", "bodyparts", "coords"]:
        raise FileFormatError(
            f"its first rows are {', '.join(repr(row[1][0]) for row in rows[:3])}",
            expected="scorer, bodyparts and coords, as of one animal",
        )
    parts, coords = rows[1][1], rows[2][1]
    points = {
        part: i
        for i, part in enumerate(parts)
        if coords[i : i + 3] == ["x", "y", "likelihood"] and parts[i : i + 3] == [part] * 3
    }
    columns = [_select(points, name) for name in names]
    numbers = _parse_numbers(
        rows[3:], [0, *(c + i for c in columns for i in (0, 1, 2))], len(parts)
    )
    pair = []
    for own in (numbers[:, 1:4], numbers[:, 4:7]):
        is_seen = own[:, 2:] >= LIKELIHOOD_MIN
        pair.append(np.where(is_seen, own[:, :2] * (1.0, -1.0), math.nan))
    return _orient(numbers[:, 0], pair, forward)._replace(is_picture=True)


def _parse_trc(rows: list[Row], names: tuple[str, str], forward: str | None) -> LegPoints:
    if len(rows) < 6 or rows[0][1][0] != "PathFileType" or rows[3][1][:2] != ["Frame#", "Time"]:
        raise FileFormatError("it is no TRC file", expected="'PathFileType' in line 1")
    facts = dict(zip(rows[1][1], rows[2][1], strict=False))
    if facts.get("Units") not in METRES:
        raise FileFormatError(
            f"line {rows[2][0]}: its unit is {facts.get('Units')!r}", expected="mm, cm or m"
        )
    heads = rows[3][1]
    markers = {head: i for i, head in enumerate(heads) if head and i >= 2}
    columns = [_select(markers, name) for name in names]
    width = 2 + 3 * len(markers)
    wanted = [1, *(c + i for c in columns for i in range(3))]
    numbers = _parse_numbers(rows[5:], wanted, width)
    if facts.get("NumFrames") != str(len(numbers)):
        raise FileFormatError(
            f"it ends after {len(numbers)} frames of {facts.get('NumFrames')}",
            expected="the whole file",
        )
    return _orient(numbers[:, 0], [numbers[:, 1:4], numbers[:, 4:7]], forward, up=1)


def _select(points: Mapping[str, _Value], name: str) -> _Value:
    if name not in points:
        listed = ", ".join(list(points)[:20]) or "points"
        raise FileFormatError(f"it has no point {name!r}", expected=f"two of {listed}")
    return points[name]


def _parse_numbers(rows: Sequence[Row], columns: Sequence[int], width: int) -> Floats:
    """Return the numbers of columns, (rows, columns); empty cells are NaN."""
    numbers = np.empty((len(rows), len(columns)))
    for k, (line, cells) in enumerate(rows):
        if any(cells[width:]):  # some programs end a line by a separator
            raise FileFormatError(f"line {line} has {len(cells)} cells", expected=f"{width}")
        for i, column in enumerate(columns):
            cell = cells[column] if column < len(cells) else ""
            try:
                numbers[k, i] = float(cell.replace(",", ".")) if cell else math.nan
            except ValueError as error:
                raise FileFormatError(
                    f"line {line} has {cell[:40]!r}", expected="a number"
                ) from error
    instants = numbers[:, 0]
    wrong = ~np.isfinite(instants) | (np.diff(instants, prepend=-math.inf) <= 0.0)
    if wrong.any():
        raise FileFormatError(
            f"line {rows[int(np.argmax(wrong))][0]} is not later than the one before",
            expected="rows in order of time, each instant once",
        )
    return numbers


def _orient(
    instants: Floats, pair: Sequence[Floats], forward: str | None, up: int | None = None
) -> LegPoints:
    """Return places forward and up; `up` is the upward axis in space, None: of a picture."""
    if up is None:
        directions, up = dict(_OF_PICTURE), 1
    else:
        axes = [(axis, i) for i, axis in enumerate("xyz") if i != up]
        directions = {
            f"{sign}{axis}": (i, float(f"{sign}1")) for axis, i in axes for sign in ("", "-")
        }
    if forward is not None and forward not in directions:
        raise UsageError(f"--forward {forward!r}", expected=" or ".join(directions))
    ahead, sign = directions[forward or next(iter(directions))]
    places = [np.stack([sign * one[:, ahead], one[:, up]], axis=1) for one in pair]
    return LegPoints(instants, is_picture=False, places=np.stack(places, axis=1))
