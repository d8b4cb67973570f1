"""What acts on a foot at each row of a `.mot` file, and what was filled in it.

OpenSim's axes: x forward, y up, z to the right. Points are in the ground's frame where the session
knows it; else force and point are in that of the foot, as a body of the model, which moves them.
Of several feet each has a ground of its own under its ankle, and none knows where the others
are: there all are in the frames of their bodies.

A `.mot` file has no number for what is not known. So that nobody takes what was put there for a
measurement, every stretch of it is in a table.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.arrays import Floats
from devices.errors import UsageError
from storage.formats.export import Export
from storage.formats.written.reaction import Reaction
from storage.formats.written.row_place import COP

LINE_S = 0.02
"""A GRF that is not known for longer is 0, and not on a line between what is known."""

COLUMNS = (
    *(f"ground_force_v{axis}" for axis in "xyz"),
    *(f"ground_force_p{axis}" for axis in "xyz"),
    *(f"ground_torque_{axis}" for axis in "xyz"),
)
"""Of one foot, behind `time`."""
GROUND_X = "cop_ground_x_m"
"""The foot rolls about its y: along that axis both frames have the same coordinate."""


_WHY = {
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
_NOTHING = 0
_UNLOADED, _LINE, _ZERO, _LINE_EMPTY, _ZERO_EMPTY, _POINT = _WHY


@dataclass(frozen=True)
class Loads:
    """What acts on one foot in n rows of a `.mot` file, and what of them was filled.

    Attributes:
        time_s: (n,), since the first row.
        table: (n, 9), in the order of `COLUMNS`; no NaN.
        code: (n,), what was filled: a key of `_WHY`, or 0.
        status: (n,), `estimate_status`, NaN where there is no frame.
        frame: "ground" or "foot".
    """

    time_s: Floats
    table: Floats
    code: npt.NDArray[np.uint8]
    status: Floats
    frame: str

    def filled(self) -> pa.Table:
        """A row for each stretch: from, to, what, with what, why, and the flags there."""
        edges = np.flatnonzero(np.diff(self.code)) + 1
        begins, ends = np.append(0, edges), np.append(edges, len(self.code))
        kept = self.code[begins] != _NOTHING
        begins, ends = begins[kept], ends[kept]
        said = [_WHY[int(self.code[begin])] for begin in begins]
        flags = [_all_bits(self.status[a:b]) for a, b in zip(begins, ends, strict=True)]
        columns = {
            "from_s": self.time_s[begins],
            "to_s": self.time_s[ends - 1],
            "rows": ends - begins,
            "filled": [what for what, _, _ in said],
            "with": [how for _, how, _ in said],
            "because": [why for _, _, why in said],
            "estimate_status": flags,
        }
        types = [pa.float64(), pa.float64(), pa.int64(), *[pa.string()] * 3, pa.int64()]
        return pa.table(
            [
                pa.array(values, type_)
                for values, type_ in zip(columns.values(), types, strict=True)
            ],
            names=list(columns),
        )


def loads_of(found: Reaction, export: Export, *, is_alone: bool) -> Loads:
    """What acts on the foot, at each sample.

    Args:
        found: what was measured.
        export: its session.
        is_alone: is it the only foot?

    Raises:
        UsageError: no centre of pressure is stated in it.
    """
    places = [tile.z_m for tile in export.info.tiles if not tile.reference]
    points = [found.at(name) for name in COP]
    is_ground = False
    if is_alone and GROUND_X in found.columns:
        ground_x_m = found.at(GROUND_X)
        is_ground = bool(np.isfinite(ground_x_m).any())
        points[0] = ground_x_m if is_ground else points[0]
    stated = np.isfinite(points).all(axis=0)
    if not stated.any():
        raise UsageError(
            "no centre of pressure is stated in it, and a force without a point is no load",
            where=export.called,
            remedy="Ask for C3D, Parquet, Arrow or CSV",
        )
    contact = found.at("contact")
    unloaded = contact == 0.0
    known_n = found.steady.between(found.grf_n)
    known_n[unloaded] = 0.0
    known = np.isfinite(known_n)
    empty = ~found.steady.is_there
    time_s = found.steady.time_s
    force_n, bridged = _bridged(time_s, known_n, known)
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
    return Loads(
        time_s,
        np.stack(columns, axis=1),
        code,
        found.at("estimate_status"),
        "ground" if is_ground else "foot",
    )


def _bridged(
    time_s: Floats, force_n: Floats, known: npt.NDArray[np.bool_]
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Forces without NaN, and where they are on a line between two that are known."""
    at = np.flatnonzero(known)
    after = np.searchsorted(at, np.arange(len(time_s)))
    inside = (after > 0) & (after < len(at)) & ~known
    before_at, after_at = at[np.maximum(after - 1, 0)], at[np.minimum(after, len(at) - 1)]
    bridged = inside & (time_s[after_at] - time_s[before_at] <= LINE_S)
    line_n = np.interp(time_s, time_s[at], force_n[at])
    return np.where(known, force_n, np.where(bridged, line_n, 0.0)), bridged


def _all_bits(status: Floats) -> int | None:
    there = status[np.isfinite(status)].astype(np.int64)
    return int(np.bitwise_or.reduce(there)) if len(there) else None
