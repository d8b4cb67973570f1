"""Contact: a Schmitt trigger on the GRF with debounce.

A change is accepted if it lasts `min_ns`, and is then dated back to its beginning within the
look-ahead: with a lag of at least `min_ns` contact begins with the first loaded frame.
"""

from __future__ import annotations

from devices.arrays import Times
from devices.jit import jit_cached, jit_inlined
from service.estimation.records import KernelRecord


class ContactState(KernelRecord):
    """Candidate of contact; zeros before the first frame."""

    is_loaded: int
    since_ns: int


@jit_cached
def update_candidate(
    on_n: float, off_n: float, state: ContactState, grf_n: float, t_ns: int, after_gap: bool
) -> None:
    """Update the candidate of contact with the next frame.

    Args:
        on_n: force at which the candidate becomes contact.
        off_n: force at which it becomes no contact; in between it stays.
        state: after the frame before; updated.
        grf_n: NaN leaves the candidate as it is.
        t_ns: instant.
        after_gap: whether a gap precedes the frame; the candidate then starts again.
    """
    loaded = 1 if grf_n >= on_n else (0 if grf_n <= off_n else state.is_loaded)
    if loaded != state.is_loaded or after_gap:
        state.since_ns = t_ns
    state.is_loaded = loaded


@jit_inlined
def is_debounced(since_ns: Times, t_ns: Times, i: int, end: int, min_ns: int, lag_ns: int) -> bool:
    """Return whether the candidate of frame `i` lasts `min_ns` within the look-ahead.

    Args:
        since_ns: (n,), `ContactState.since_ns` after each frame.
        t_ns: (n,), instants.
        i: frame.
        end: frame after the last that is stored; all within the look-ahead must be.
        min_ns: time for which a candidate has to last.
        lag_ns: look-ahead.
    """
    at = i
    while at < end and since_ns[at] == since_ns[i] and t_ns[at] <= t_ns[i] + lag_ns:
        if t_ns[at] - since_ns[i] >= min_ns:
            return True
        at += 1
    return False
