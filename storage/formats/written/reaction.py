"""What the ground does to the foot, at a constant rate, for formats of force and moment.

The foot frame: x forward, y to the left, z up the segment, origin at the ankle. A FootTile measures
forces along its axis: nothing is known of shear and of the free moment, and both are written as 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Times
from devices.errors import UsageError
from storage.formats.export import Export
from storage.formats.written.row_place import NEEDED as POINT
from storage.formats.written.row_place import with_row_place
from storage.formats.written.steady import Steady, axis_of, steady
from storage.formats.written.together import instants_of
from storage.schema import SERVER_TIME, Array

NEEDED = ("t_ns", "contact", *POINT)
"""Columns that are needed, and in every session with estimates."""
FURTHER = (
    *("grf_sigma_n", "grf_at_least_n", "cop_sigma_x_m", "cop_sigma_y_m"),
    *("cop_ground_x_m", "cop_ground_y_m", "angle_rad"),
)
"""Columns that a session may have."""
FLAGS = ("contact", "estimate_status", "grf_at_least_n")
"""Columns of which nothing lies between two frames."""
SERVER_NAMES = [column.name for column in SERVER_TIME]
STRIKE, OFF = "Foot Strike", "Foot Off"
"""As the C3D manual calls them."""


@dataclass(frozen=True)
class Reaction:
    """A session, or a slice of it, at a constant rate; n samples of m frames.

    Attributes:
        steady: between which frames each sample is.
        columns: flat columns, (m,) each; the centre of pressure `with_row_place`.
        events: seconds after the first sample, and label: of marks, and then of contacts that
            were seen to begin and to end.
        marks: how many of them are marks.
    """

    steady: Steady
    columns: Mapping[str, Array]
    events: Sequence[tuple[float, str]]
    marks: int

    def at(self, name: str) -> Floats:
        """A column at the samples, (n,); NaN where it is not known, or there are no frames."""
        column = self.columns[name]
        if name in FLAGS:
            return self.steady.nearest(column)
        return self.steady.between(column.astype(np.float64))

    @property
    def uncertainty_s(self) -> Floats | None:
        """(n,), bound of the server's time of its frames; None: it is the node's own time."""
        name = "t_server_uncertainty_ns"
        return self.steady.nearest(self.columns[name]) * 1e-9 if name in self.columns else None

    @property
    def is_unloaded(self) -> npt.NDArray[np.bool_]:
        """(m,), is it known that the foot bears nothing in a frame?"""
        return np.asarray(self.columns["contact"] == 0)

    @property
    def grf_n(self) -> Floats:
        """(m,), 0 where it is known that there is no contact."""
        return np.where(self.is_unloaded, 0.0, self.columns["grf_n"].astype(np.float64))


def reaction_of(export: Export, further: Sequence[str], frames_max: int) -> Reaction:
    """Read the frames of an export, and put them at a constant rate.

    Args:
        export: of a session with estimates.
        further: columns that are wanted besides, where the session has them.
        frames_max: more frames, or samples, are refused.

    Raises:
        UsageError: as for `Export.whole` and `axis_of`; there is no frame, or none has a force.
    """
    (found,) = reactions_of([export], further, frames_max)
    return found


def reactions_of(
    exports: Sequence[Export], further: Sequence[str], frames_max: int
) -> list[Reaction]:
    """The same of several, on one axis of time.

    Raises:
        UsageError: as for `reaction_of`, of any of them.
    """
    read = [_frames(export, further, frames_max) for export in exports]
    streams = [
        (t_ns, export.info.nominal_rate_hz) for (t_ns, _), export in zip(read, exports, strict=True)
    ]
    axis = axis_of(streams, frames_max)
    found = []
    for t_ns, columns in read:
        since_s = (t_ns - axis.begin_ns).astype(np.float64) * 1e-9
        marked = _marks(columns, since_s)
        events = [*marked, *_contacts(columns, since_s)]
        placed = steady(axis, t_ns, columns["seq"], columns.get("part"))
        found.append(Reaction(placed, columns, events, len(marked)))
    return found


def _frames(
    export: Export, further: Sequence[str], frames_max: int
) -> tuple[Times, dict[str, Array]]:
    """Instants of the frames, on the clock that was asked for, and their columns."""
    present = set(export.content.names)
    names = [*NEEDED, *(name for name in further if name in present)]
    names += SERVER_NAMES if export.clock is not None else []
    names += ["event"] if export.marks is not None else []
    names += ["part"] if "part" in present else []
    columns = export.whole(list(dict.fromkeys(["seq", *names])), frames_max=frames_max)
    t_ns = instants_of(export, columns)
    if not len(t_ns):
        raise UsageError(
            "no frame is in this slice",
            where=export.called,
            expected="a slice with frames, as this format needs them",
        )
    if not np.isfinite(columns["grf_n"]).any():
        raise UsageError(
            f"none of its {len(t_ns)} frames has a force (estimate_status {_bits(columns)})",
            where=export.called,
            remedy="Ask for Parquet, Arrow or CSV: they have counts and bounds",
        )
    return t_ns, with_row_place(columns, export.info)


def _marks(columns: Mapping[str, Array], since_s: Floats) -> list[tuple[float, str]]:
    labels = columns.get("event")
    if labels is None:
        return []
    return [(float(since_s[i]), labels[i]) for i in range(len(labels)) if labels[i] is not None]


def _contacts(columns: Mapping[str, Array], since_s: Floats) -> list[tuple[float, str]]:
    """Where contact begins and ends, the frame before being there and known."""
    contact, seq = columns["contact"], columns["seq"]
    follows = seq[1:] == seq[:-1] + 1
    if "part" in columns:
        follows &= columns["part"][1:] == columns["part"][:-1]
    begun = np.flatnonzero(follows & (contact[:-1] == 0) & (contact[1:] == 1)) + 1
    ended = np.flatnonzero(follows & (contact[:-1] == 1) & (contact[1:] == 0)) + 1
    events = [(float(since_s[i]), STRIKE) for i in begun]
    events += [(float(since_s[i]), OFF) for i in ended]
    return sorted(events)


def _bits(columns: Mapping[str, Array]) -> int:
    return int(np.bitwise_or.reduce(columns["estimate_status"]))
