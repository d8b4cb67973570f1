"""Force plate of a motion laboratory: its pose, and force and centre of pressure from its channels.

Plate types: C3D user guide, FORCE_PLATFORM:TYPE.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from devices.arrays import Floats

LOADED_FRACTION = 0.2
"""Load threshold of a plate relative to its peak force."""
WRONG_UNIT_ECCENTRICITY = 5.0
"""Distance from the middle, relative to the edge, that means a wrong unit, not a wrong ORIGIN."""
OFF_PLATE_FRACTION = 0.05
"""Fraction of loaded samples off the plate from which a note is added."""
CENTRED_ECCENTRICITY = 2e-3
"""Distance from the middle, relative to the edge, that a foot's centre of pressure exceeds."""
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
    return PlateForce(fz, compute_cop_from_moments(fz, mx, my))


def compute_cop_from_moments(fz: Floats, mx: Floats, my: Floats) -> Floats:
    """Return the centre of pressure (2, n) in the plane of the moments' origin, or NaN."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        cop = np.stack([-my, mx]) / fz
    cop[:, ~np.isfinite(cop).all(axis=0)] = np.nan
    return cop


def correct_cop_for_bending(
    cop: Floats, polynomial: Floats | None, unit: str | None
) -> tuple[Floats, str]:
    """Correct a centre of pressure for bending of a plate with four sensors; return a note as well.

    Args:
        cop: (2, n), centre of pressure from the middle; it stays as it is unless in mm.
        polynomial: (12,), Kistler's six coefficients for x, then for y (FPCOPPOLY), if any.
        unit: unit of the centre of pressure.
    """
    if polynomial is None or not polynomial.any():
        return cop, ""
    if unit != "mm":
        return cop, "FPCOPPOLY is not applied: its positions are not in mm"
    x, y = cop
    with np.errstate(over="ignore", invalid="ignore"):
        added = [
            (p[0] * v**4 + p[1] * v**2 + p[2]) * u**3 + (p[3] * v**4 + p[4] * v**2 + p[5]) * u
            for u, v, p in ((x, y, polynomial[:6]), (y, x, polynomial[6:]))
        ]
    return cop - np.stack(added), "COP is corrected for bending (FPCOPPOLY)"


def _compute_loaded_eccentricity(cop: Floats, fz: Floats, half_size: Floats) -> Floats:
    """Return the relative distance from the middle of each centre of pressure under load.

    1 is the edge of the plate; `half_size` is half its lengths along x and y.
    """
    size = np.where(np.isfinite(cop).all(axis=0) & np.isfinite(fz), np.abs(fz), 0.0)
    loaded = size > LOADED_FRACTION * np.max(size, initial=0.0)
    return np.asarray(np.max(np.abs(cop[:, loaded]) / half_size[:, None], axis=0))


def is_cop_in_corner_unit(
    fz: Floats, stated_cop: Floats, corner_cop: Floats, pose: PlatePose
) -> bool:
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
        if len(far := _compute_loaded_eccentricity(place, fz, pose.half_size))
        else 0.0
        for place in (stated_cop, corner_cop)
    )
    return off_other <= 1.0 and (
        off > WRONG_UNIT_ECCENTRICITY or off_other > WRONG_UNIT_ECCENTRICITY * off
    )


def describe_implausible_cop(local: Floats, fz: Floats, pose: PlatePose) -> Iterator[str]:
    """Yield notes about a centre of pressure, from the middle, that the plate cannot have."""
    off = _compute_loaded_eccentricity(local, fz, pose.half_size)
    part = float((off > 1.0).mean()) if len(off) else 0.0
    if part > OFF_PLATE_FRACTION:
        yield (
            f"COP is off the plate in {part:.0%} of the samples under load: its moments, ORIGIN or "
            "CORNERS are not what the file states"
        )
    elif len(off) and float(np.quantile(off, 0.9)) < CENTRED_ECCENTRICITY:
        yield "COP does not leave the middle of the plate: its moments may be in another unit"


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
