"""Force platforms of a C3D file, types 1 to 4.

A platform's own z axis points down, into it (C3D user guide, FORCE_PLATFORM). `plate1_fz` is the
force along it as the file holds it: that of the foot on the plate, which is positive, in some
files, and that of the plate on the foot, which is negative, in most. The reader of the table tells
which from the load. What a plate reads without load is not taken off.

Centres of pressure are in the plane of the plate, from the origin of the laboratory. Where the
laboratory has z up, and the plate lies flat, they are its x and y. Another axis may point up, or
the plate may be tilted: then the laboratory is turned, the shortest way, until z is the plate's
normal.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.formats.tables.c3d import C3dFile, read_c3d
from storage.formats.tables.plates import Plate, make_plate_table
from storage.formats.tables.table import IsNeeded, Table, check_size

FORM = "force platforms of types 1 to 4"
_CHANNELS = {1: 6, 2: 6, 3: 8, 4: 6}
"""Channels by type."""
_FORCES = {1: range(2, 3), 2: range(2, 3), 3: range(4, 8)}
"""Channels of vertical forces, by type. Those of type 4 are volts, or anything: in which units its
matrix makes forces of them the file does not state."""
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_FORCE_UNITS = {"n": "N", "newton": "N", "newtons": "N", "kn": "kN"}
_MOMENT = re.compile(r"(k?N)[ .*·-]?(mm|cm|m)", re.IGNORECASE)
FLAT_COS = 0.9999
"""A plate whose normal is nearer to an axis of the laboratory, within 0.8 degrees, lies flat."""


def read_force_platforms(path: Path, is_needed: IsNeeded, numbers_max: int) -> Table:
    """Read force and centre of pressure of each plate, at the rate of analog samples.

    Columns are `plate1_fz`, `plate1_cop_x`, `plate1_cop_y` and so on, as the file has them. A
    single plate has the names `grf_n`, `cop_x_m` and `cop_y_m` as well, if the file states units.

    Raises:
        FileFormatError: it cannot be read, or has no plate that can.
    """
    file = read_c3d(path)
    count = min(int(file.numbers("FORCE_PLATFORM", "USED").sum()), 255)
    if count == 0:
        raise FileFormatError(
            "there is no force platform in it",
            where=file.where,
            expected="FORCE_PLATFORM:USED of 1",
        )
    if not (np.isfinite(file.rate_hz) and file.rate_hz > 0.0):
        raise FileFormatError(f"ANALOG:RATE is {file.rate_hz:g}", where=file.where)
    plates: list[Plate] = []
    notes: list[str] = []
    refusal: FileFormatError | None = None
    for number in range(1, count + 1):
        try:
            plates.append(_plate(file, number - 1, numbers_max))
        except FileFormatError as error:
            notes.append(f"plate {number} is not read: {error.what}")
            refusal = refusal or error
    if refusal is not None and not plates:
        raise refusal
    time_s = np.arange(len(plates[0].fz)) / file.rate_hz
    return make_plate_table(file.where, time_s, plates, [*notes, *_zero_notes(file, plates)])


def _zero_notes(file: C3dFile, plates: list[Plate]) -> list[str]:
    zero = [int(frame) for frame in np.ravel(file.numbers("FORCE_PLATFORM", "ZERO"))]
    if len(zero) != 2 or not 1 <= zero[0] <= zero[1]:
        return []
    first, last = zero
    window = slice((first - 1) * file.samples_a_frame, last * file.samples_a_frame)
    read = [plate.fz[window] for plate in plates]
    means = ", ".join(f"{fz.mean():.3f}" for fz in read if len(fz))
    return [
        f"frames {first} to {last} are to be its zero, in which plates read {means}: nothing is "
        "taken off"
    ]


def _plate(file: C3dFile, i: int, numbers_max: int) -> Plate:
    """Compute a plate's force and centre of pressure.

    Raises:
        FileFormatError: its type is not known, or it has no channels.
    """
    kinds = np.ravel(file.numbers("FORCE_PLATFORM", "TYPE")).astype(int)
    kind = int(kinds[i]) if i < len(kinds) else 0
    if kind not in _CHANNELS:
        raise FileFormatError(f"it is of type {kind}", where=file.where, expected=FORM)
    table = file.numbers("FORCE_PLATFORM", "CHANNEL")
    table = table.reshape(len(table), -1)
    numbers = (table[: _CHANNELS[kind], i : i + 1].astype(int) % 65536).ravel().tolist()
    if len(numbers) < _CHANNELS[kind] or not all(0 < n <= file.channels for n in numbers):
        raise FileFormatError(
            f"it has the channels {', '.join(map(str, numbers)) or 'of nothing'}",
            where=file.where,
            expected=f"{_CHANNELS[kind]} of the {file.channels} channels of the C3D file",
        )
    check_size(len(file.raw), len(numbers), numbers_max, file.where)
    channels = file.samples([n - 1 for n in numbers])
    stated = file.of_channels("UNITS")
    units = [stated[n - 1].strip() if n <= len(stated) else "" for n in numbers]
    force = _same({_FORCE_UNITS.get(units[at].lower()) for at in _FORCES.get(kind, ())})
    position = next(iter(file.texts("POINT", "UNITS")), "").strip().lower()
    length = position if position in _METRES else None
    if kind == 4:
        channels, length = _matrix(file, i) @ channels, None
    elif kind != 3 and length is not None:
        # Levers come in the unit of positions, which the corners have.
        lever = _same({_lever(unit, force if kind == 2 else None) for unit in units[3:5]})
        if lever is None:
            length = None
        else:
            channels[3:5] *= _METRES[lever] / _METRES[length]
    fz, local, note = _surface(kind, channels, _origin(file, i, kind))
    cop, turned = _in_plane(local, _of_plate(file, "CORNERS", i, (3, 4)))
    notes = tuple(text for text in (note, turned) if text)
    return Plate(f"plate{i + 1}", fz, cop, force, length, notes=notes)


def _same(units: set[str | None]) -> str | None:
    """Return the unit that all have; None if they differ, or one has none."""
    return units.pop() if len(units) == 1 else None


def _lever(unit: str, force: str | None) -> str | None:
    """Return the length in a unit of moments, or of lengths; None if it is another unit."""
    if force is None:
        return unit.lower() if unit.lower() in _METRES else None
    match = _MOMENT.fullmatch(unit)
    return match[2].lower() if match and match[1].lower() == force.lower() else None


def _matrix(file: C3dFile, i: int) -> Floats:
    matrix = _of_plate(file, "CAL_MATRIX", i, (6, 6))
    if matrix is None:
        raise FileFormatError(
            "it is of type 4, without CAL_MATRIX", where=file.where, expected="a matrix of 6 by 6"
        )
    return matrix


def _of_plate(file: C3dFile, name: str, i: int, shape: tuple[int, ...]) -> Floats | None:
    """Return what a parameter states of a plate; None if it states nothing."""
    value = file.numbers("FORCE_PLATFORM", name).astype(np.float64)
    size = int(np.prod(shape))
    flat = np.ravel(value, order="F")[i * size : (i + 1) * size]
    if len(flat) < size or not np.isfinite(flat).all():
        return None
    return flat.reshape(shape, order="F")


def _origin(file: C3dFile, i: int, kind: int) -> Floats:
    """Return the place of the surface's centre in the plate's axes; zero if nothing is stated.

    z points down and the surface lies above, so its z is negative. Some programs store the reverse:
    from the centre to the origin. Type 3 has distances from sensor to axis for x and y, whose sign
    is no matter of direction.
    """
    origin = _of_plate(file, "ORIGIN", i, (3,))
    if origin is None:
        return np.zeros(3)
    if kind == 3:
        return np.array([abs(origin[0]), abs(origin[1]), -abs(origin[2])])
    return -origin if origin[2] > 0.0 else origin


def _surface(kind: int, channels: Floats, origin: Floats) -> tuple[Floats, Floats | None, str]:
    """Return force along z, and the centre of pressure on the surface from its middle, (2, n)."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if kind == 1:
            return channels[2], channels[3:5], ""
        if kind == 3:  # Fx12 Fx34 Fy14 Fy23 Fz1 Fz2 Fz3 Fz4
            fx, fy = channels[0] + channels[1], channels[2] + channels[3]
            one, two, three, four = channels[4:8]
            fz = one + two + three + four
            if not (origin[0] > 0.0 and origin[1] > 0.0):
                return (
                    fz,
                    None,
                    "ORIGIN does not state where its sensors are: no centre of pressure",
                )
            mx = origin[1] * (one + two - three - four)
            my = origin[0] * (-one + two + three - four)
            origin = np.array([0.0, 0.0, origin[2]])
        else:
            fx, fy, fz, mx, my = channels[:5]
        # Moments about the middle of the surface: M + F x origin.
        mx = mx + fy * origin[2] - fz * origin[1]
        my = my + fz * origin[0] - fx * origin[2]
        cop = np.stack([-my, mx]) / fz
    cop[:, ~np.isfinite(cop).all(axis=0)] = np.nan
    return fz, cop, ""


