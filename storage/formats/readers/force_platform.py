"""Reader of force platforms of a C3D file, types 1 to 4.

A platform's z axis points down, into it (C3D user guide, FORCE_PLATFORM). `plate1_fz` is the force
along z as stored: in some files the positive force of the foot on the plate, in most the negative
force of the plate on the foot. `storage.formats.reference` infers the sign from the load. The
offset without load is not subtracted.

Centres of pressure are in the plane of the plate, from the origin of the laboratory. If the
laboratory has z up and the plate lies flat, they are its x and y. If another axis points up, or the
plate is tilted, the laboratory is rotated by the smallest angle until z is the plate's normal.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.formats.readers.c3d import C3dFile, read_c3d
from storage.formats.readers.plate_signals import (
    PlatePose,
    PlateSignals,
    compute_fz_and_local_cop,
    compute_loaded_eccentricity,
    compute_plate_pose,
    correct_cop_for_bending,
    make_table_of_separate_plates,
    transform_cop_to_laboratory,
)
from storage.formats.readers.table import ForceTable, check_table_size

FORM = "force platforms of types 1 to 4"
_CHANNEL_COUNTS = {1: 6, 2: 6, 3: 8, 4: 6}
"""Number of channels by type."""
_VERTICAL_FORCE_CHANNELS = {1: range(2, 3), 2: range(2, 3), 3: range(4, 8)}
"""Channels of vertical forces by type. Channels of type 4 have any unit, such as volts: the file
does not state the unit of the forces that its matrix computes."""
_POLYNOMIAL_COEFFICIENTS = 12
"""Number of coefficients of a plate's FPCOPPOLY."""
UNSIGNED_OFFSET_MIN = 1000.0
"""Lowest OFFSET of unsigned samples, for which a stored zero means that nothing was recorded."""
WRONG_UNIT_ECCENTRICITY = 5.0
"""Distance from the middle, relative to the edge, that means a wrong unit, not a wrong ORIGIN."""
OFF_PLATE_FRACTION = 0.05
"""Fraction of loaded samples off the plate from which a note is added."""
CHECKED_PEAK_FORCE_N = 10.0
"""Lowest peak force of a plate whose centre of pressure is checked."""
CENTRED_ECCENTRICITY = 2e-3
"""Distance from the middle, relative to the edge, that a foot's centre of pressure exceeds."""
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_FORCE_UNITS = {"n": "N", "newton": "N", "newtons": "N", "kn": "kN"}
_MOMENT = re.compile(r"(k?N)[ .*·-]?(mm|cm|m)", re.IGNORECASE)


def read_c3d_force_platforms(path: Path, values_max: int) -> ForceTable:
    """Read force and centre of pressure of each readable plate of a C3D file, at the analog rate.

    Columns are `plate1_fz`, `plate1_cop_x`, `plate1_cop_y` and so on, in the file's units. A
    single plate has the names `grf_n`, `cop_x_m` and `cop_y_m` as well, if the file states units.

    Raises:
        FileFormatError: the file cannot be read, or has no readable plate.
    """
    file = read_c3d(path)
    count = min(int(file.get_numbers_or_empty("FORCE_PLATFORM", "USED").sum()), 255)
    if count == 0:
        raise FileFormatError(
            "there is no force platform in it",
            where=file.where,
            expected="FORCE_PLATFORM:USED of 1",
        )
    if not (np.isfinite(file.rate_hz) and file.rate_hz > 0.0):
        raise FileFormatError(f"ANALOG:RATE is {file.rate_hz:g}", where=file.where)
    plates: list[PlateSignals] = []
    notes = [*file.notes]
    refusal: FileFormatError | None = None
    for number in range(1, count + 1):
        try:
            plates.append(_read_plate(file, number - 1, values_max))
        except FileFormatError as error:
            notes.append(f"plate {number} is not read: {error.what}")
            refusal = refusal or error
    if refusal is not None and not plates:
        raise refusal
    time_s = np.arange(len(plates[0].fz)) / file.rate_hz
    return make_table_of_separate_plates(
        file.where, time_s, plates, [*notes, *_zero_notes(file, plates)]
    )


def _zero_notes(file: C3dFile, plates: list[PlateSignals]) -> list[str]:
    zero = [int(frame) for frame in np.ravel(file.get_numbers_or_empty("FORCE_PLATFORM", "ZERO"))]
    if len(zero) != 2 or not 1 <= zero[0] <= zero[1]:
        return []
    first, last = zero
    window = slice((first - 1) * file.samples_per_frame, last * file.samples_per_frame)
    read = [plate.fz[window] for plate in plates]
    means = ", ".join(f"{fz.mean():.3f}" for fz in read if len(fz))
    return [
        f"ZERO states frames {first} to {last}, in which plates read {means}: no offset is "
        "subtracted"
    ]


