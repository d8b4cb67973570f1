"""Angle of the foot's segment in a video, as a table: tracked, or from another program's points."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError, UsageError
from service.video.tracking import PLACE_SIGMA_PX, compute_angle
from service.video.worker import run_film_task
from storage.formats.angle_table import VIDEO, AngleTable
from storage.formats.readers.leg_points import read_leg_points
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.reader import SealedFileReader
from storage.sessions.videos import Video, get_film_path, read_picture_times

_POINT_SIGMA = 1e-4
"""Error of another program's points that neighbours share, relative to their distance."""
_INTERVAL_TOLERANCE = 0.1
_PICTURE_WITHIN, _PICTURE_WITHIN_S = 1.0 / 3.0, 0.002
"""Largest distance of a row's time from a picture's: part of the film's interval, or if more s."""


@dataclass(frozen=True)
class TrackOptions:
    """Options of a table of angles.

    Attributes:
        tags: numbers of the lower and the upper ArUco tag.
        dots: `bright`, or the colour of two dots.
        area_px: part of the pictures with the markers, see `track_markers`; None: all.
        lens: film of a checkerboard, taken by the same camera.
        board: inner corners along its rows and its columns.
        points_file: file of another program, in place of tracking.
        points: names of its lower and upper point.
        forward: direction in which the foot rolls, see `read_leg_points`.
        zero_rad: angle of the line between the markers at which the segment's is 0.
        scale_m: distance of the markers; None: places are in pixels only.
    """

    tags: tuple[int, int] | None = None
    dots: str | None = None
    area_px: tuple[int, ...] | None = None
    lens: Path | None = None
    board: tuple[int, int] = (9, 6)
    points_file: Path | None = None
    points: tuple[str, str] = ("", "")
    forward: str | None = None
    zero_rad: float = 0.0
    scale_m: float | None = None

    def make_task_options(self) -> dict[str, Any]:
        """Return the options of the task that tracks the markers.

        Raises:
            UsageError: there are none, but points of a file.
        """
        if self.points_file is not None:
            raise UsageError("points of a file are no markers", expected="--tags or --dots")
        return {
            "tags": self.tags,
            "dots": self.dots,
            "area_px": self.area_px,
            "lens": None if self.lens is None else str(self.lens),
            "board": self.board,
        }


class TrackedAngle(NamedTuple):
    """Table of angles, with the places of the markers by column."""

    table: AngleTable
    places: Mapping[str, Floats]


def track_video(
    folder: Path,
    video: Video,
    options: TrackOptions,
    on_picture: Callable[[int], None] = lambda _: None,
) -> TrackedAngle:
    """Track the angle in a video, or read the points that another program tracked in it.

    Args:
        folder: of the video.
        video: its description.
        options: markers and directions.
        on_picture: called with the number of pictures done.

    Raises:
        FileFormatError: the film or the file of points is damaged, does not show the markers, or
            the first one is above the other.
        UsageError: no such direction or colour.
    """
    path = get_film_path(folder, video)
    rate_hz = video.film.capture_rate_hz
    if options.points_file is not None:
        return read_points(options, read_picture_times(folder), video)
    if options.forward not in (None, "right", "left"):
        raise UsageError(f"--forward {options.forward}", expected="right or left")
    found = run_film_task(
        "track",
        path,
        on_picture=on_picture,
        capture_rate_hz=rate_hz,
        **options.make_task_options(),
    )
    places_px = np.array(found["places_px"], dtype=np.float64)
    sign = -1.0 if options.forward == "left" else 1.0
    columns = {
        f"{name}_{axis}_px": places_px[:, i, k]
        for i, name in enumerate(("lower", "upper"))
        for k, axis in enumerate("xy")
    }
    places = places_px * (sign, -1.0)
    tracked = _make_table(np.array(found["film_s"]), places, PLACE_SIGMA_PX, options, video)
    return tracked._replace(places={**columns, **tracked.places})


