"""Where a label goes in a crowded plot."""

from __future__ import annotations

import math
from collections.abc import Sequence

Box = tuple[float, float, float, float]
"""Left, bottom, right, top in pixels."""

_NEAREST_PX, _FARTHEST_PX, _STEP_PX = 11, 240, 6
_TURNS = 16
# Right, left, above, below first: that is where a reader looks.
_ORDER = sorted(range(_TURNS), key=lambda turn: (turn % 8 != 0, turn % 4 != 0, turn % 2 != 0, turn))


def free_place(
    at: tuple[float, float],
    size: tuple[float, float],
    taken: Sequence[Box],
    inside: Box,
) -> tuple[float, float]:
    """Where the lower left corner of a text goes, relative to what it names; all in pixels.

    The nearest place at which it covers nothing; if there is none, the one that covers least.

    Args:
        at: what it names.
        size: width and height of the text.
        taken: boxes that are to be left free.
        inside: box in which the text has to be.
    """
    width, height = size
    best, least = (0.0, 0.0), math.inf
    for away in range(_NEAREST_PX, _FARTHEST_PX, _STEP_PX):
        for turn in _ORDER:
            angle = 2.0 * math.pi * turn / _TURNS
            dx = math.cos(angle) * (away + width / 2) - width / 2
            dy = math.sin(angle) * (away + height / 2) - height / 2
            left, bottom = at[0] + dx, at[1] + dy
            box = (left, bottom, left + width, bottom + height)
            if left < inside[0] or bottom < inside[1] or box[2] > inside[2] or box[3] > inside[3]:
                continue
            covered = sum(_overlap(box, other) for other in taken)
            if covered == 0.0:
                return dx, dy
            if covered < least:
                best, least = (dx, dy), covered
    return best


def _overlap(a: Box, b: Box) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    return width * height if width > 0 and height > 0 else 0.0
