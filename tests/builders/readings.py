"""A model on its own: the readings of one tile, one after the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from service.estimation.records import Records


def through(
    kernel: Callable[..., Any], laws: Records | None, state: Records, *columns: Any
) -> np.ndarray:
    """What a model makes of readings; its state moves on.

    Args:
        kernel: of the model.
        laws: (1,), constants of the tile; None for a model that has none.
        state: (1,), of the tile.
        columns: (n,), what the kernel takes of each reading, or one value for all.
    """
    tile = (state[0],) if laws is None else (laws[0], state[0])
    rows = zip(*np.broadcast_arrays(*columns), strict=True)
    return np.array([kernel(*tile, *row) for row in rows])