def read_points(
    options: TrackOptions, times_s: Floats | None = None, video: Video | None = None
) -> TrackedAngle:
    """Read the points that another program tracked, in a film or in space.

    Args:
        options: with the file of points and their names.
        times_s: times of the film's pictures; None: there is no film, and `film_s` is the time
            since the file's begin.
        video: of the film.

    Raises:
        FileFormatError: the file is not usable, or of another film.
        UsageError: no such direction.
    """
    assert options.points_file is not None  # noqa: S101
    path = options.points_file
    found = read_leg_points(path, options.points, options.forward)
    instants_s = found.instants
    if found.is_picture:
        if times_s is None or instants_s[-1] >= len(times_s) or instants_s[0] < 0:
            raise FileFormatError(
                f"its last picture is {instants_s[-1]:g}",
                where=str(path),
                expected="a film" if times_s is None else f"pictures 0 to {len(times_s) - 1}",
                remedy="Name the video in which these points were tracked",
            )
        instants_s = times_s[instants_s.astype(np.int64)]
    elif times_s is not None:
        _check_instants(instants_s, times_s, path)
    length = float(np.nanmedian(np.linalg.norm(found.places[:, 1] - found.places[:, 0], axis=1)))
    return _make_table(instants_s, found.places, _POINT_SIGMA * length, options, video)


def _check_instants(instants_s: Floats, times_s: Floats, path: Path) -> None:
    """Check that the instants of a file are seconds of the film, each that of a picture.

    Raises:
        FileFormatError: they are not.
    """
    edges_s = (times_s[1:] + times_s[:-1]) / 2
    pictures = np.searchsorted(edges_s, instants_s)
    off_s = np.abs(instants_s - times_s[pictures])
    film_interval_s, interval_s = (
        float(np.median(np.diff(each_s))) if len(each_s) > 1 else 0.0
        for each_s in (times_s, instants_s)
    )
    is_off = off_s > max(film_interval_s * _PICTURE_WITHIN, _PICTURE_WITHIN_S)
    is_off[1:] |= np.diff(pictures) == 0  # of two rows one is of a picture that was dropped
    if abs(interval_s - film_interval_s) > _INTERVAL_TOLERANCE * film_interval_s:
        what = f"its rows are {interval_s:g} s apart"
    elif is_off.any():
        row = int(np.argmax(is_off))
        what = f"its row {row + 1} is at {instants_s[row]:g} s, at which the film has no picture"
    else:
        return
    raise FileFormatError(
        what,
        where=str(path),
        expected=f"seconds of the film: {film_interval_s:g} s apart, up to {times_s[-1]:g}",
        remedy="Export its time in seconds, from the film's first picture on; if the film lacks "
        "pictures, and the other program does not know it, use --tags or --dots",
    )


def read_points_from(session_folder: Path, options: TrackOptions, begin_s: float) -> TrackedAngle:
    """Read points in space that another program tracked, whose begin in the session is known.

    Raises:
        FileFormatError, UsageError: as `read_points`.
    """
    tracked = read_points(options)
    with SealedFileReader(session_folder / FRAMES_NAME) as session:
        begin_ns = session.read_span_on_axis_ns()[0]
    film_s = tracked.table.film_s
    assert film_s is not None  # noqa: S101
    t_ns = begin_ns + np.rint((begin_s + film_s) * 1e9).astype(np.int64)
    table = replace(tracked.table, film_s=None, t_ns=t_ns)
    return tracked._replace(table=table)


def _make_table(
    film_s: Floats, places: Floats, place_sigma: float, options: TrackOptions, video: Video | None
) -> TrackedAngle:
    angle_rad, sigma_rad = compute_angle(places, zero_rad=options.zero_rad, place_sigma=place_sigma)
    where = "" if video is None else video.name
    if np.isnan(sigma_rad).all():
        raise FileFormatError(
            "no seven pictures in a row show both markers, by which their noise is measured",
            where=where,
            remedy="Film the leg without hiding the markers",
        )
    if np.nanmedian(np.abs(angle_rad)) > math.pi / 2.0:
        raise FileFormatError(
            "the first marker named is above the other: its angle is beyond a quarter of a turn",
            where=where,
            remedy="Name the lower marker first, or the angle at which the foot's is 0 by --zero",
        )
    t_ns, sigma_ns = (None, None) if video is None else video.place_pictures(film_s)
    table = AngleTable(angle_rad, sigma_rad, film_s, t_ns, sigma_ns, np.full(len(film_s), VIDEO))
    in_m: dict[str, Floats] = {}
    if options.scale_m is not None:
        length = float(np.nanmedian(np.linalg.norm(places[:, 1] - places[:, 0], axis=1)))
        for i, name in enumerate(("lower", "upper")):
            for k, axis in enumerate(("forward", "up")):
                in_m[f"{name}_{axis}_m"] = places[:, i, k] * (options.scale_m / length)
    return TrackedAngle(table, in_m)
