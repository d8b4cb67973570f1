"""Names for the numpy arrays that pass between modules; shapes are in each docstring."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Times = npt.NDArray[np.int64]
"""Instants or durations in nanoseconds: int64, because float64 rounds UTC to 200 ns."""
Bools = npt.NDArray[np.bool_]
