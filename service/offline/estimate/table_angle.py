"""Angle of the foot segment from a table, in place of the servo's.

The estimator gets it as the position of a fine servo that was read at the instant of each frame:
so one estimator serves live, offline and films. Where the table states no angle there is none,
whatever the servo measured. The frames themselves keep the servo's counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from devices.arrays import Columns, Floats, Times
from devices.errors import FileFormatError, UsageError
from devices.flags import FrameFlag
from devices.frames import NO_SERVO_COUNTS, ArrayInfo, ServoInfo
from devices.scene.scene_file import Scene
from service.estimation.foot import compute_segment_rad_per_count
from service.offline.estimate.preparation import BatchWithColumns
from storage.formats.angle_table import UNKNOWN_ANGLE, VIDEO, read_angle_table
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.reader import SealedFileReader
from storage.sessions.time_axis import TimeAxis
from storage.sessions.videos import VIDEO_NAME, read_video

GAP_MAX_NS = 100_000_000
"""Longest time between two angles in which it is interpolated."""
_COUNTS_PER_TURN = 1 << 24
_UNKNOWN = np.uint8(FrameFlag.SERVO_STALE | FrameFlag.SERVO_TURN_UNKNOWN)
_REPLACED = ("servo_counts", "servo_age_us", "frame_flags")


@dataclass(frozen=True)
class AngleTrack:
    """Known angles at n instants of a session, rising.

    Attributes:
        t_ns: (n,), on the session's time axis.
        angle_rad: (n,).
        sigma_rad: (n,), standard deviations.
        sigma_ns: (n,), of the instants.
        source: (n,), what measured them.
        origin: name and hash of the table's file.
    """

    t_ns: Times
    angle_rad: Floats
    sigma_rad: Floats
    sigma_ns: Floats
    source: npt.NDArray[np.str_]
    origin: Mapping[str, str]

    @cached_property
    def bend(self) -> Floats:
        """Largest second derivative of the angle near each instant, (n,), in rad/s^2.

        The change of slope over a gap counts in the gap, where the angle may have turned.
        """
        since_s = (self.t_ns - self.t_ns[0]) * 1e-9
        slope = np.gradient(self.angle_rad, since_s)
        over_step = np.abs(np.diff(slope)) / np.diff(since_s)
        around = np.concatenate([over_step[:1], over_step, over_step[-1:]])
        return np.asarray(np.maximum(around[:-1], around[1:]))

    def interpolate(self, t_ns: Times) -> tuple[Floats, Floats, npt.NDArray[np.str_]]:
        """Interpolate to instants: angle and its standard deviation, NaN where unknown; source.

        The deviation has three parts: of the angles, of their instants, and of the straight line
        between them, by the bend of the angle there.
        """
        after = np.clip(np.searchsorted(self.t_ns, t_ns), 1, len(self.t_ns) - 1)
        before = after - 1
        step_ns = self.t_ns[after] - self.t_ns[before]
        part = (t_ns - self.t_ns[before]) / step_ns
        is_known = (part >= 0.0) & (part <= 1.0)
        is_known &= (step_ns <= GAP_MAX_NS) | (part == 0.0) | (part == 1.0)
        rise_rad = self.angle_rad[after] - self.angle_rad[before]
        angle_rad = self.angle_rad[before] + part * rise_rad
        bend = np.maximum(self.bend[before], self.bend[after])
        sigma_rad = np.sqrt(
            ((1.0 - part) * self.sigma_rad[before]) ** 2
            + (part * self.sigma_rad[after]) ** 2
            + (rise_rad / step_ns * self.sigma_ns[before]) ** 2
            + (0.5e-18 * bend * part * (1.0 - part) * step_ns**2) ** 2
        )
        source = np.where(is_known, self.source[before], UNKNOWN_ANGLE)
        nothing = np.full(len(t_ns), math.nan)
        return (
            np.where(is_known, angle_rad, nothing),
            np.where(is_known, sigma_rad, nothing),
            source,
        )


def check_film_of_session(table: Path, source: Path) -> None:
    """Check that the film that a table lies beside is one of the session that it is used for.

    Args:
        table: the table.
        source: the session's file.

    Raises:
        UsageError: the film's session is of another stream.
        FileFormatError: one of the sessions is damaged.
    """
    folder = table.parent.parent
    if not (table.parent / VIDEO_NAME).exists() or not (folder / FRAMES_NAME).exists():
        return
    streams = set()
    for path in (source, folder / FRAMES_NAME):
        with SealedFileReader(path, only_slices=True) as session:
            streams.add(session.info.stream_id)
    if len(streams) > 1:
        raise UsageError(
            f"{table} is of a film of another session, {folder.name}",
            expected=f"a film of {source}",
        )


def read_angle_track(path: Path) -> AngleTrack:
    """Read a table of angles; a film's times are converted by the alignment beside it.

    Raises:
        FileFormatError: as `read_angle_table`.
        UsageError: the table has times of a film that is not aligned with the session.
    """
    table = read_angle_table(path)
    t_ns, sigma_ns = table.t_ns, table.sigma_ns
    if table.film_s is not None and (path.parent / VIDEO_NAME).exists():
        # By its present alignment: the table may be older.
        t_ns, sigma_ns = read_video(path.parent).place_pictures(table.film_s)
    if t_ns is None:
        raise UsageError(
            f"{path} has times of a film that is not aligned with the session",
            expected="an aligned video beside it, or a column t_ns",
            remedy="Align it: foottile video align, then track it again, or leave the table there",
        )
    count = len(t_ns)
    sigma_ns = np.zeros(count) if sigma_ns is None else sigma_ns
    is_known = ~np.isnan(table.angle_rad)
    if np.isnan(sigma_ns[is_known]).any():
        raise FileFormatError(
            "sigma_ns is empty in a row with an angle",
            where=str(path),
            expected="a number, or no column",
        )
    source = np.full(count, VIDEO) if table.angle_source is None else table.angle_source
    return AngleTrack(
        t_ns[is_known],
        table.angle_rad[is_known],
        table.sigma_rad[is_known],
        sigma_ns[is_known],
        source.astype(np.str_)[is_known],
        {"table": path.name, "sha256": compute_sha256(path)},
    )


class TableServo:
    """Servo whose positions are a table's angles.

    Args:
        info: array of the session.
        scene: its scene, for a session without a servo: how the ankle travels; None: not known.
        track: angles.
        axis: time axis of the session.

    Attributes:
        info: the array with this servo.
    """

    def __init__(
        self, info: ArrayInfo, scene: Scene | None, track: AngleTrack, axis: TimeAxis
    ) -> None:
        servo = info.servo or (None if scene is None else scene.servo)
        self._travel = None if servo is None else servo.ankle_travel_m_per_rad
        self._track, self._axis, self._own = track, axis, info.servo
        self._frame_count = self._known_count = self._compared_count = 0
        self._apart_rad2 = 0.0
        self.info = info.model_copy(
            update={
                "servo": ServoInfo(
                    model="table of angles",
                    counts_per_turn=_COUNTS_PER_TURN,
                    zero_counts=0,
                    sign=1,
                    ratio=1.0,
                    ankle_travel_m_per_rad=self._travel,
                )
            }
        )

    def check_overlap(self, first_ns: int, last_ns: int) -> None:
        """Refuse a table without an angle in the session.

        Raises:
            FileFormatError: it lies before or after these instants.
        """
        begin_s, end_s = ((int(self._track.t_ns[i]) - first_ns) * 1e-9 for i in (0, -1))
        if end_s < 0.0 or begin_s * 1e9 > last_ns - first_ns:
            raise FileFormatError(
                f"the table's angles are from {begin_s:.1f} to {end_s:.1f} s of the session, which "
                f"is {(last_ns - first_ns) * 1e-9:.1f} s long",
                expected="a table of this session",
                remedy="Check the video's alignment",
            )

    def replace_positions(self, pieces: Iterable[BatchWithColumns]) -> Iterator[BatchWithColumns]:
        """Yield frames with the table's angle as the servo's; their own is in the columns."""
        for frames, columns in pieces:
            t_ns = self._axis.shift_to_axis(frames.t_ns, columns.get("part"))
            angle_rad, sigma_rad, source = self._track.interpolate(t_ns)
            counts = np.rint(angle_rad * (_COUNTS_PER_TURN / (2.0 * math.pi)))
            given = replace(
                frames,
                servo_counts=np.where(np.isnan(counts), NO_SERVO_COUNTS, counts).astype(np.int32),
                servo_age_us=np.zeros_like(frames.servo_age_us),
                frame_flags=frames.frame_flags & ~_UNKNOWN,
            )
            kept = {name: getattr(frames, name) for name in _REPLACED}
            yield given, {**columns, **kept, "angle_source": source, "angle_sigma_rad": sigma_rad}

    def _count(self, angle_rad: Floats, own: Columns) -> None:
        self._frame_count += len(angle_rad)
        self._known_count += int((~np.isnan(angle_rad)).sum())
        if self._own is None:
            return
        counts = own["servo_counts"]
        is_read = (counts != NO_SERVO_COUNTS) & (own["frame_flags"] & _UNKNOWN == 0)
        own_rad = (counts - self._own.zero_counts) * compute_segment_rad_per_count(self._own)
        apart_rad = (angle_rad - own_rad)[is_read & ~np.isnan(angle_rad)]
        self._compared_count += len(apart_rad)
        self._apart_rad2 += float(apart_rad @ apart_rad)

    def describe_use(self) -> str:
        """Describe how many frames have an angle, and how far it is from the servo's."""
        share = self._known_count / max(self._frame_count, 1)
        text = f"the table has an angle in {100 * share:.0f} % of the frames"
        if self._compared_count:
            apart_deg = math.degrees(math.sqrt(self._apart_rad2 / self._compared_count))
            text += f"; it differs from the servo's by {apart_deg:.2g} degrees (RMS)"
        if self._travel is None:
            text += "; without the ankle's travel, of a --scene, there is no COP on the ground"
        return text

    def restore_positions(self, pieces: Iterable[BatchWithColumns]) -> Iterator[BatchWithColumns]:
        """Yield estimated frames with their own servo, and the uncertainty on the ground."""
        for frames, columns in pieces:
            own = {name: columns[name] for name in _REPLACED}
            self._count(columns["angle_rad"], own)
            others = {name: values for name, values in columns.items() if name not in own}
            others["cop_ground_sigma_x_m"] = self._compute_ground_sigma_m(columns)
            yield replace(frames, **own), others

    def _compute_ground_sigma_m(self, columns: Columns) -> Floats:
        """Compute the standard deviation of the COP's x on the ground."""
        z_m = np.array([tile.z_m for tile in self.info.tiles])
        force_n = np.nan_to_num(columns["force_n"])
        total_n = force_n.sum(axis=1)
        at_z_m = force_n @ z_m / np.where(total_n == 0.0, math.nan, total_n)
        angle_rad, x_m = columns["angle_rad"], columns["cop_x_m"]
        travel_m = math.nan if self._travel is None else self._travel
        slope_m = travel_m - x_m * np.sin(angle_rad) + at_z_m * np.cos(angle_rad)
        return np.asarray(np.hypot(columns["cop_sigma_x_m"], slope_m * columns["angle_sigma_rad"]))
