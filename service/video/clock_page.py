"""Clock of the page `/clock`: its layout, and its time in a film of the screen.

The page is a grid of `UNITS`, white, with an ArUco tag (dictionary 4x4_50) in each corner, by which
the grid is found in perspective, and between them `CELLS` cells, black for 1. Row by row they are

    6 bits   bound of the page's offset to the server's clock, ms, rounded up; 63: more, or unknown
    6 bits   interval of the screen's refresh, ms, rounded up; 63: more, or unknown
    12 bits  check: (((n >> 6) * 64 + bound) * 64 + refresh + 1) % 4093
    32 bits  n ^ (n >> 1), Gray code of n, the server's UTC / `TICK_NS` modulo 2^32

each with its highest bit first. From tick to tick one cell of the Gray code changes. As a screen
changes at least once a tick, a picture's exposure of up to two ticks sees each of these cells
change once at most: half grey is the threshold, and the code that of the exposure's middle. So do
rows that a rolling shutter exposes one after the other. The check covers all that changes rarely;
n's last six bits are checked by the pictures around them. A tick is a multiple of no usual
picture's interval, so that pictures fall on all phases of it.

The page shows the server's time at its drawing. Light leaves the screen one to three refreshes
later, as browsers and compositors queue pictures, and a panel takes some 5 to 15 ms. This latency
is assumed, not measured, and the greater part of the uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from service.video.container import Picture

TICK_NS = 23_000_000
UNITS = (32, 18)
"""Width and height of the page."""
TAG_UNITS = 6
TAGS = {46: (1, 1), 47: (25, 1), 48: (25, 11), 49: (1, 11)}
"""Left upper corner of each tag, in units, by its number."""
CELL_UNITS = 2
CELLS_AT = (9, 1)
"""Left upper corner of the first cell."""
CELLS_PER_ROW = 7
CELLS = 56
_WIDTHS = (6, 6, 12, 32)
UNKNOWN_MS = 63
_CHECKED = 6
"""Number of n's last bits that the check does not cover."""
_CHECK_MODULUS = 4093

_CONTRAST_MIN = 40.0
"""Least difference of white and black, in steps of 1/255."""
_PX = 8
"""Pixels of a unit in the picture that is turned upright."""
_PANEL_NS = (5e6, 15e6)
_REFRESHES = (1.0, 3.0)


class ClockReading(NamedTuple):
    """Content of the clock page in a picture."""

    n: int
    """Server's UTC in ticks, modulo 2^32."""
    bound_ms: int
    refresh_ms: int


def encode_cells(reading: ClockReading) -> str:
    """Return the cells of a reading, row by row, `1` for black."""
    n, bound_ms, refresh_ms = reading
    values = (bound_ms, refresh_ms, _compute_check(reading), n ^ (n >> 1))
    return "".join(f"{value:0{width}b}" for value, width in zip(values, _WIDTHS, strict=True))


def decode_cells(cells: str) -> ClockReading | None:
    """Return the reading of cells; None: they contradict their check, or state no bounds."""
    edges = np.cumsum((0, *_WIDTHS)).tolist()
    bound_ms, refresh_ms, check, n = (int(cells[begin:end], 2) for begin, end in pairwise(edges))
    for shift in (16, 8, 4, 2, 1):
        n ^= n >> shift
    reading = ClockReading(n, bound_ms, refresh_ms)
    # Where a screen is slower than a tick, two cells change at once.
    is_stated = bound_ms < UNKNOWN_MS and 0 < refresh_ms * 1_000_000 <= TICK_NS
    return reading if is_stated and check == _compute_check(reading) else None


def _compute_check(reading: ClockReading) -> int:
    n, bound_ms, refresh_ms = reading
    return (((n >> _CHECKED) * 64 + bound_ms) * 64 + refresh_ms + 1) % _CHECK_MODULUS


