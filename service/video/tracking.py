"""Angle of the foot's segment in a film, from two markers along it.

Markers are ArUco tags (4x4_50, any two numbers), or dots: bright ones, as of retro-reflective tape,
or of a colour. The angle is that of the line from the lower to the upper marker against the
picture's upright, positive as the foot rolls forward, and 0 where the user says: a camera is seldom
level. It is known in the picture's plane; a camera that looks obliquely by `a` turns it by up to (1
/ cos a - 1) of its sine.

The uncertainty is mostly measured on the film itself: the distance of each angle from a parabola
through its neighbours is noise of the detection (and motion faster than the film shows, which
makes it greater, never less). A picture in which a marker is hidden has no angle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.errors import FileFormatError, UsageError
from service.video.container import Picture, iterate_pictures, read_film
from storage.sessions.videos import FilmInfo

_TAG_SEARCH = 4.0
"""Where a tag is looked for: its last place, and this many times its size around it."""
_DOT_AREA_MIN_PX, _DOT_AREA_MAX = 6.0, 0.02
"""Least area of a dot; its largest one, as a part of the film's pictures."""
_DOT_ROUNDNESS = 0.6
"""Least ratio of a dot's area to that of the circle around it."""
_LENGTH_TOLERANCE = 0.1
"""Largest deviation of the markers' distance from its median, relative to it."""
_NOISE_PICTURES = 50
_WINDOW = 7
"""Pictures of the parabola that measures the noise."""
PLACE_SIGMA_PX = 0.05
"""Error of a place by the grid of pixels: neighbours share it, so a parabola does not show it."""
_COLOURS_HUE = {"red": 0, "orange": 12, "yellow": 28, "green": 60, "blue": 112, "magenta": 150}
"""Hues in OpenCV's half degrees."""
_HUE_WITHIN = 11
_SATURATION_MIN = 90
_VALUE_MIN = 70
_BRIGHT_MIN = 200
_BOARDS_MIN, _BOARDS_MAX = 5, 40
"""Pictures of a checkerboard that are needed, and that are looked at."""


class Lens(NamedTuple):
    """Camera matrix (3, 3) and distortion coefficients of OpenCV's model."""

    matrix: Floats
    distortion: Floats


FindMarkers = Callable[[Picture], Floats | None]
"""Finds both markers in a picture: (2, 2), the lower one first; None if not both are seen."""


def check_area(area_px: tuple[int, int, int, int], film: FilmInfo, path: Path) -> None:
    """Check that an area is a part of a film's pictures.

    Raises:
        UsageError: it reaches beyond them.
    """
    left, top, width, height = area_px
    if left + width > film.width_px or top + height > film.height_px:
        raise UsageError(
            f"the area reaches to {left + width}, {top + height}",
            where=str(path),
            expected=f"a part of {film.width_px} x {film.height_px} pixels",
        )


def track_markers(
    path: Path,
    film: FilmInfo,
    find_markers: FindMarkers,
    *,
    is_grey: bool,
    area_px: tuple[int, int, int, int] | None = None,
    lens: Lens | None = None,
    on_picture: Callable[[int], None] = lambda _: None,
) -> Floats:
    """Track the markers through a film.

    Args:
        path: the film.
        film: its facts.
        find_markers: finds them in a picture.
        is_grey: whether it takes grey pictures.
        area_px: left, top, width and height of the part of the pictures in which markers are
            looked for, see `check_area`; None: all.
        lens: of the camera, by a checkerboard.
        on_picture: called with the number of each picture.

    Returns:
        (pictures, 2, 2), places in pixels, the lower marker first, x to the right and y down; NaN
        where a marker is hidden.

    Raises:
        FileFormatError: the film is damaged, or no picture shows both markers, and only these.
    """
    places_px = np.full((film.picture_count, 2, 2), math.nan)
    left, top, width, height = area_px or (0, 0, film.width_px, film.height_px)
    for index, picture in iterate_pictures(path, is_grey=is_grey):
        found = find_markers(picture[top : top + height, left : left + width])
        if found is not None and index < film.picture_count:
            places_px[index] = found + np.array([left, top])
        on_picture(index)
    if np.isnan(places_px).all():
        raise FileFormatError(
            "no picture shows both markers, and no others",
            where=str(path),
            remedy="Look at the film: tags need a white border, and 5 pixels a square; leave out "
            "other things of the dots' colour by --area",
        )
    return places_px if lens is None else undistort(places_px, lens)