def _read_plate(file: C3dFile, i: int, values_max: int) -> PlateSignals:
    """Compute a plate's force and centre of pressure.

    Raises:
        FileFormatError: the type is not supported, or channels are missing.
    """
    kinds = np.ravel(file.get_numbers_or_empty("FORCE_PLATFORM", "TYPE")).astype(int)
    kind = int(kinds[i]) if i < len(kinds) else 0
    if kind not in _CHANNEL_COUNTS:
        raise FileFormatError(f"it is of type {kind}", where=file.where, expected=FORM)
    table = file.get_numbers_or_empty("FORCE_PLATFORM", "CHANNEL")
    table = table.reshape(len(table), table.size // max(len(table), 1))
    numbers = (table[: _CHANNEL_COUNTS[kind], i : i + 1].astype(int) % 65536).ravel().tolist()
    if len(numbers) < _CHANNEL_COUNTS[kind] or not all(
        0 < n <= file.channel_count for n in numbers
    ):
        raise FileFormatError(
            f"it has the channels {', '.join(map(str, numbers)) or 'of nothing'}",
            where=file.where,
            expected=f"{_CHANNEL_COUNTS[kind]} of the {file.channel_count} channels of the C3D "
            "file",
        )
    check_table_size(len(file.raw), len(numbers), values_max, file.where)
    channels = file.get_scaled_samples_by_channel([n - 1 for n in numbers])
    notes = [*_mask_unrecorded_samples(file, numbers, channels)]
    stated = file.get_channel_texts("UNITS")
    units = [stated[n - 1].strip() for n in numbers]
    force = _common_unit(
        {_FORCE_UNITS.get(units[at].lower()) for at in _VERTICAL_FORCE_CHANNELS.get(kind, ())}
    )
    position = next(iter(file.get_texts_or_empty("POINT", "UNITS")), "").strip().lower()
    length = position if position in _METRES else None
    origin, pose = (
        _surface_centre(file, i, kind),
        compute_plate_pose(_plate_parameter(file, "CORNERS", i, (3, 4))),
    )
    factor = 1.0
    if kind == 4:
        channels = _calibration_matrix(file, i) @ channels
    elif kind in (1, 2) and length is not None:
        # Convert levers to the unit of positions and corners.
        lever = _common_unit(
            {_length_unit_of(unit, force if kind == 2 else None) for unit in units[3:5]}
        )
        factor = 1.0 if lever is None else _METRES[lever] / _METRES[length]
        length = None if lever is None else length
    fz, local = compute_fz_and_local_cop(kind, channels, origin, factor)
    cop = None
    if local is None:
        notes.append("ORIGIN does not state where its sensors are: no centre of pressure")
    elif pose is None:
        notes.append("CORNERS do not state where it is: no centre of pressure")
    else:
        _, other = compute_fz_and_local_cop(kind, channels, origin)
        if factor != 1.0 and other is not None and _is_in_corner_unit(fz, local, other, pose):
            local = other
            notes.append(
                f"its {'moments' if kind == 2 else 'places'} are not in {units[3]}, as the file "
                f"states, but in the unit of its corners, {length}: else they were off the plate"
            )
        if kind == 3:
            local, note = _correct_bending(file, i, local, length)
            notes.append(note)
        if not (
            force == "N" and np.max(np.abs(fz[np.isfinite(fz)]), initial=0.0) < CHECKED_PEAK_FORCE_N
        ):
            notes += _eccentricity_notes(local, fz, pose)
        cop, note = transform_cop_to_laboratory(local, pose)
        notes.append(note)
    return PlateSignals(f"plate{i + 1}", fz, cop, force, length, notes=tuple(filter(None, notes)))


def _mask_unrecorded_samples(file: C3dFile, numbers: list[int], channels: Floats) -> Iterator[str]:
    """Set samples to NaN that were not recorded: zero in all channels although OFFSET is not."""
    filled = ~file.raw[:, [n - 1 for n in numbers]].any(axis=1)
    offsets = file.get_channel_offsets()[[n - 1 for n in numbers]]
    if filled.any() and np.abs(offsets).max() >= UNSIGNED_OFFSET_MIN:
        channels[:, filled] = np.nan
        yield f"{int(filled.sum())} of its samples are stored as zeros and were not recorded"


def _is_in_corner_unit(fz: Floats, stated_cop: Floats, corner_cop: Floats, pose: PlatePose) -> bool:
    """Return whether the centre of pressure is on the plate only in the unit of the corners.

    Args:
        fz: force, (n,).
        stated_cop: centre of pressure in the unit that the file states.
        corner_cop: centre of pressure in the unit of the corners. If this unit is the smaller one,
            both are on the plate, one very near to its middle.
        pose: pose of the plate.
    """
    off, off_other = (
        float(np.median(far))
        if len(far := compute_loaded_eccentricity(place, fz, pose.half_size))
        else 0.0
        for place in (stated_cop, corner_cop)
    )
    return off_other <= 1.0 and (
        off > WRONG_UNIT_ECCENTRICITY or off_other > WRONG_UNIT_ECCENTRICITY * off
    )


def _correct_bending(
    file: C3dFile, i: int, local: Floats, length: str | None
) -> tuple[Floats, str]:
    """Correct the centre of pressure by the plate's polynomial, if any; return a note as well."""
    polynomial = _plate_parameter(file, "FPCOPPOLY", i, (_POLYNOMIAL_COEFFICIENTS,))
    if polynomial is None or not polynomial.any():
        return local, ""
    if length != "mm":
        return local, "FPCOPPOLY is not applied: its positions are not in mm"
    return correct_cop_for_bending(local, polynomial), "COP is corrected for bending (FPCOPPOLY)"


def _eccentricity_notes(local: Floats, fz: Floats, pose: PlatePose) -> Iterator[str]:
    off = compute_loaded_eccentricity(local, fz, pose.half_size)
    part = float((off > 1.0).mean()) if len(off) else 0.0
    if part > OFF_PLATE_FRACTION:
        yield (
            f"COP is off the plate in {part:.0%} of the samples under load: its moments, ORIGIN or "
            "CORNERS are not what the file states"
        )
    elif len(off) and float(np.quantile(off, 0.9)) < CENTRED_ECCENTRICITY:
        yield "COP does not leave the middle of the plate: its moments may be in another unit"


def _common_unit(units: set[str | None]) -> str | None:
    """Return the only unit of a set; None if units differ or one is missing."""
    return units.pop() if len(units) == 1 else None


def _length_unit_of(unit: str, force: str | None) -> str | None:
    """Return the length unit of a moment's or a length's unit; None for another unit."""
    if force is None:
        return unit.lower() if unit.lower() in _METRES else None
    match = _MOMENT.fullmatch(unit)
    return match[2].lower() if match and match[1].lower() == force.lower() else None


def _calibration_matrix(file: C3dFile, i: int) -> Floats:
    """Return the calibration matrix of a plate of type 4.

    Raises:
        FileFormatError: the matrix is missing, or has another size.
    """
    stored = file.get_numbers_or_empty("FORCE_PLATFORM", "CAL_MATRIX").astype(np.float64)
    stored = stored.reshape((*stored.shape, 1, 1, 1)[:3], order="F")
    is_by_row = (
        "".join(file.get_texts_or_empty("FORCE_PLATFORM", "MATRIX_STORE")).strip().upper()
        == "BYROW"
    )
    if stored.shape[:2] != (6, 6) or i >= stored.shape[2] or not np.isfinite(stored[:, :, i]).all():
        raise FileFormatError(
            f"it is of type 4, with a CAL_MATRIX of {' by '.join(map(str, stored.shape))}",
            where=file.where,
            expected="a matrix of 6 by 6 for each plate",
        )
    return stored[:, :, i].T if is_by_row else stored[:, :, i]


def _plate_parameter(file: C3dFile, name: str, i: int, shape: tuple[int, ...]) -> Floats | None:
    """Return a plate's values of a parameter; None if they are missing."""
    value = file.get_numbers_or_empty("FORCE_PLATFORM", name).astype(np.float64)
    size = int(np.prod(shape))
    flat = np.ravel(value, order="F")[i * size : (i + 1) * size]
    if len(flat) < size or not np.isfinite(flat).all():
        return None
    return flat.reshape(shape, order="F")


def _surface_centre(file: C3dFile, i: int, kind: int) -> Floats:
    """Return the centre of the surface in the plate's axes; zero if it is not stated.

    z points down and the surface lies above the origin, so its z is negative. Some programs store
    the vector from the centre to the origin. For type 3, x and y are distances from sensor to axis,
    whose sign has no meaning.
    """
    origin = _plate_parameter(file, "ORIGIN", i, (3,))
    if origin is None:
        return np.zeros(3)
    if kind == 3:
        return np.array([abs(origin[0]), abs(origin[1]), -abs(origin[2])])
    return -origin if origin[2] > 0.0 else origin
