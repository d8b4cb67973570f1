"""`denoise` on whole columns, each tile on its own."""

from __future__ import annotations

import math

import numpy as np

from devices.arrays import Floats, Times
from devices.jit import jit_cached
from service.estimation.models import denoise


@jit_cached
def denoised(
    values: Floats,
    sigmas: Floats,
    t_ns: Times,
    frame_t_ns: Times,
    at_ns: Times,
    run: Times,
    look_ns: int,
    noise_left: Floats,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Averages of `denoise.denoise_sample` for every value, (n, tiles); NaN where there is none.

    Args:
        values: (n, tiles), NaN where there is none.
        sigmas: (n, tiles), standard deviation of a single one.
        t_ns: (n, tiles), instants of the samples.
        frame_t_ns: (n,), of the frames, which bound the windows.
        at_ns: (n, tiles), the instants that are asked for.
        run: (n,), number of the unbroken run that a frame belongs to.
        look_ns: look-ahead.
        noise_left: (tiles, `WINDOW_READINGS_MAX` + 1).
    """
    n, tiles = values.shape
    out = np.full((4, n, tiles), math.nan)
    columns, scratch, rows = (values, sigmas, t_ns, run), np.empty(denoise.SCRATCH_SHAPE), (0, 0)
    for i in range(n):
        rows = denoise.find_oldest_and_newest_window_rows(frame_t_ns, i, n, rows, look_ns)
        for j in range(tiles):
            if not math.isnan(values[i, j]):
                found, _ = denoise.denoise_sample(
                    columns, i, j, at_ns[i, j], rows, noise_left[j], denoise.ALL_ROWS, scratch
                )
                for part in range(4):
                    out[part, i, j] = found[part]
    return out[0], out[1], out[2], out[3]
