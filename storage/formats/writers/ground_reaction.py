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
from storage.formats.writers.multi_session import get_instants_on_export_clock_ns
from storage.formats.writers.resampling import Resampling, make_resampling, make_sample_axis
from storage.formats.writers.row_place import NEEDED as POINT
from storage.formats.writers.row_place import fill_cop_across_tile_row
from storage.schema import SERVER_TIME_COLUMNS, Array

REQUIRED_COLUMNS = ("t_ns", "contact", *POINT)
"""Required columns, which every session with estimates has."""
OPTIONAL_COLUMNS = (
    *("grf_sigma_n", "grf_lower_bound_n", "cop_sigma_x_m", "cop_sigma_y_m"),
    *("cop_ground_x_m", "cop_ground_y_m", "angle_rad"),
)
"""Optional columns of a session."""
FLAG_COLUMNS = ("contact", "estimate_flags", "grf_lower_bound_n")
"""Columns that are not interpolated between two frames."""
SERVER_TIME_NAMES = [column.name for column in SERVER_TIME_COLUMNS]
FOOT_STRIKE, FOOT_OFF = "Foot Strike", "Foot Off"
"""Labels of contact events, after the C3D manual."""


@dataclass(frozen=True)
class GroundReaction:
    """Ground reaction of a session or slice: m frames, resampled to n samples.

    Attributes:
        resampling: resampling of frames to samples.
        columns: flat columns of frames, (m,) each; the COP `fill_cop_across_tile_row`.
        events: time in seconds after the first sample, and label: first the markers, then begins
            and ends of contact.
        marker_count: number of markers among the events.
    """

    resampling: Resampling
    columns: Mapping[str, Array]
    events: Sequence[tuple[float, str]]
    marker_count: int

    def resample_column(self, column_name: str) -> Floats:
        """Return a column at the samples, (n,); NaN where it is unknown or the sample is empty."""
        column = self.columns[column_name]
        if column_name in FLAG_COLUMNS:
            return self.resampling.resample_nearest(column)
        return self.resampling.interpolate(column.astype(np.float64))

    @property
    def server_time_bound_s(self) -> Floats | None:
        """Bound (n,) of the error of the server's time, in s; None if times are the node's."""
        name = "t_server_uncertainty_ns"
        return (
            self.resampling.resample_nearest(self.columns[name]) * 1e-9
            if name in self.columns
            else None
        )

    @property
    def is_frame_unloaded(self) -> npt.NDArray[np.bool_]:
        """Mask (m,) of the frames known to be without contact."""
        return np.asarray(self.columns["contact"] == 0)

    @property
    def frame_contact_grf_n(self) -> Floats:
        """GRF of the frames (m,) in N, 0 in frames known to be without contact."""
        return np.where(self.is_frame_unloaded, 0.0, self.columns["grf_n"].astype(np.float64))


def read_reactions_on_common_axis(
    exports: Sequence[Export], optional_columns: Sequence[str], frames_max: int
) -> list[GroundReaction]:
    """Read the frames of several exports, and resample them to one time axis.

    Args:
        exports: exports of sessions with estimates.
        optional_columns: further columns, read if a session has them.
        frames_max: limit of each session's frames, and of samples.

    Raises:
        UsageError: as for `Export.read_all` and `make_sample_axis`; a session has no frame, or no
            frame with a force.
    """
    read = [_read_frames(export, optional_columns, frames_max) for export in exports]
    streams = [
        (t_ns, export.array_info.nominal_rate_hz)
        for (t_ns, _), export in zip(read, exports, strict=True)
    ]
    axis = make_sample_axis(streams, frames_max)
    found = []
    for t_ns, columns in read:
        since_s = (t_ns - axis.begin_ns).astype(np.float64) * 1e-9
        marked = _marker_events(columns, since_s)
        events = [*marked, *_contact_events(columns, since_s)]
        placed = make_resampling(axis, t_ns, columns["seq"], columns.get("part"))
        found.append(GroundReaction(placed, columns, events, len(marked)))
    return found


def _read_frames(
    export: Export, optional_columns: Sequence[str], frames_max: int
) -> tuple[Times, dict[str, Array]]:
    """Return the instants of the frames on the export's clock, and their columns."""
    present = set(export.frame_source.quantity_names)
    names = [*REQUIRED_COLUMNS, *(name for name in optional_columns if name in present)]
    names += SERVER_TIME_NAMES if export.clock is not None else []
    names += ["marker"] if export.markers is not None else []
    names += ["part"] if "part" in present else []
    columns = export.read_all(list(dict.fromkeys(["seq", *names])), frames_max=frames_max)
    t_ns = get_instants_on_export_clock_ns(export, columns)
    if not len(t_ns):
        raise UsageError(
            "no frame is in this slice",
            where=export.display_name,
            expected="a slice with frames, as this format needs them",
        )
    if not np.isfinite(columns["grf_n"]).any():
        raise UsageError(
            f"none of its {len(t_ns)} frames has a force "
            f"(estimate_flags {_combined_flags(columns)})",
            where=export.display_name,
            remedy="Ask for Parquet, Arrow or CSV: they have counts and bounds",
        )
    return t_ns, fill_cop_across_tile_row(columns, export.array_info)


def _marker_events(columns: Mapping[str, Array], since_s: Floats) -> list[tuple[float, str]]:
    labels = columns.get("marker")
    if labels is None:
        return []
    return [(float(since_s[i]), labels[i]) for i in range(len(labels)) if labels[i] is not None]


def _contact_events(columns: Mapping[str, Array], since_s: Floats) -> list[tuple[float, str]]:
    """Return begins and ends of contact; the previous frame has to exist with known contact."""
    contact, seq = columns["contact"], columns["seq"]
    follows = seq[1:] == seq[:-1] + 1
    if "part" in columns:
        follows &= columns["part"][1:] == columns["part"][:-1]
    begins = np.flatnonzero(follows & (contact[:-1] == 0) & (contact[1:] == 1)) + 1
    ends = np.flatnonzero(follows & (contact[:-1] == 1) & (contact[1:] == 0)) + 1
    events = [(float(since_s[i]), FOOT_STRIKE) for i in begins]
    events += [(float(since_s[i]), FOOT_OFF) for i in ends]
    return sorted(events)


def _combined_flags(columns: Mapping[str, Array]) -> int:
    return int(np.bitwise_or.reduce(columns["estimate_flags"]))
