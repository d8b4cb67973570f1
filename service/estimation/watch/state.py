"""State of a watch: a record of eight-byte fields for each tile, that compiled code writes to."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

State = npt.NDArray[np.void]


def copied(state: State) -> State:
    """The same, to be written to. Copied as one piece: field by field takes four times as long."""
    return state.view(np.int64).copy().view(state.dtype)
