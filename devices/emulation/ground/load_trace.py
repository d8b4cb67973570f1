"""Conversion of a recorded load to forces on an array of tiles.

A trace has either a force per tile, or a total force with its centre of pressure. The latter is
split into non-negative tile forces with this sum and moment and the least squares. The converted
forces are the ground truth, so moved and limited samples are counted; negative forces, which are
noise of plates, become zero.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from devices.arrays import Bools, Floats
from devices.errors import LoadTraceError, UsageError

FORCE_LIMIT_N = 120.0
"""Largest force on a tile, four times its rated load (paper III-A: 25 to 35 N). All parts saturate
below it and, of one in eight, the count wraps."""

TOUCH_S = 0.010
"""Ramp time for a trace that begins or ends under load."""

_COP_NEEDED_FROM = 0.01  # part of the largest force below which the COP may be missing
_NO_LOAD_N = 1e-12
_EXACT = 1e4  # weight of sum and moment against the squares: exact to 1e-8
_MOVED_M = 1e-6


@dataclass(frozen=True)
class LoadTrace:
    """Recorded load; all arrays have time as the first axis.

    Attributes:
        where: name of the file, for messages.
        time_s: strictly increasing.
        cells_n: (n, cells), force per tile; None if the trace has a total force.
        fz_n: (n,), total force; None if the trace has cells for the array.
        cop_m: (n, 2), centre of pressure in the trace's axes; NaN where undefined.
        angle_rad: (n,), segment angle; None if not recorded.
    """

    where: str
    time_s: Floats
    cells_n: Floats | None
    fz_n: Floats | None
    cop_m: Floats | None
    angle_rad: Floats | None


@dataclass(frozen=True)
class CopTransform:
    """Transform of a trace's COP: `scale` * (cop - c0) + `offset_m`.

    c0 is the trace's force-weighted mean COP. `axes` names the trace's axes that become x and y of
    the foot, with signs: "xy", "-yx".
    """

    scale: float = 1.0
    offset_m: tuple[float, float] = (0.0, 0.0)
    axes: str = "xy"

    def make_axes_matrix(self) -> Floats:
        """Return the matrix of the axes (rows: foot x and y; columns: trace x and y).

        Raises:
            UsageError: `axes` is not two different axes with optional signs.
        """
        match = re.fullmatch(r"([+-]?)([xy])([+-]?)([xy])", self.axes)
        if match is None or match[2] == match[4]:
            raise UsageError(
                f"--cop-axes {self.axes!r} does not name two different axes",
                expected="xy, yx, or one of these with signs such as -yx",
            )
        rows = np.zeros((2, 2))
        for row, (sign, axis) in enumerate(((match[1], match[2]), (match[3], match[4]))):
            rows[row, "xy".index(axis)] = -1.0 if sign == "-" else 1.0
        return rows


@dataclass(frozen=True)
class TileLoad:
    """Tile forces over time, converted from a trace, with counts of changed samples."""

    time_s: Floats
    forces_n: Floats
    angle_rad: Floats | None
    moved_samples: int
    """Number of samples whose COP lay outside the tiles' hull and was moved to its edge."""
    limited_samples: int
    """Number of samples with a tile force above `FORCE_LIMIT_N`, which was limited."""


