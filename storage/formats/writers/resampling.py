"""Resampling of frames to a constant rate, and the ground reaction at such a rate.

Samples between two successive frames are interpolated linearly. Samples in gaps of lost or not
sampled frames, and between two parts of a session, are empty.

A row of tiles does not measure the COP across the row: that column is NaN. The file states the
place of the row instead.

Foot frame: x forward, y to the left, z up the segment, origin at the ankle. Tiles measure forces
along their axis only: shear and the free moment are unknown, and written as 0.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from devices.arrays import Bools, Floats, Ints, Times
from devices.errors import UsageError
from devices.flags import EstimateFlag
from devices.frames import ArrayInfo
from storage.formats.export import Export
from storage.formats.writers.format import get_instants_on_export_clock_ns, to_floats_with_nan
from storage.schema import Array

INTERPOLATED_PERIODS_MAX = 2.5
"""Longest interpolated interval, in periods: a frame may be late, or one may not be sampled."""
COINCIDENCE_PERIODS = 1e-3
"""Distance, in periods, up to which a sample has exactly a frame's values."""
_NOMINAL_RATE_TOLERANCE = 0.01
"""Relative difference of the median rate up to which frames have the nominal rate."""


@dataclass(frozen=True)
class SampleAxis:
    """Time axis of samples at a constant rate.

    Attributes:
        rate_hz: rate, exact in float32 as C3D stores it.
        begin_ns: instant of the first sample.
        count: number of samples.
    """

    rate_hz: float
    begin_ns: int
    count: int

    @property
    def period_ns(self) -> float:
        """Time between two samples, in ns."""
        return 1e9 / self.rate_hz


@dataclass(frozen=True)
class Resampling:
    """Linear resampling of m frames to n samples at a constant rate.

    Attributes:
        axis: time axis of the samples.
        frame_before: (n,), index of the last frame not after the sample.
        frame_after: (n,), index of the next frame, or the same index at the end.
        fraction: (n,), fraction of the interval from `before` to `after`, 0 to 1.
        has_frames: (n,), bool; False: the sample is empty.
    """

    axis: SampleAxis
    frame_before: Ints
    frame_after: Ints
    fraction: Floats
    has_frames: Bools

    def __len__(self) -> int:
        return len(self.frame_before)

    @property
    def elapsed_s(self) -> Floats:
        """Times of the samples (n,), in seconds since the first."""
        return np.arange(len(self)) / self.axis.rate_hz

    @property
    def empty_count(self) -> int:
        """Number of empty samples."""
        return int((~self.has_frames).sum())

    def interpolate(self, column: Floats) -> Floats:
        """Return a column of m numbers interpolated linearly, (n,); NaN if a frame has NaN."""
        begin, end = column[self.frame_before], column[self.frame_after]
        with np.errstate(invalid="ignore"):
            values = begin + self.fraction * (end - begin)
        values = np.where(self.fraction == 0.0, begin, np.where(self.fraction == 1.0, end, values))
        return np.where(self.has_frames, values, np.nan)

    def resample_nearest(self, column: Array) -> Floats:
        """Return a column of m numbers or flags of the nearer frames, (n,); NaN if empty."""
        values = column[np.where(self.fraction <= 0.5, self.frame_before, self.frame_after)]
        return np.where(self.has_frames, values.astype(np.float64), np.nan)

    def describe(self) -> str:
        """Return a description of the resampling, for the file."""
        text = (
            f"{len(self)} samples at {self.axis.rate_hz:.9g} Hz, on straight lines between frames "
            "that follow upon each other; flags are the nearer frame's"
        )
        return f"{text}; {self.empty_count} samples are empty: frames lost, or not taken"


def make_sample_axis(streams: Sequence[tuple[Times, float]], samples_max: int) -> SampleAxis:
    """Return the time axis from the earliest to the latest frame of all streams.

    Args:
        streams: instants and nominal rate of each stream, one frame at least. The median rate
            counts if it differs from the nominal one. The axis has the highest rate.
        samples_max: limit of samples.

    Raises:
        UsageError: instants run back, or there are too many samples.
    """
    for t_ns, _ in streams:
        _check_rising_instants(t_ns)
    rate_hz = max(_frame_rate_hz(np.diff(t_ns), nominal_hz) for t_ns, nominal_hz in streams)
    rate_hz = float(np.float32(rate_hz))
    begin_ns = min(int(t_ns[0]) for t_ns, _ in streams)
    end_ns = max(int(t_ns[-1]) for t_ns, _ in streams)
    count = int((end_ns - begin_ns) * 1e-9 * rate_hz + COINCIDENCE_PERIODS) + 1
    if count > samples_max:
        raise UsageError(
            f"from the first frame to the last there are {count} samples at {rate_hz:.6g} Hz, "
            f"gaps included; the limit is {samples_max}",
            expected=f"a slice of {(samples_max - 1) / rate_hz:.3f} s at most",
        )
    return SampleAxis(rate_hz, begin_ns, count)


