"""The array as a picture: the 3 x 50 matrix of the paper's figure, for plots.

Between tiles pressure is taken as linear, which no bubble says; it is for the eye, and nothing is
computed from it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from devices.errors import UsageError
from service.estimation.geometry import grid_indices

Floats = npt.NDArray[np.float64]

ROWS, COLUMNS = 3, 50


def pressure_map(
    positions_m: Floats, gauge_kpa: Floats, *, rows: int = ROWS, columns: int = COLUMNS
) -> Floats:
    """Pressure on an even grid over the array.

    Args:
        positions_m: (tiles, 2), x and y of tiles that fill a line or a grid.
        gauge_kpa: (n, tiles); NaN reaches to the tiles beside it.
        rows: across the foot, from the right (least y) to the left.
        columns: along it, from the back (least x) to the front.

    Returns:
        (n, rows, columns). All rows are alike for a line of tiles along the foot.

    Raises:
        UsageError: the tiles fill no grid.
    """
    indices = grid_indices(positions_m)
    if indices is None:
        raise UsageError(
            "the tiles fill neither a line nor a grid", remedy="Plot them where they are instead"
        )
    x, y = (index.astype(np.int64) - 1 for index in indices)
    by_place = np.empty((len(gauge_kpa), int(y.max()) + 1, int(x.max()) + 1))
    by_place[:, y, x] = gauge_kpa
    along = _spread(by_place, np.unique(np.round(positions_m[:, 0], 6)), columns, axis=2)
    return _spread(along, np.unique(np.round(positions_m[:, 1], 6)), rows, axis=1)


def _spread(values: Floats, places_m: Floats, n: int, axis: int) -> Floats:
    """Linear between places along one axis, at n even steps from the first to the last."""
    if len(places_m) == 1:
        return np.repeat(values, n, axis=axis)
    at_m = np.round(np.linspace(places_m[0], places_m[-1], n), 9)  # a place is met, or it is not
    right = np.clip(np.searchsorted(places_m, at_m, side="right"), 1, len(places_m) - 1)
    part = (at_m - places_m[right - 1]) / (places_m[right] - places_m[right - 1])
    part = part.reshape([n if i == axis else 1 for i in range(values.ndim)])
    low, high = np.take(values, right - 1, axis=axis), np.take(values, right, axis=axis)
    # A tile at the very place is all there is: one beside it that is silent is not mixed in.
    mixed = (1.0 - part) * low + part * high
    return np.where(part == 0.0, low, np.where(part == 1.0, high, mixed))
