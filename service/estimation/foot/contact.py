"""Contact: does the foot bear load? Thresholds with hysteresis, and a minimum time.

A change is believed if it lasts `min_ns`, and is then dated back to its beginning as far as the
look-ahead allows: with a lag of at least `min_ns` contact begins with the first loaded frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.arrays import Bools, Floats, Ints, Times

UNKNOWN = 255
UNSEEN_NS = 50_000_000
"""A foot that was not seen for so long may have been lifted and put down again; for less, not."""


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


@dataclass(frozen=True)
class RunState:
    """What a frame needs to know of those before it."""

    loaded: int
    since_ns: int


UNLOADED = RunState(loaded=0, since_ns=0)
"""Before the first frame."""


def seeming(
    rule: ContactRule,
    grf_n: Floats,
    t_ns: Times,
    broken: Bools,
    state: RunState,
) -> tuple[Ints, Times, RunState]:
    """Per frame whether the foot seems loaded (0 or 1), and since when it has seemed so.

    Frames without a force change nothing; at a frame that is `broken` from the one before (a gap)
    a new run begins.
    """
    with np.errstate(invalid="ignore"):
        decided = np.where(grf_n >= rule.on_n, 1, np.where(grf_n <= rule.off_n, 0, -1))
    loaded = _filled_forward(decided, decided >= 0, state.loaded)
    before = np.concatenate([[state.loaded], loaded[:-1]])
    begins = (loaded != before) | broken
    since_ns = _filled_forward(t_ns, begins, state.since_ns)
    return loaded, since_ns, RunState(int(loaded[-1]), int(since_ns[-1]))


def believed(
    rule: ContactRule,
    lag_ns: int,
    rows: int,
    loaded: Ints,
    since_ns: Times,
    t_ns: Times,
    contact: int,
) -> Ints:
    """Contact of the first `rows` frames, looking `lag_ns` ahead.

    Args:
        rule: the thresholds and the minimum time.
        lag_ns: look-ahead.
        rows: how many frames to decide; those within their look-ahead must all be here.
        loaded: per frame, from `seeming`, of these and all later frames known.
        since_ns: likewise.
        t_ns: likewise, instants.
        contact: contact of the frame before the first.
    """
    n = len(t_ns)
    changes = np.flatnonzero(since_ns[1:] != since_ns[:-1])
    run_end = np.append(changes, n - 1)[np.searchsorted(changes, np.arange(rows))]
    seen = np.searchsorted(t_ns, t_ns[:rows] + lag_ns, side="right") - 1
    lasted_ns = t_ns[np.minimum(run_end, seen)] - since_ns[:rows]
    return _filled_forward(loaded[:rows], lasted_ns >= rule.min_ns, contact)


def _filled_forward(values: Ints, valid: Bools, before: int) -> Ints:
    """Every value, or where it is not valid the last valid one."""
    last = np.maximum.accumulate(np.where(valid, np.arange(len(values)), -1))
    return np.where(last >= 0, values[last], before)
