"""Loads on a foot at each row of a `.mot` file, with a record of filled stretches.

OpenSim's axes: x forward, y up, z to the right. Points are in the ground's frame if the session
has it; else force and point are in the frame of the foot's body, which moves them. The ground frame
of each foot lies under its ankle, and relative positions of feet are unknown: for several feet, all
are in the frames of their bodies.

A `.mot` file has no value for unknown numbers, so they are filled. A table lists every filled
stretch, to distinguish it from measured values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.arrays import Floats
from devices.errors import UsageError
from storage.formats.export import Export
from storage.formats.writers.ground_reaction import GroundReaction
from storage.formats.writers.row_place import COP

INTERPOLATED_MAX_S = 0.02
"""Longest interpolated stretch of unknown GRF; longer stretches are 0."""

LOAD_COLUMNS = (
    *(f"ground_force_v{axis}" for axis in "xyz"),
    *(f"ground_force_p{axis}" for axis in "xyz"),
    *(f"ground_torque_{axis}" for axis in "xyz"),
)
"""Columns of one foot, after `time`."""
GROUND_X = "cop_ground_x_m"
"""Ground x; the foot rolls about its y axis, so y is the same in both frames."""


_FILL_REASONS = {
    1: (
        "force and point",
        "force 0, point on a line between those before and behind",
        "no contact",
    ),
    2: ("force", "line between the forces before and behind", "GRF not known"),
    3: ("force", "0", "GRF not known"),
    4: ("force", "line between the forces before and behind", "no frame: lost or not taken"),
    5: ("force", "0", "no frame: lost or not taken"),
    6: ("point", "line between the points before and behind", "no centre of pressure stated"),
}
_NOT_FILLED = 0
_UNLOADED, _LINE, _ZERO, _LINE_EMPTY, _ZERO_EMPTY, _POINT = _FILL_REASONS


@dataclass(frozen=True)
class FootLoads:
    """Loads on one foot in n rows of a `.mot` file, with a code for filled rows.

    Attributes:
        time_s: (n,), times since the first row.
        table: (n, 9), loads in the order of `LOAD_COLUMNS`; no NaN.
        fill_code: (n,), reason for filling: a key of `_FILL_REASONS`; 0 if the row is not filled.
        estimate_flags: (n,), `estimate_flags`, NaN without a frame.
        frame: frame of forces and points, "ground" or "foot".
    """

    time_s: Floats
    table: Floats
    fill_code: npt.NDArray[np.uint8]
    estimate_flags: Floats
    frame: str

    def list_filled_stretches(self) -> pa.Table:
        """Return the table of filled stretches: from, to, what, by what, why, and flags."""
        edges = np.flatnonzero(np.diff(self.fill_code)) + 1
        begins, ends = np.append(0, edges), np.append(edges, len(self.fill_code))
        is_filled = self.fill_code[begins] != _NOT_FILLED
        begins, ends = begins[is_filled], ends[is_filled]
        reasons = [_FILL_REASONS[int(self.fill_code[begin])] for begin in begins]
        flags = [
            _combined_flags(self.estimate_flags[a:b]) for a, b in zip(begins, ends, strict=True)
        ]
        columns = {
            "from_s": self.time_s[begins],
            "to_s": self.time_s[ends - 1],
            "rows": ends - begins,
            "filled": [what for what, _, _ in reasons],
            "with": [how for _, how, _ in reasons],
            "because": [why for _, _, why in reasons],
            "estimate_flags": flags,
        }
        types = [pa.float64(), pa.float64(), pa.int64(), *[pa.string()] * 3, pa.int64()]
        return pa.table(
            [
                pa.array(values, type_)
                for values, type_ in zip(columns.values(), types, strict=True)
            ],
            names=list(columns),
        )


def compute_gapless_foot_loads(
    reaction: GroundReaction, export: Export, *, is_only_foot: bool
) -> FootLoads:
    """Compute the loads on the foot at each sample, with unknown numbers filled.

    Args:
        reaction: ground reaction of the session.
        export: export of the session.
        is_only_foot: True for a single foot; only then loads may be in the ground's frame.

    Raises:
        UsageError: no sample has a centre of pressure.
    """
    places = [tile.z_m for tile in export.array_info.tiles if not tile.reference]
    points = [reaction.resample_column(name) for name in COP]
    is_ground = False
    if is_only_foot and GROUND_X in reaction.columns:
        ground_x_m = reaction.resample_column(GROUND_X)
        is_ground = bool(np.isfinite(ground_x_m).any())
        points[0] = ground_x_m if is_ground else points[0]
    stated = np.isfinite(points).all(axis=0)
    if not stated.any():
        raise UsageError(
            "no centre of pressure is stated in it, and a force without a point is no load",
            where=export.display_name,
            remedy="Ask for C3D, Parquet, Arrow or CSV",
        )
    contact = reaction.resample_column("contact")
    unloaded = contact == 0.0
    known_n = reaction.resampling.interpolate(reaction.frame_contact_grf_n)
    known_n[unloaded] = 0.0
    known = np.isfinite(known_n)
    empty = ~reaction.resampling.has_frames
    time_s = reaction.resampling.elapsed_s
    force_n, bridged = _fill_force_gaps(time_s, known_n, known)
    at = np.flatnonzero(stated)
    x_m, left_m = (np.interp(time_s, time_s[at], values[at]) for values in points)
    code = np.zeros(len(time_s), dtype=np.uint8)
    code[~stated] = _POINT
    code[~known] = np.where(bridged, _LINE, _ZERO)[~known]
    code[empty] = np.where(bridged, _LINE_EMPTY, _ZERO_EMPTY)[empty]
    code[unloaded] = _UNLOADED
    nothing = np.zeros(len(time_s))
    up_m = nothing if is_ground else np.full(len(time_s), float(np.mean(places)))
    columns = [nothing, force_n, nothing, x_m, up_m, -left_m, nothing, nothing, nothing]
    return FootLoads(
        time_s,
        np.stack(columns, axis=1),
        code,
        reaction.resample_column("estimate_flags"),
        "ground" if is_ground else "foot",
    )


def _fill_force_gaps(
    time_s: Floats, force_n: Floats, known: npt.NDArray[np.bool_]
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return forces without NaN, and the mask of the interpolated samples."""
    at = np.flatnonzero(known)
    after = np.searchsorted(at, np.arange(len(time_s)))
    inside = (after > 0) & (after < len(at)) & ~known
    before_at, after_at = at[np.maximum(after - 1, 0)], at[np.minimum(after, len(at) - 1)]
    bridged = inside & (time_s[after_at] - time_s[before_at] <= INTERPOLATED_MAX_S)
    line_n = np.interp(time_s, time_s[at], force_n[at])
    return np.where(known, force_n, np.where(bridged, line_n, 0.0)), bridged


def _combined_flags(flags: Floats) -> int | None:
    there = flags[np.isfinite(flags)].astype(np.int64)
    return int(np.bitwise_or.reduce(there)) if len(there) else None