def make_clock_reader() -> Callable[[Picture], ClockReading | None]:
    """Make a reader of the clock page in a grey picture; None: it is not there, or not whole."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detector = cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters())
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=np.float64) * TAG_UNITS
    places = np.concatenate([square + corner for corner in TAGS.values()]) * _PX
    grid = np.column_stack(np.divmod(np.arange(CELLS), CELLS_PER_ROW))[:, ::-1]
    cells_xy = (grid + 0.5) * CELL_UNITS + np.array(CELLS_AT)
    middles = np.array(list(TAGS.values())) + TAG_UNITS / 2
    ring = np.array([(x, y) for x in range(-4, 5) for y in range(-4, 5) if max(abs(x), abs(y)) > 3])
    reach = TAG_UNITS / 2
    white_xy = middles[:, None] + ring / 4 * (reach + 0.5)  # the margin around a tag
    black_xy = middles[:, None] + ring / 4 * (reach - 0.5)  # its border

    def read(picture: Picture) -> ClockReading | None:
        corners, ids, _ = detector.detectMarkers(np.ascontiguousarray(picture))
        numbered = np.ravel(cast("npt.NDArray[np.int32]", ids)).tolist() if len(corners) else []
        found = dict(zip(numbered, corners, strict=True))
        if not found.keys() >= TAGS.keys():
            return None
        seen = np.concatenate([found[number][0] for number in TAGS]).astype(np.float64)
        matrix, _ = cv2.findHomography(seen, places)
        size = UNITS[0] * _PX, UNITS[1] * _PX
        upright = cv2.warpPerspective(picture, matrix, size).astype(np.float64)
        # A lens shades the picture, and a screen is seen from the side: the levels are planes.
        design = np.column_stack([np.ones(len(middles)), middles])
        planes = [
            np.linalg.lstsq(design, np.median(_sample(upright, xy), axis=1), rcond=None)[0]
            for xy in (black_xy, white_xy)
        ]
        black, white = (np.column_stack([np.ones(CELLS), cells_xy]) @ plane for plane in planes)
        if np.min(white - black) < _CONTRAST_MIN:
            return None
        is_black = _sample(upright, cells_xy) < (black + white) / 2
        return decode_cells("".join(map(str, is_black.astype(int).tolist())))

    return read


def _sample(upright: Floats, at_units: Floats) -> Floats:
    """Return the mean of the unit around each place, (..., 2) in units."""
    import cv2

    mean = cv2.blur(upright, (_PX, _PX))
    column, row = np.moveaxis(np.clip(np.rint(at_units * _PX), 0, None).astype(int), -1, 0)
    height, width = mean.shape
    return np.asarray(mean[np.minimum(row, height - 1), np.minimum(column, width - 1)])


_RUN_S = 4.0
"""Longest run of pictures that gives one pair."""
_PICTURES_MIN = 5
_STRAY_TICKS = 3.0
"""Distance from the median beyond which a reading is wrong."""
_STEP_NS = 250_000.0
_WRONG = 1e-3
"""Part of readings that are wrong without being found."""


class ClockPair(NamedTuple):
    """An instant of the film and of the server's clock."""

    film_s: float
    t_ns: int
    sigma_ns: float
    """Standard deviation, by the pictures."""
    common_ns: float
    """Standard deviation of what all pairs share: latency, refresh, offset of the page's clock."""
    picture_count: int


def find_clock_pairs(
    film_s: Floats, readings: Sequence[ClockReading], near_ns: int
) -> list[ClockPair]:
    """Find pairs in the readings of pictures, one for each run of up to `_RUN_S`.

    Args:
        film_s: (pictures,), rising.
        readings: of these pictures.
        near_ns: an instant of the server's clock within a year of the film.
    """
    pairs: list[ClockPair] = []
    begin = 0
    while begin < len(film_s):
        end = int(np.searchsorted(film_s, film_s[begin] + _RUN_S))
        pair = _fit_run(film_s[begin:end], readings[begin:end], near_ns)
        if pair is not None:
            pairs.append(pair)
        begin = end
    return pairs


def _fit_run(film_s: Floats, readings: Sequence[ClockReading], near_ns: int) -> ClockPair | None:
    middle_s = float(film_s.mean())
    near = near_ns // TICK_NS
    ticks = [(reading.n - near + 2**31) % 2**32 - 2**31 for reading in readings]  # from `near`
    shown_ns = np.array(ticks, dtype=np.float64) * TICK_NS - 1e9 * (film_s - middle_s)
    is_right = np.abs(shown_ns - np.median(shown_ns)) < _STRAY_TICKS * TICK_NS
    if is_right.sum() < max(_PICTURES_MIN, len(film_s) / 2 + 1):
        return None
    shown_ns = shown_ns[is_right]
    refresh_ns = 1e6 * max(reading.refresh_ms for reading in readings)
    bound_ns = 1e6 * max(reading.bound_ms for reading in readings)
    # A tick shown is up to a refresh old: the probability of each tick is a trapezoid.
    offsets_ns = np.arange(shown_ns.min() - TICK_NS, shown_ns.max() + 2 * TICK_NS, _STEP_NS)
    age_ns = offsets_ns[:, None] - shown_ns[None, :]
    inside_ns = np.minimum(age_ns, TICK_NS) - np.maximum(age_ns - refresh_ns, 0.0)
    log_posterior = np.log(np.maximum(inside_ns / refresh_ns, 0.0) + _WRONG).sum(axis=1)
    weight = np.exp(log_posterior - log_posterior.max())
    weight /= weight.sum()
    offset_ns = float(weight @ offsets_ns)
    variance = float(weight @ (offsets_ns - offset_ns) ** 2)
    queue_ns = refresh_ns * np.array(_REFRESHES)
    latency_ns = float(np.mean(queue_ns) + np.mean(_PANEL_NS))
    # Camera and screen may be locked in phase: then a refresh's age does not average out.
    uniform_ns = [np.ptp(queue_ns), np.ptp(_PANEL_NS), refresh_ns, 2.0 * bound_ns]
    return ClockPair(
        film_s=middle_s,
        t_ns=near * TICK_NS + round(offset_ns + latency_ns),
        sigma_ns=math.sqrt(variance + _STEP_NS**2 / 12.0),
        common_ns=math.hypot(*uniform_ns) / math.sqrt(12.0),
        picture_count=len(shown_ns),
    )
