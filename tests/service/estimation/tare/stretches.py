"""Forces on two tiles in stretches of a second, for tares."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

RATE_HZ = 500
KINDS = ("unloaded", "loaded", "one tile loaded", "moving", "silent")


def draw_noise(n: int, tiles: int = 2, seed: int = 0) -> np.ndarray:
    """Draw noise of about one count with the rounding, as on the rig."""
    return np.random.default_rng(seed).normal(0.0, 0.9, (n, tiles))


def draw_stretches(kinds: Sequence[str], seed: int = 0) -> np.ndarray:
    """Draw a second of forces on two tiles for each of these `KINDS`, "sucked at" or "swinging"."""
    forces_n = draw_noise(RATE_HZ * len(kinds), seed=seed).reshape(len(kinds), RATE_HZ, 2)
    for second_n, kind in zip(forces_n, kinds, strict=True):
        if kind == "loaded":
            second_n[:] += 40.0
        elif kind == "one tile loaded":
            second_n[:, 1] += 25.0  # 3.2 kPa
        elif kind == "sucked at":
            second_n[:] -= 15.0
        elif kind in ("moving", "swinging"):
            swing = np.sin(2 * np.pi * 3.0 * np.arange(RATE_HZ) / RATE_HZ)
            # Around the baseline only its motion shows.
            second_n[:, 0] += 15.0 * np.abs(swing) + 3.0 if kind == "moving" else 6.0 * swing
        elif kind == "silent":
            second_n[::20, 1] = np.nan
    return forces_n.reshape(-1, 2)