def compute_angle(
    places: Floats, *, zero_rad: float, place_sigma: float = PLACE_SIGMA_PX
) -> tuple[Floats, Floats]:
    """Compute the angle and its standard deviation, (pictures,) each.

    Args:
        places: (pictures, 2, 2), of the lower and the upper marker, forward and up.
        zero_rad: angle of the line between them at which the segment's is 0.
        place_sigma: error of a place that neighbours share, in the unit of `places`.
    """
    forward, up = np.moveaxis(places[:, 1] - places[:, 0], 1, 0)
    length = np.hypot(forward, up)
    angle_rad = np.remainder(np.arctan2(forward, up) - zero_rad + math.pi, 2.0 * math.pi) - math.pi
    # The leg is rigid: at another length something else was taken for a marker.
    is_leg = np.abs(length / np.nanmedian(length) - 1.0) <= _LENGTH_TOLERANCE
    angle_rad = np.where(is_leg, angle_rad, math.nan)
    shared_rad = math.sqrt(2.0) * place_sigma / np.where(length > 0.0, length, math.nan)
    return angle_rad, np.hypot(shared_rad, _measure_noise_rad(angle_rad))


def _measure_noise_rad(angle_rad: Floats) -> Floats:
    """Measure the noise of the angle: median residuals of a parabola, (pictures,).

    That of `_NOISE_PICTURES` around a picture, at least that of the film: a foot at rest says
    nothing of a moving one. NaN: there are no `_WINDOW` pictures in a row that show both markers.
    """
    count = len(angle_rad)
    if count < _WINDOW:
        return np.full(count, math.nan)
    x = np.arange(_WINDOW) - _WINDOW // 2
    design = np.stack([np.ones(_WINDOW), x, x**2], axis=1)
    weights = np.eye(_WINDOW)[_WINDOW // 2] - (design @ np.linalg.pinv(design))[_WINDOW // 2]
    left_rad = np.full(-(-count // _NOISE_PICTURES) * _NOISE_PICTURES, math.nan)
    middle = slice(_WINDOW // 2, count - _WINDOW // 2)
    left_rad[middle] = np.abs(np.convolve(angle_rad, weights[::-1], "valid"))
    blocks = np.sort(left_rad.reshape(-1, _NOISE_PICTURES), axis=1)  # NaN comes last
    seen = np.isfinite(blocks).sum(axis=1)
    medians = np.nan_to_num(blocks[np.arange(len(blocks)), np.maximum(seen - 1, 0) // 2])
    known = left_rad[np.isfinite(left_rad)]
    if not len(known):
        return np.full(count, math.nan)
    whole = float(np.median(known))
    # Of a normal distribution the median of absolute values is 0.6745 sigma.
    scale = 0.6745 * math.sqrt(float(weights @ weights))
    return np.asarray(np.maximum(medians, whole).repeat(_NOISE_PICTURES)[:count] / scale)


def make_tag_finder(lower_id: int, upper_id: int) -> FindMarkers:
    """Make a finder of two ArUco tags (dictionary 4x4_50), by the middles of their squares.

    Each is looked for near its last place first, which takes a tenth of the time.
    """
    import cv2

    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detector = cv2.aruco.ArucoDetector(dictionary, settings)
    last: dict[int, tuple[Floats, float]] = {}

    def detect(picture: Picture, origin: Floats) -> dict[int, Floats]:
        corners, ids, _ = detector.detectMarkers(np.ascontiguousarray(picture))
        if not len(corners):  # then some versions give no array of numbers
            return {}
        return {
            int(number): np.asarray(corner[0], dtype=np.float64) + origin
            for number, corner in zip(ids.ravel(), corners, strict=True)
        }

    def find(picture: Picture) -> Floats | None:
        found: dict[int, Floats] = {}
        for number, (middle, size) in last.items():
            reach = _TAG_SEARCH * size
            low = np.maximum(middle - reach, 0).astype(int)
            high = (middle + reach).astype(int)
            near = detect(picture[low[1] : high[1], low[0] : high[0]], low.astype(np.float64))
            if number in near:
                found[number] = near[number]
        if not {lower_id, upper_id} <= found.keys():
            found = detect(picture, np.zeros(2))
        last.clear()
        if not {lower_id, upper_id} <= found.keys():
            return None
        middles = []
        for number in (lower_id, upper_id):
            middle = _intersect_diagonals(found[number])
            last[number] = middle, float(np.ptp(found[number], axis=0).max())
            middles.append(middle)
        return np.stack(middles)

    return find


def _intersect_diagonals(corners: Floats) -> Floats:
    """Return the middle of a square in perspective: where its diagonals meet."""
    first, second = corners[2] - corners[0], corners[3] - corners[1]
    part = np.linalg.solve(np.stack([first, -second], axis=1), corners[1] - corners[0])
    return np.asarray(corners[0] + part[0] * first)


def make_dot_finder(colour: str, film: FilmInfo) -> FindMarkers:
    """Make a finder of two dots, the lower one first; of three it is not known which are meant.

    Args:
        colour: `bright`, or a name of `_COLOURS_HUE`.
        film: facts of the film.

    Raises:
        UsageError: no such colour.
    """
    import cv2

    if colour != "bright" and colour not in _COLOURS_HUE:
        raise UsageError(
            f"no dots of the colour {colour!r}", expected=", ".join(("bright", *_COLOURS_HUE))
        )

    area_max_px = _DOT_AREA_MAX * film.width_px * film.height_px
    away = np.abs((np.arange(256) - _COLOURS_HUE.get(colour, 0) + 90) % 180 - 90)
    is_hue = np.where(away <= _HUE_WITHIN, 255, 0).astype(np.uint8)

    def weigh(picture: Picture) -> npt.NDArray[Any]:
        """Return how much each pixel belongs to a dot: its light, or where it fits its colour."""
        if colour == "bright":
            bright = cv2.threshold(picture, _BRIGHT_MIN - 1, 255, cv2.THRESH_TOZERO)
            return np.asarray(bright[1])
        hsv = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_BGR2HSV)
        fits = cv2.inRange(hsv, (0, _SATURATION_MIN, _VALUE_MIN), (255, 255, 255))
        fits = cv2.bitwise_and(fits, cv2.LUT(hsv[..., 0], is_hue))
        return np.asarray(cv2.bitwise_and(hsv[..., 1], fits))

    def find(picture: Picture) -> Floats | None:
        whole = weigh(picture)
        left, top, width, height = cv2.boundingRect(whole)
        weights = np.ascontiguousarray(whole[top : top + height, left : left + width])
        if not weights.size:
            return None
        _, labels, stats, _ = cv2.connectedComponentsWithStats(weights)
        areas = stats[1:, cv2.CC_STAT_AREA].astype(np.float64)
        sizes = stats[1:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
        is_dot = (areas >= _DOT_AREA_MIN_PX) & (areas <= area_max_px)
        is_dot &= areas >= _DOT_ROUNDNESS * math.pi / 4 * sizes**2
        dots = np.flatnonzero(is_dot) + 1
        if len(dots) != 2:
            return None
        places = np.stack([_weighted_middle(weights, labels, stats, int(dot)) for dot in dots])
        return np.asarray(places[np.argsort(-places[:, 1])] + np.array([left, top]))

    return find


def _weighted_middle(
    weights: npt.NDArray[Any], labels: npt.NDArray[Any], stats: npt.NDArray[Any], dot: int
) -> Floats:
    x, y, width, height = (int(value) for value in stats[dot, :4])
    part = slice(y, y + height), slice(x, x + width)
    inside = np.where(labels[part] == dot, weights[part].astype(np.float64), 0.0)
    total = inside.sum()
    return np.array(
        [
            x + inside.sum(axis=0) @ np.arange(width) / total,
            y + inside.sum(axis=1) @ np.arange(height) / total,
        ]
    )


def undistort(places_px: Floats, lens: Lens) -> Floats:
    """Remove the lens's distortion from places (n, 2, 2); unknown ones stay so."""
    import cv2

    points = places_px.reshape(-1, 1, 2).copy()
    seen = np.isfinite(points).all(axis=(1, 2))
    if seen.any():
        points[seen] = cv2.undistortPoints(
            points[seen], lens.matrix, lens.distortion, P=lens.matrix
        )
    return points.reshape(places_px.shape)


def calibrate_lens(
    path: Path,
    columns: int,
    rows: int,
    film: FilmInfo,
    on_picture: Callable[[int], None] = lambda _: None,
) -> Lens:
    """Compute a camera's lens from a film of a checkerboard.

    Args:
        path: film in which the board is held in many ways before the camera.
        columns: inner corners along a row.
        rows: inner corners along a column.
        film: the film that the lens is for.
        on_picture: called with the number of each picture.

    Raises:
        FileFormatError: the board is seen too rarely, or in pictures of another size.
    """
    import cv2

    size = film.width_px, film.height_px
    boards, _ = read_film(path)
    if (boards.width_px, boards.height_px) != size:
        raise FileFormatError(
            f"its pictures have {boards.width_px} x {boards.height_px} pixels",
            where=str(path),
            expected=f"{size[0]} x {size[1]}, as the film of the leg",
        )
    board = np.zeros((columns * rows, 3), np.float32)
    board[:, :2] = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    step = max(1, -(-boards.picture_count // _BOARDS_MAX))
    corners = []
    for index, picture in iterate_pictures(path, is_grey=True):
        on_picture(index)
        if index % step == 0:
            is_found, places = cv2.findChessboardCornersSB(
                np.ascontiguousarray(picture), (columns, rows)
            )
            if is_found:
                corners.append(places.astype(np.float32))
    if len(corners) < _BOARDS_MIN:
        raise FileFormatError(
            f"the checkerboard of {columns} x {rows} inner corners is in {len(corners)} pictures",
            where=str(path),
            expected=f"at least {_BOARDS_MIN}, tilted differently",
        )
    _, matrix, distortion, _, _ = cv2.calibrateCamera(
        [board] * len(corners), corners, size, None, None
    )
    return Lens(np.asarray(matrix), np.asarray(distortion))
