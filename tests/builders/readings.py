"""A model on its own: the readings of one tile, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from service.estimation.models.rubber import RubberParams
from service.estimation.records import RecordArray


def make_rubber(parts: Sequence[float], tau_s: Sequence[float]) -> RecordArray[RubberParams]:
    """Parameters of a tile whose rubber creeps in these parts, with these time constants."""
    made = RubberParams.array(1, n_terms=len(parts))
    made["creep_fraction"][0, : len(parts)], made["tau_s"][0, : len(parts)] = parts, tau_s
    return made


def through(
    kernel: Callable[..., Any],
    params: RecordArray[Any] | None,
    state: RecordArray[Any],
    *columns: Any,
) -> np.ndarray:
    """Apply a model's kernel to readings, one after the other; its state is updated.

    Args:
        kernel: of the model.
        params: (1,), of the tile; None for a model without any.
        state: (1,), of the tile.
        columns: further arguments of the kernel, each (n,) or one value for all.
    """
    tile = (state[0],) if params is None else (params[0], state[0])
    rows = zip(*np.broadcast_arrays(*columns), strict=True)
    return np.array([kernel(*tile, *row) for row in rows])
