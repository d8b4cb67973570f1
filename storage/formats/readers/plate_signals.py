"""Signals of force plates and load cells, and the force and COP of a plate from its channels.

Plate types: C3D user guide, FORCE_PLATFORM:TYPE.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from devices.arrays import Floats
from storage.formats.readers.table import SOLE_FRACTION, SOLE_UNITS, ForceTable


@dataclass(frozen=True)
class PlateSignals:
    """Signals of one plate or sole in the units of the file; n samples.

    Attributes:
        name: prefix of its columns, such as `plate1` or `left`: `plate1_fz`, `plate1_cop_x`.
        fz: (n,), force along the plate's normal.
        cop: (2, n), centre of pressure, NaN where unknown; None if the file has none. Its values
            without load are ignored.
        force_unit: unit of the force; None if the file does not state it.
        length_unit: unit of the centre of pressure, or `SOLE_FRACTION`; None if the file does not
            state it.
        is_positive_under_load: True if the force is positive under load; else the load tells its
            sign.
        notes: remarks for the user.
    """

    name: str
    fz: Floats
    cop: Floats | None
    force_unit: str | None
    length_unit: str | None
    is_positive_under_load: bool = False
    notes: tuple[str, ...] = ()


def make_table_of_separate_plates(
    where: str, time_s: Floats, plates: Sequence[PlateSignals], notes: Sequence[str] = ()
) -> ForceTable:
    """Return a table of plates; a single plate with units gets the standard names as well."""
    columns: dict[str, Floats] = {}
    units = {"time_s": "s"}
    all_notes = [*notes]
    for plate in plates:
        all_notes += [f"{plate.name}: {note}" for note in plate.notes]
        columns[f"{plate.name}_fz"] = plate.fz
        if plate.force_unit is not None:
            units[f"{plate.name}_fz"] = plate.force_unit
        for axis, cop, part in zip(
            "xy", () if plate.cop is None else plate.cop, SOLE_UNITS, strict=False
        ):
            columns[f"{plate.name}_cop_{axis}"] = np.where(plate.fz == 0.0, np.nan, cop)
            if plate.length_unit is not None:
                units[f"{plate.name}_cop_{axis}"] = (
                    part if plate.length_unit == SOLE_FRACTION else plate.length_unit
                )
    positive = {f"{plate.name}_fz" for plate in plates if plate.is_positive_under_load}
    signed_by_load = {f"{plate.name}_fz" for plate in plates if not plate.is_positive_under_load}
    if len(plates) == 1:
        (plate,) = plates
        for ours, theirs in (("grf_n", "fz"), ("cop_x_m", "cop_x"), ("cop_y_m", "cop_y")):
            found = f"{plate.name}_{theirs}"
            if found in units and units[found] not in SOLE_UNITS:
                columns[ours], units[ours] = columns[found], units[found]
        (positive if plate.is_positive_under_load else signed_by_load).add("grf_n")
    else:
        names = ", ".join(plate.name for plate in plates)
        all_notes.append(f"there are {len(plates)} plates or soles ({names}): --map says which one")
    columns["time_s"] = time_s
    return ForceTable(
        where,
        tuple(columns),
        columns,
        units,
        positive_forces=frozenset(positive),
        plate_forces=frozenset(signed_by_load),
        notes=tuple(all_notes),
    )


LOADED_FRACTION = 0.2
"""Load threshold of a plate relative to its peak force."""
FLAT_COS_MIN = 0.9999
"""Cosine of the largest tilt of a flat plate against an axis of the laboratory, 0.8 degrees."""


@dataclass(frozen=True)
class PlatePose:
    """Position, orientation and size of a plate in the laboratory.

    Attributes:
        centre: (3,), centre of its surface.
        axes: (3, 3), its x, y and z axes as columns.
        half_size: (2,), half its lengths along x and y.
    """

    centre: Floats
    axes: Floats
    half_size: Floats


def compute_plate_pose(corners: Floats | None) -> PlatePose | None:
    """Return the pose for corners (3, 4); None if they are missing or degenerate."""
    if corners is None:
        return None
    x = corners[:, 0] + corners[:, 3] - corners[:, 1] - corners[:, 2]
    y = corners[:, 0] + corners[:, 1] - corners[:, 2] - corners[:, 3]
    z = np.cross(x, y)
    if not np.linalg.norm(z) > 0.0:
        return None
    half = 0.25 * np.array([np.linalg.norm(x), np.linalg.norm(y)])
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return PlatePose(corners.mean(axis=1), np.stack([x, np.cross(z, x), z], axis=1), half)


class PlateForce(NamedTuple):
    """Force on a plate, in the file's units."""

    fz: Floats
    """(n,), along the plate's z."""
    cop: Floats | None
    """(2, n), from the middle; None: type 3 without the places of its sensors in the origin."""


