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
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.formats.tables.c3d import C3dFile, read_c3d
from storage.formats.tables.plate_geometry import (
    Pose,
    correct_place,
    force_and_place,
    in_plane,
    off_middle,
    pose_of,
)
from storage.formats.tables.plates import Plate, make_plate_table
from storage.formats.tables.table import IsNeeded, Table, check_size

FORM = "force platforms of types 1 to 4"
_CHANNELS = {1: 6, 2: 6, 3: 8, 4: 6}
"""Channels by type."""
_FORCES = {1: range(2, 3), 2: range(2, 3), 3: range(4, 8)}
"""Channels of vertical forces, by type. Those of type 4 are volts, or anything: in which units its
matrix makes forces of them the file does not state."""
_POLYNOMIAL = 12
"""Coefficients of FPCOPPOLY for a plate."""
FILLED_OFFSET = 1000.0
"""Samples without a sign have their zero at such an OFFSET or beyond: stored zeros are none."""
OFF_PLATE = 5.0
"""So many times as far as the edge is a wrong unit, not a wrong ORIGIN."""
OFF_PART = 0.05
"""Part of the loaded samples off the plate that is said."""
BEARS_N = 10.0
"""A plate that never bears so much has no centre of pressure to speak of."""
AT_MIDDLE = 2e-3
"""Nearer to the middle, the edge being 1, a foot's centre of pressure does not stay."""
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_FORCE_UNITS = {"n": "N", "newton": "N", "newtons": "N", "kn": "kN"}
_MOMENT = re.compile(r"(k?N)[ .*·-]?(mm|cm|m)", re.IGNORECASE)


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
    notes = [*file.notes]
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
    notes = [*_drop_filled(file, numbers, channels)]
    stated = file.of_channels("UNITS")
    units = [stated[n - 1].strip() if n <= len(stated) else "" for n in numbers]
    force = _same({_FORCE_UNITS.get(units[at].lower()) for at in _FORCES.get(kind, ())})
    position = next(iter(file.texts("POINT", "UNITS")), "").strip().lower()
    length = position if position in _METRES else None
    origin, pose = _origin(file, i, kind), pose_of(_of_plate(file, "CORNERS", i, (3, 4)))
    factor = 1.0
    if kind == 4:
        channels = _matrix(file, i) @ channels
    elif kind in (1, 2) and length is not None:
        # Levers come in the unit of positions, which the corners have.
        lever = _same({_lever(unit, force if kind == 2 else None) for unit in units[3:5]})
        factor = 1.0 if lever is None else _METRES[lever] / _METRES[length]
        length = None if lever is None else length
    fz, local = force_and_place(kind, channels, origin, factor)
    cop = None
    if local is None:
        notes.append("ORIGIN does not state where its sensors are: no centre of pressure")
    elif pose is None:
        notes.append("CORNERS do not state where it is: no centre of pressure")
    else:
        _, other = force_and_place(kind, channels, origin)
        if factor != 1.0 and other is not None and _is_other_unit(fz, local, other, pose):
            local = other
            notes.append(
                f"its {'moments' if kind == 2 else 'places'} are not in {units[3]}, as the file "
                f"states, but in the unit of its corners, {length}: else they were off the plate"
            )
        if kind == 3:
            local, note = _without_bending(file, i, local, length)
            notes.append(note)
        if not (force == "N" and np.max(np.abs(fz[np.isfinite(fz)]), initial=0.0) < BEARS_N):
            notes += _off_notes(local, fz, pose)
        cop, note = in_plane(local, pose)
        notes.append(note)
    return Plate(f"plate{i + 1}", fz, cop, force, length, notes=tuple(filter(None, notes)))


def _drop_filled(file: C3dFile, numbers: list[int], channels: Floats) -> Iterator[str]:
    """Set to NaN what was not recorded: stored as zeros in all channels, where zero is no zero."""
    filled = ~file.raw[:, [n - 1 for n in numbers]].any(axis=1)
    offsets = file.offsets()[[n - 1 for n in numbers]]
    if filled.any() and np.abs(offsets).max() >= FILLED_OFFSET:
        channels[:, filled] = np.nan
        yield f"{int(filled.sum())} of its samples are stored as zeros and were not recorded"


def _is_other_unit(fz: Floats, local: Floats, other: Floats, pose: Pose) -> bool:
    """Tell whether a centre of pressure is on the plate only in the unit of the corners.

    Args:
        fz: force, (n,).
        local: place in the unit that the file states.
        other: place in the unit of the corners. Where that is the smaller one, both are on the
            plate: one of them at its very middle.
        pose: of the plate.
    """
    off, off_other = (
        float(np.median(far)) if len(far := off_middle(place, fz, pose.half)) else 0.0
        for place in (local, other)
    )
    return off_other <= 1.0 and (off > OFF_PLATE or off_other > OFF_PLATE * off)


def _without_bending(
    file: C3dFile, i: int, local: Floats, length: str | None
) -> tuple[Floats, str]:
    """Correct the centre of pressure by the polynomial of the plate, if the file has one."""
    polynomial = _of_plate(file, "FPCOPPOLY", i, (_POLYNOMIAL,))
    if polynomial is None or not polynomial.any():
        return local, ""
    if length != "mm":
        return local, "FPCOPPOLY is not applied: its positions are not in mm"
    return correct_place(local, polynomial), "COP is corrected for bending (FPCOPPOLY)"


def _off_notes(local: Floats, fz: Floats, pose: Pose) -> Iterator[str]:
    off = off_middle(local, fz, pose.half)
    part = float((off > 1.0).mean()) if len(off) else 0.0
    if part > OFF_PART:
        yield (
            f"COP is off the plate in {part:.0%} of the samples under load: its moments, ORIGIN or "
            "CORNERS are not what the file states"
        )
    elif len(off) and float(np.quantile(off, 0.9)) < AT_MIDDLE:
        yield "COP does not leave the middle of the plate: its moments may be in another unit"


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
    """Return the calibration matrix of a plate of type 4.

    Raises:
        FileFormatError: there is none, or it is of another size.
    """
    stored = file.numbers("FORCE_PLATFORM", "CAL_MATRIX").astype(np.float64)
    stored = stored.reshape((*stored.shape, 1, 1, 1)[:3], order="F")
    is_by_row = "".join(file.texts("FORCE_PLATFORM", "MATRIX_STORE")).strip().upper() == "BYROW"
    if stored.shape[:2] != (6, 6) or i >= stored.shape[2] or not np.isfinite(stored[:, :, i]).all():
        raise FileFormatError(
            f"it is of type 4, with a CAL_MATRIX of {' by '.join(map(str, stored.shape))}",
            where=file.where,
            expected="a matrix of 6 by 6 for each plate",
        )
    return stored[:, :, i].T if is_by_row else stored[:, :, i]


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