def find_consecutive_frames(axis: SampleAxis, t_ns: Times, seq: Array, part: Array | None) -> Bools:
    """Return the mask (m - 1,) of the frames that the next one follows without a gap.

    Args:
        axis: time axis that covers the frames.
        t_ns: (m,), instants of the frames, rising; m > 0.
        seq: (m,), numbers of the frames.
        part: (m,), parts of the session; None: a single part.
    """
    steps_ns = np.diff(t_ns)
    follows = (seq[1:] == seq[:-1] + 1) & (steps_ns <= INTERPOLATED_PERIODS_MAX * axis.period_ns)
    if part is not None:
        follows &= part[1:] == part[:-1]
    return np.asarray(follows)


def make_resampling(axis: SampleAxis, t_ns: Times, is_joined: Bools) -> Resampling:
    """Return the resampling of frames to a time axis.

    Args:
        axis: time axis that covers the frames.
        t_ns: (m,), instants of the frames, rising; m > 0.
        is_joined: (m - 1,), True: samples between this frame and the next are interpolated.
    """
    period_ns = axis.period_ns
    since_ns = (t_ns - axis.begin_ns).astype(np.float64)
    due_ns = np.arange(axis.count) * period_ns
    before = np.maximum(np.searchsorted(since_ns, due_ns, side="right") - 1, 0)
    after = np.minimum(before + 1, len(t_ns) - 1)
    length_ns = np.where(after > before, since_ns[after] - since_ns[before], period_ns)
    share = np.clip((due_ns - since_ns[before]) / length_ns, 0.0, 1.0)
    is_before = np.abs(due_ns - since_ns[before]) <= COINCIDENCE_PERIODS * period_ns
    is_after = np.abs(due_ns - since_ns[after]) <= COINCIDENCE_PERIODS * period_ns
    share[is_before] = 0.0
    share[is_after & (after > before)] = 1.0
    is_within = (due_ns >= since_ns[0]) & (due_ns <= since_ns[-1])
    is_there = (np.append(is_joined, False)[before] & is_within) | is_before | is_after
    return Resampling(axis, before, after, share, is_there)


def _check_rising_instants(t_ns: Times) -> None:
    steps_ns = np.diff(t_ns)
    if (steps_ns <= 0).any():
        at = int(np.flatnonzero(steps_ns <= 0)[0])
        raise UsageError(
            f"time runs back by {-int(steps_ns[at]) * 1e-9:.6g} s, "
            f"{(t_ns[at] - t_ns[0]) * 1e-9:.3f} s behind the first of these frames, as where a "
            "node's clock was set between two parts",
            expected="one time axis",
            remedy="Ask for the server's clock, or a slice that ends before",
        )


def _frame_rate_hz(steps_ns: Times, nominal_hz: float) -> float:
    if not len(steps_ns):
        return nominal_hz
    median_hz = 1e9 / float(np.median(steps_ns))
    return nominal_hz if abs(median_hz / nominal_hz - 1.0) <= _NOMINAL_RATE_TOLERANCE else median_hz


COP = ("cop_x_m", "cop_y_m")
POINT_COLUMNS = ("grf_n", *COP, "estimate_flags")
"""Columns of a force with its point of application."""


def fill_cop_across_tile_row(columns: Mapping[str, Array], info: ArrayInfo) -> dict[str, Array]:
    """Return the columns, with the place of a row of tiles as the unmeasured COP across it.

    Args:
        columns: `POINT_COLUMNS` and any others, (n,) each.
        info: the array.
    """
    is_stated = (columns["estimate_flags"] & EstimateFlag.COP_MASKED) == 0
    placed = {
        name: np.where(is_stated & np.isnan(columns[name]), place_m, columns[name])
        for name, place_m in zip(COP, info.row_place_m, strict=True)
        if place_m is not None
    }
    return {**columns, **placed}


