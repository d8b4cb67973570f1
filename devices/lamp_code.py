"""Code of a lamp on the robot: a function of the node's clock alone, so that a film tells its time.

A maximum length sequence of 2^20 - 1 bits (x^20 + x^17 + 1) of 93 ms each, which repeats after 27
hours. 93 ms is a multiple of no usual picture interval, so the code's edges fall on all phases of a
picture.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

BIT_NS = 93_000_000
"""Duration of a bit."""
_ORDER, _TAP = 20, 3
CODE_BITS = 2**_ORDER - 1
LAMP_LATE_NS = 1_000_000
"""Bound of the mean lateness of the lamp's switches: beyond it the node warns."""


@cache
def make_code() -> npt.NDArray[np.int8]:
    """Make the code, (`CODE_BITS`,), of 0 and 1."""
    bits = np.ones(CODE_BITS, dtype=np.int8)
    done, step = _ORDER, 1
    while done < CODE_BITS:
        # Squares of the polynomial hold, too: so ever longer runs are computed at once.
        while done >= 2 * step * _ORDER:
            step *= 2
        end = min(CODE_BITS, done + step * (_ORDER - _TAP))
        before = np.arange(done, end) - step * _ORDER
        bits[done:end] = bits[before] ^ bits[before + step * _TAP]
        done = end
    return bits


def is_lamp_on(t_mono_ns: int) -> bool:
    """Return whether the lamp is on at an instant of the node's CLOCK_MONOTONIC."""
    return bool(make_code()[t_mono_ns // BIT_NS % CODE_BITS])