def compute_fz_and_local_cop(
    plate_type: int, channels: Floats, origin: Floats, length_factor: float = 1.0
) -> PlateForce:
    """Return the force along z and the centre of pressure from the middle.

    Args:
        plate_type: type of the plate.
        channels: channels of this type.
        origin: (3,), from the plate's origin to the middle of its surface, in the plate's axes.
        length_factor: factor from the channels' length unit to the unit of the origin.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if plate_type == 1:
            return PlateForce(channels[2], length_factor * channels[3:5])
        if plate_type == 3:  # four sensors: Fx12 Fx34 Fy14 Fy23 Fz1 Fz2 Fz3 Fz4
            fx, fy = channels[0] + channels[1], channels[2] + channels[3]
            one, two, three, four = channels[4:8]
            fz = one + two + three + four
            if not (origin[0] > 0.0 and origin[1] > 0.0):
                return PlateForce(fz, None)
            mx = origin[1] * (one + two - three - four)
            my = origin[0] * (-one + two + three - four)
            origin = np.array([0.0, 0.0, origin[2]])
        else:
            fx, fy, fz, mx, my = channels[:5]
            mx, my = length_factor * mx, length_factor * my
        # Moments about the middle of the surface: M + F x origin.
        mx = mx + fy * origin[2] - fz * origin[1]
        my = my + fz * origin[0] - fx * origin[2]
        place = np.stack([-my, mx]) / fz
    place[:, ~np.isfinite(place).all(axis=0)] = np.nan
    return PlateForce(fz, place)


def correct_cop_for_bending(cop_mm: Floats, polynomial: Floats) -> Floats:
    """Return the centre of pressure in mm, corrected for bending of a plate with four sensors.

    Args:
        cop_mm: (2, n), centre of pressure from the middle, in mm.
        polynomial: (12,), Kistler's six coefficients for x, then for y (FPCOPPOLY).
    """
    x, y = cop_mm
    with np.errstate(over="ignore", invalid="ignore"):
        added = [
            (p[0] * v**4 + p[1] * v**2 + p[2]) * u**3 + (p[3] * v**4 + p[4] * v**2 + p[5]) * u
            for u, v, p in ((x, y, polynomial[:6]), (y, x, polynomial[6:]))
        ]
        return np.asarray(cop_mm - np.stack(added))


def compute_loaded_eccentricity(cop: Floats, fz: Floats, half_size: Floats) -> Floats:
    """Return the relative distance from the middle of each centre of pressure under load.

    1 is the edge of the plate; `half` is half its lengths along x and y.
    """
    size = np.where(np.isfinite(cop).all(axis=0) & np.isfinite(fz), np.abs(fz), 0.0)
    loaded = size > LOADED_FRACTION * np.max(size, initial=0.0)
    return np.asarray(np.max(np.abs(cop[:, loaded]) / half_size[:, None], axis=0))


class PlacedCop(NamedTuple):
    """Centre of pressure along axes of the laboratory."""

    cop: Floats
    """(2, n), in the unit of the pose."""
    note: str
    """Remark about the axes; empty if z is up and the plate lies flat."""


def transform_cop_to_laboratory(cop: Floats, pose: PlatePose) -> PlacedCop:
    """Return a centre of pressure from the laboratory's origin, in the plate's plane."""
    normal, notes = -pose.axes[:, 2], []
    axis = int(np.argmax(np.abs(normal)))
    if axis == 2 and normal[2] < 0.0:
        # A plate never faces down: its corners are listed in reverse order.
        normal = -normal
        notes.append("its CORNERS run counterclockwise: it is taken to face up")
    at = pose.centre[:, None] + pose.axes[:, :2] @ cop
    up = np.zeros(3)
    up[axis] = np.sign(normal[axis])
    cos = float(up @ normal)
    # Axes of the laboratory that become x and y if `up` is rotated to z by the smallest angle.
    to_z = _smallest_rotation(up, np.array([0.0, 0.0, 1.0]))
    turn = np.eye(3) if cos > FLAT_COS_MIN else _smallest_rotation(normal, up)
    if axis != 2:
        names = ("x", "y", "z")
        first, second = (
            ("" if row.sum() > 0.0 else "-") + names[int(np.argmax(np.abs(row)))]
            for row in to_z[:2]
        )
        name = ("" if up[axis] > 0.0 else "-") + names[axis]
        notes.append(
            f"its normal is {name} of the laboratory: COP is along {first} and {second} of it"
        )
    if cos <= FLAT_COS_MIN:
        notes.append(
            f"it is tilted by {np.degrees(np.arccos(min(1.0, cos))):.1f} degrees: force is along "
            "its normal, and COP in its plane"
        )
    return PlacedCop((to_z @ turn @ at)[:2], "; ".join(notes))


def _smallest_rotation(begin: Floats, end: Floats) -> Floats:
    """Return the rotation by the smallest angle from one unit vector to another."""
    v = np.cross(begin, end)
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + float(begin @ end)))
