"""Code of a lamp on the robot: a function of the node's clock alone, so that a film tells its time.

A maximum length sequence of 2^15 - 1 bits (x^15 + x^14 + 1) of 93 ms each, which repeats after 51
minutes. 93 ms is a multiple of no usual picture's interval, so edges of the code fall on all phases
of it.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

BIT_NS = 93_000_000
"""Duration of a bit."""
_ORDER = 15
CODE_BITS = 2**_ORDER - 1
LAMP_LATE_NS = 1_000_000
"""Bound of the mean lateness of the lamp's switches: beyond it the node warns."""


@cache
def make_code() -> npt.NDArray[np.int8]:
    """Make the code, (`CODE_BITS`,), of 0 and 1."""
    bits = np.ones(CODE_BITS, dtype=np.int8)
    for i in range(_ORDER, CODE_BITS):
        bits[i] = bits[i - _ORDER] ^ bits[i - _ORDER + 1]
    return bits


def is_lamp_on(t_mono_ns: int) -> bool:
    """Return whether the lamp is on at an instant of the node's CLOCK_MONOTONIC."""
    return bool(make_code()[t_mono_ns // BIT_NS % CODE_BITS])
