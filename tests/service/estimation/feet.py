"""What tests of the estimator share: where tiles lie, and a load that is held."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SQUARE = [(0.0, 0.0, -0.15), (0.02, 0.0, -0.15), (0.0, 0.01, -0.15), (0.02, 0.01, -0.15)]

COP = ("cop_x_m", "cop_y_m", "cop_sigma_x_m", "cop_sigma_y_m", "cop_index_x", "cop_index_y")


def held(forces_n: Sequence[float], rows: int = 12) -> np.ndarray:
    """The same forces for so many frames, 2 ms each: with 12, contact is believed at the end."""
    return np.tile(np.array(forces_n, dtype=np.float64), (rows, 1))
