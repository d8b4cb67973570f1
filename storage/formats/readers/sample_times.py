"""Sample times that a device has rounded."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from devices.arrays import Floats

SAMPLES_MIN = 10
DEVIATION_MAX_STEPS = 1.5
"""Largest deviation from a constant rate, in smallest steps of the times."""


class SpacedTimes(NamedTuple):
    """Times (n,), and a note about a change; empty: unchanged."""

    time_s: Floats
    note: str


def respace_rounded_times_evenly(time_s: Floats) -> SpacedTimes:
    """Replace all times by times at a constant rate if rounding made some of them equal.

    Times are returned unchanged unless the rate is clear: no time falls, and all deviate from a
    constant rate by rounding only.
    """
    steps_s = np.diff(time_s)
    repeated = int((steps_s == 0.0).sum())
    if not repeated or len(time_s) < SAMPLES_MIN or not (steps_s >= 0.0).all():
        return SpacedTimes(time_s, "")
    since_s = time_s - time_s[0]
    number = np.arange(len(time_s))
    step_s, begin_s = np.polyfit(number, since_s, 1)
    even_s = begin_s + step_s * number
    if np.ptp(since_s - even_s) > DEVIATION_MAX_STEPS * float(
        steps_s[steps_s > 0.0].min(initial=np.inf)
    ):
        return SpacedTimes(time_s, "")
    note = f"{repeated} of {len(time_s)} times are repeated, as rounding makes them: all are spread"
    return SpacedTimes(time_s[0] + even_s, f"{note} evenly, at {1.0 / step_s:.6g} Hz")