def _in_plane(local: Floats | None, corners: Floats | None) -> tuple[Floats | None, str]:
    """Return a centre of pressure in the plane of the plate, from the laboratory's origin."""
    if local is None:
        return None, ""
    nowhere = "CORNERS do not state where it is: no centre of pressure"
    if corners is None:
        return None, nowhere
    x = corners[:, 0] + corners[:, 3] - corners[:, 1] - corners[:, 2]
    y = corners[:, 0] + corners[:, 1] - corners[:, 2] - corners[:, 3]
    z = np.cross(x, y)
    if not np.linalg.norm(z) > 0.0:
        return None, nowhere
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    y = np.cross(z, x)
    place = corners.mean(axis=1)[:, None] + np.outer(x, local[0]) + np.outer(y, local[1])
    normal = -z
    axis = int(np.argmax(np.abs(normal)))
    up = np.zeros(3)
    up[axis] = np.sign(normal[axis])
    cos = float(up @ normal)
    # The axes of the laboratory that become x and y when `up` becomes z, the shortest way.
    to_z = _shortest_turn(up, np.array([0.0, 0.0, 1.0]))
    turn = np.eye(3) if cos > FLAT_COS else _shortest_turn(normal, up)
    notes = []
    if axis != 2 or up[2] < 0.0:
        names = ("x", "y", "z")
        first, second = (
            ("" if row.sum() > 0.0 else "-") + names[int(np.argmax(np.abs(row)))]
            for row in to_z[:2]
        )
        name = ("" if up[axis] > 0.0 else "-") + names[axis]
        notes.append(
            f"its normal is {name} of the laboratory: COP is along {first} and {second} of it"
        )
    if cos <= FLAT_COS:
        notes.append(
            f"it is tilted by {np.degrees(np.arccos(min(1.0, cos))):.1f} degrees: force is along "
            "its normal, and COP in its plane"
        )
    return (to_z @ turn @ place)[:2], "; ".join(notes)


def _shortest_turn(begin: Floats, end: Floats) -> Floats:
    """Return the rotation by the smallest angle that takes one unit vector to another."""
    cos = float(begin @ end)
    if cos < -1.0 + 1e-12:  # half a turn, about x
        return np.diag([1.0, -1.0, -1.0])
    v = np.cross(begin, end)
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + cos))
