"""Contact: does the foot bear load? Thresholds with hysteresis, and a minimum time.

A change is believed if it lasts `min_ns`, and is then dated back to its beginning as far as the
look-ahead allows: with a lag of at least `min_ns` contact begins with the first loaded frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.arrays import Times
from devices.compiled import compiled, inlined
from service.estimation.records import Record, record_type


@dataclass(frozen=True)
class ContactRule:
    """When the foot is in contact.

    Attributes:
        on_n: force above which it seems to be.
        off_n: force below which it seems not to be; in between it stays what it was.
        min_ns: how long it has to seem so.
    """

    on_n: float
    off_n: float
    min_ns: int


STATE = record_type([("loaded", np.int64), ("since_ns", np.int64)])
"""Does the foot seem loaded, and since when has it seemed so? Zeros before the first frame."""


@compiled
def seeming(
    on_n: float, off_n: float, state: Record, grf_n: float, t_ns: int, broken: bool
) -> None:
    """Whether the foot seems loaded in the next frame, and since when it has seemed so.

    Args:
        on_n: of `ContactRule`.
        off_n: likewise.
        state: from the frame before; becomes that after this one.
        grf_n: NaN changes nothing.
        t_ns: instant.
        broken: is the frame broken from the one before, by a gap? Then a new run begins.
    """
    loaded = 1 if grf_n >= on_n else (0 if grf_n <= off_n else state.loaded)
    if loaded != state.loaded or broken:
        state.since_ns = t_ns
    state.loaded = loaded


@inlined
def has_lasted(since_ns: Times, t_ns: Times, i: int, end: int, min_ns: int, lag_ns: int) -> bool:
    """Has what the foot seems to be in frame `i` lasted long enough, as far as can be seen?

    Args:
        since_ns: (n,), per frame since when it has seemed so; `seeming` tells.
        t_ns: (n,), instants.
        i: frame.
        end: frame after the last that is there; those within the look-ahead must all be.
        min_ns: of `ContactRule`.
        lag_ns: look-ahead.
    """
    at = i
    while at < end and since_ns[at] == since_ns[i] and t_ns[at] <= t_ns[i] + lag_ns:
        if t_ns[at] - since_ns[i] >= min_ns:
            return True
        at += 1
    return False