REQUIRED_COLUMNS = ("t_ns", "contact", *POINT_COLUMNS)
"""Required columns, which every session with estimates has."""
OPTIONAL_COLUMNS = (
    *("grf_sigma_n", "grf_lower_bound_n", "cop_sigma_x_m", "cop_sigma_y_m"),
    *("cop_ground_x_m", "cop_ground_y_m", "angle_rad"),
)
"""Optional columns of a session."""
FLAG_COLUMNS = ("contact", "estimate_flags", "grf_lower_bound_n")
"""Columns that are not interpolated between two frames."""
FOOT_STRIKE, FOOT_OFF = "Foot Strike", "Foot Off"
"""Labels of contact events, after the C3D manual."""


@dataclass(frozen=True)
class GroundReaction:
    """Ground reaction of a session or slice: m frames, resampled to n samples.

    Attributes:
        t_ns: (m,), instants of the frames on the export's clock.
        is_consecutive: (m - 1,), frames that the next one follows without a gap.
        resampling: resampling of frames to samples.
        columns: flat columns of frames, (m,) each; the COP `fill_cop_across_tile_row`.
        events: time in seconds after the first sample, and label: first the markers, then begins
            and ends of contact.
        marker_count: number of markers among the events.
    """

    t_ns: Times
    is_consecutive: Bools
    resampling: Resampling
    columns: Mapping[str, Array]
    events: Sequence[tuple[float, str]]
    marker_count: int

    def resample_column(self, column_name: str) -> Floats:
        """Return a column at the samples, (n,); NaN where it is unknown or the sample is empty."""
        quantity_name = re.sub(r"_\d+$", "", column_name)
        column = to_floats_with_nan(quantity_name, self.columns[column_name])
        if column_name in FLAG_COLUMNS:
            return self.resampling.resample_nearest(column)
        return self.resampling.interpolate(column)

    def compute_slice_time_s(self, export: Export) -> float:
        """Return the time of the first sample as slices of the file count it, in s."""
        first_ns = int(export.to_session_axis_ns(self.columns)[0])
        sample_ns = first_ns + self.resampling.axis.begin_ns - int(self.t_ns[0])
        return (sample_ns - export.slice_zero_ns) * 1e-9

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
    def is_frame_unloaded(self) -> Bools:
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
        follows = find_consecutive_frames(axis, t_ns, columns["seq"], columns.get("part"))
        marked = _marker_events(columns, since_s)
        events = [*marked, *_contact_events(columns["contact"], follows, since_s)]
        placed = make_resampling(axis, t_ns, follows)
        found.append(GroundReaction(t_ns, follows, placed, columns, events, len(marked)))
    return found


def _read_frames(
    export: Export, optional_columns: Sequence[str], frames_max: int
) -> tuple[Times, dict[str, Array]]:
    """Return the instants of the frames on the export's clock, and their columns."""
    present = set(export.frame_source.quantity_names)
    names = [*REQUIRED_COLUMNS, *(name for name in optional_columns if name in present)]
    names = ["seq", *names, *export.instant_columns, *export.marker_columns]
    columns = export.read_all(list(dict.fromkeys(names)), frames_max=frames_max)
    t_ns = get_instants_on_export_clock_ns(export, columns)
    if not len(t_ns):
        raise UsageError(
            "no frame is in this slice",
            where=export.session_and_node_text,
            expected="a slice with frames, as this format needs them",
        )
    if not np.isfinite(columns["grf_n"]).any():
        raise UsageError(
            f"none of its {len(t_ns)} frames has a force "
            f"(estimate_flags {_combined_flags(columns)})",
            where=export.session_and_node_text,
            remedy="Ask for Parquet, Arrow or CSV: they have counts and bounds",
        )
    return t_ns, fill_cop_across_tile_row(columns, export.array_info)


def _marker_events(columns: Mapping[str, Array], since_s: Floats) -> list[tuple[float, str]]:
    labels = columns.get("marker")
    if labels is None:
        return []
    return [(float(since_s[i]), labels[i]) for i in range(len(labels)) if labels[i] is not None]


def _contact_events(contact: Array, follows: Bools, since_s: Floats) -> list[tuple[float, str]]:
    """Return begins and ends of contact; none in a gap, or beside a frame of unknown contact."""
    begins = np.flatnonzero(follows & (contact[:-1] == 0) & (contact[1:] == 1)) + 1
    ends = np.flatnonzero(follows & (contact[:-1] == 1) & (contact[1:] == 0)) + 1
    events = [(float(since_s[i]), FOOT_STRIKE) for i in begins]
    events += [(float(since_s[i]), FOOT_OFF) for i in ends]
    return sorted(events)


def _combined_flags(columns: Mapping[str, Array]) -> int:
    return int(np.bitwise_or.reduce(columns["estimate_flags"]))