def convert_to_tile_load(
    trace: LoadTrace,
    positions_m: Floats,
    bears_load: Bools,
    *,
    load_scale: float,
    cop_transform: CopTransform,
    lead_s: float,
) -> TileLoad:
    """Convert a trace to forces on tiles, beginning at `lead_s`.

    Args:
        trace: recorded load.
        positions_m: (tiles, 2), positions of the tiles.
        bears_load: (tiles,), False for bare reference tiles, which get no force.
        load_scale: factor on every force.
        cop_transform: transform of the trace's centre of pressure to the foot's.
        lead_s: seconds without load before it.

    Raises:
        LoadTraceError: the trace fits neither the number of tiles nor has force and COP.
        UsageError: the COP transform is malformed.
    """
    if trace.cells_n is not None:
        borne_n, moved = trace.cells_n * load_scale, 0
        if borne_n.shape[1] != bears_load.sum():
            raise LoadTraceError(
                f"the trace has {borne_n.shape[1]} cell columns, the array has "
                f"{bears_load.sum()} tiles that bear load",
                where=trace.where,
                remedy="Choose a scene with as many tiles, or remove the cell columns",
            )
    else:
        borne_n, moved = _distribute_force(
            trace, positions_m[bears_load], load_scale, cop_transform
        )
    limited = int((borne_n > FORCE_LIMIT_N).any(axis=1).sum())
    forces_n = np.zeros((len(borne_n), len(positions_m)))
    forces_n[:, bears_load] = np.clip(borne_n, 0.0, FORCE_LIMIT_N)

    begin_s = lead_s + TOUCH_S
    time_s = trace.time_s - trace.time_s[0] + begin_s
    rest = np.zeros((1, forces_n.shape[1]))
    return TileLoad(
        time_s=np.concatenate([[lead_s], time_s, [time_s[-1] + TOUCH_S]]),
        forces_n=np.concatenate([rest, forces_n, rest]),
        angle_rad=None
        if trace.angle_rad is None
        else np.pad(trace.angle_rad, 1, mode="edge").astype(np.float64),
        moved_samples=moved,
        limited_samples=limited,
    )


def _distribute_force(
    trace: LoadTrace, positions_m: Floats, load_scale: float, cop: CopTransform
) -> tuple[Floats, int]:
    if trace.fz_n is None or trace.cop_m is None:
        raise LoadTraceError(
            "no load in the trace",
            where=trace.where,
            expected="fz_n with cop_x_m and cop_y_m, or one cellN_n column per tile",
        )
    fz_n = np.maximum(trace.fz_n, 0.0)
    defined = ~np.isnan(trace.cop_m[:, 0] + trace.cop_m[:, 1])
    loaded = np.abs(trace.fz_n) >= max(_COP_NEEDED_FROM * np.abs(trace.fz_n).max(), _NO_LOAD_N)
    missing = ~defined & loaded
    if missing.any():
        row = int(np.flatnonzero(missing)[0])
        raise LoadTraceError(
            f"row {row + 1} has {trace.fz_n[row]:g} N but no centre of pressure",
            where=trace.where,
            expected="cop_x_m and cop_y_m wherever the load is above 1 % of its maximum",
        )
    weight = np.where(defined, fz_n, 0.0)
    if weight.sum() == 0.0:
        raise LoadTraceError("the trace never loads the foot", where=trace.where)
    centre_m = (weight[:, None] * np.where(defined[:, None], trace.cop_m, 0.0)).sum(
        0
    ) / weight.sum()
    cop_m = np.where(defined[:, None], trace.cop_m - centre_m, 0.0)
    wanted_m = cop.scale * cop_m @ cop.make_axes_matrix().T + np.array(cop.offset_m)

    # A line array has one axis only; the other one is dropped.
    axes = np.ptp(positions_m, axis=0) > 1e-9
    shares = np.zeros((len(fz_n), len(positions_m)))
    moved = 0
    for row in np.flatnonzero(fz_n > 0.0).tolist():
        shares[row], was_moved = _compute_least_squares_shares(
            positions_m[:, axes], wanted_m[row, axes]
        )
        moved += was_moved
    return shares * (fz_n * load_scale)[:, None], moved


def _compute_least_squares_shares(positions_m: Floats, cop_m: Floats) -> tuple[Floats, bool]:
    """Compute non-negative shares of sum one with their centroid nearest to `cop_m`.

    Returns:
        The shares, and whether the centroid had to be moved.
    """
    from scipy.optimize import nnls

    tiles, axes = positions_m.shape
    scale_m = np.abs(positions_m).max() if axes else 1.0
    rows = np.vstack([np.ones(tiles), positions_m.T / scale_m])
    nearest, _ = nnls(np.vstack([_EXACT * rows[:1], rows[1:]]), np.append(_EXACT, cop_m / scale_m))
    reachable_m = positions_m.T @ nearest
    moved = bool(np.any(np.abs(reachable_m - cop_m) > _MOVED_M))
    shares, _ = nnls(
        np.vstack([_EXACT * rows, np.eye(tiles)]),
        np.concatenate([_EXACT * np.append(1.0, reachable_m / scale_m), np.zeros(tiles)]),
    )
    return shares, moved
