"""Ground reaction of a session at a constant rate, for formats of force and moment.

Foot frame: x forward, y to the left, z up the segment, origin at the ankle. Tiles measure forces
along their axis only: shear and the free moment are unknown, and written as 0.
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
"""Required columns, which every session with estimates has."""
FURTHER = (
    *("grf_sigma_n", "grf_at_least_n", "cop_sigma_x_m", "cop_sigma_y_m"),
    *("cop_ground_x_m", "cop_ground_y_m", "angle_rad"),
)
"""Optional columns of a session."""
FLAGS = ("contact", "estimate_status", "grf_at_least_n")
"""Columns that are not interpolated between two frames."""
SERVER_NAMES = [column.name for column in SERVER_TIME]
STRIKE, OFF = "Foot Strike", "Foot Off"
"""Labels of contact events, after the C3D manual."""


@dataclass(frozen=True)
class Reaction:
    """Ground reaction of a session or slice: m frames, resampled to n samples.

    Attributes:
        steady: resampling of frames to samples.
        columns: flat columns of frames, (m,) each; the COP `with_row_place`.
        events: time in seconds after the first sample, and label: first the markers, then begins
            and ends of contact.
        marks: number of markers among the events.
    """

    steady: Steady
    columns: Mapping[str, Array]
    events: Sequence[tuple[float, str]]
    marks: int

    def at(self, name: str) -> Floats:
        """Return a column at the samples, (n,); NaN where it is unknown or the sample is empty."""
        column = self.columns[name]
        if name in FLAGS:
            return self.steady.nearest(column)
        return self.steady.between(column.astype(np.float64))

    @property
    def uncertainty_s(self) -> Floats | None:
        """Bound (n,) of the error of the server's time, in s; None if times are the node's."""
        name = "t_server_uncertainty_ns"
        return self.steady.nearest(self.columns[name]) * 1e-9 if name in self.columns else None

    @property
    def is_unloaded(self) -> npt.NDArray[np.bool_]:
        """Mask (m,) of the frames known to be without contact."""
        return np.asarray(self.columns["contact"] == 0)

    @property
    def grf_n(self) -> Floats:
        """GRF of the frames (m,) in N, 0 in frames known to be without contact."""
        return np.where(self.is_unloaded, 0.0, self.columns["grf_n"].astype(np.float64))


def reactions_of(
    exports: Sequence[Export], further: Sequence[str], frames_max: int
) -> list[Reaction]:
    """Read the frames of several exports, and resample them to one time axis.

    Args:
        exports: exports of sessions with estimates.
        further: further columns, read if a session has them.
        frames_max: limit of each session's frames, and of samples.

    Raises:
        UsageError: as for `Export.read_all` and `axis_of`; a session has no frame, or no
            frame with a force.
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
    """Return the instants of the frames on the export's clock, and their columns."""
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
    """Return begins and ends of contact; the previous frame has to exist with known contact."""
    contact, seq = columns["contact"], columns["seq"]
    follows = seq[1:] == seq[:-1] + 1
    if "part" in columns:
        follows &= columns["part"][1:] == columns["part"][:-1]
    begins = np.flatnonzero(follows & (contact[:-1] == 0) & (contact[1:] == 1)) + 1
    ends = np.flatnonzero(follows & (contact[:-1] == 1) & (contact[1:] == 0)) + 1
    events = [(float(since_s[i]), STRIKE) for i in begins]
    events += [(float(since_s[i]), OFF) for i in ends]
    return sorted(events)


def _bits(columns: Mapping[str, Array]) -> int:
    return int(np.bitwise_or.reduce(columns["estimate_status"]))
