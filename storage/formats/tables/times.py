"""Times of samples, where a device has rounded them."""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats

SAMPLES_MIN = 10
WITHIN_STEPS = 1.5
"""Stamps lie within so many of their smallest steps of an even line, or are not of an even rate."""


def spread_even(time_s: Floats) -> tuple[Floats, str]:
    """Spread stamps evenly that are rounded, so that some repeat; else return them as they are.

    That is done only where the rate is plain: no stamp falls, and all lie on an even line, but for
    the rounding.

    Returns:
        The times, and a note of what was done; empty: nothing.
    """
    steps_s = np.diff(time_s)
    repeated = int((steps_s == 0.0).sum())
    if not repeated or len(time_s) < SAMPLES_MIN or not (steps_s >= 0.0).all():
        return time_s, ""
    since_s = time_s - time_s[0]
    number = np.arange(len(time_s))
    step_s, begin_s = np.polyfit(number, since_s, 1)
    even_s = begin_s + step_s * number
    if np.ptp(since_s - even_s) > WITHIN_STEPS * float(steps_s[steps_s > 0.0].min(initial=np.inf)):
        return time_s, ""
    note = f"{repeated} of {len(time_s)} times are repeated, as rounding makes them: all are spread"
    return time_s[0] + even_s, f"{note} evenly, at {1.0 / step_s:.6g} Hz"
