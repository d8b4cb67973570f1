"""Contact: a Schmitt trigger on the foot's force, with debounce.

The force is that on all domes, without creep and loop that loads before left. It is the greater of
two: that of the frame's instant, and the sum of the readings as they are, which tiles sample within
some milliseconds after it. Its thresholds are multiples of the unloaded noise, or shares of the
greatest recent force if these are more: models leave a share of each load.

A change is accepted if it lasts `contact_min_ns`, and is then dated back to its beginning within
the look-ahead: with a look-ahead of at least `contact_min_ns` contact begins with the first loaded
frame. Until the first decision contact is unknown.
"""

from __future__ import annotations

import math

from devices.flags import CONTACT_UNKNOWN
from devices.jit import jit_cached, jit_inlined
from service.estimation.pipeline.params import FootParams
from service.estimation.pipeline.smoothing_stage import TileForce
from service.estimation.pipeline.state import ContactState, FrameBuffer
from service.estimation.records import RecordArray

_PEAK_TAU_NS = 10e9
"""Time constant with which the greatest recent force is forgotten, as creep of 10 s is."""


@jit_inlined
def update_contact(
    foot_params: FootParams,
    state: ContactState,
    buffer: FrameBuffer,
    i: int,
    end: int,
    forces: RecordArray[TileForce],
) -> None:
    """Update contact and its candidate with row `i`.

    Args:
        foot_params: of the estimate.
        state: after the row before; updated.
        buffer: with all rows of the look-ahead.
        i: row.
        end: row after the last that the sample stage has processed.
        forces: (tiles,), of row `i`; their corrections hold for the rows within the look-ahead.
    """
    t_ns, dome_n, correction_n = buffer.t_mono_ns, 0.0, 0.0
    for j in range(len(forces)):
        if not math.isnan(forces[j].dome_n):
            dome_n += forces[j].dome_n
            correction_n += forces[j].correction_n
    force_n = max(dome_n, buffer.contact_n[i] + correction_n)
    peak_n = state.peak_n * math.exp(-max(0, t_ns[i] - state.peak_ns) / _PEAK_TAU_NS)
    if peak_n < force_n < math.inf:
        peak_n = state.peak_n = force_n
        state.peak_ns = t_ns[i]
    on_n = max(foot_params.contact_on_n, foot_params.contact_on_share * peak_n)
    off_n = max(foot_params.contact_off_n, foot_params.contact_off_share * peak_n)
    is_bound = buffer.rows[i].is_contact_bound == 1
    loaded = _trigger(on_n, off_n, state.is_loaded, force_n, is_bound)
    if loaded != state.is_loaded or buffer.rows[i].after_contact_pause == 1:
        state.since_ns = t_ns[i]
    state.is_loaded = loaded
    if loaded == state.is_contact:
        return
    k, last_ns = i, t_ns[i] + foot_params.lookahead_ns
    while t_ns[k] - state.since_ns < foot_params.contact_min_ns:
        k += 1
        if k == end or t_ns[k] > last_ns or buffer.rows[k].after_contact_pause == 1:
            return
        force_n, is_bound = buffer.contact_n[k] + correction_n, buffer.rows[k].is_contact_bound == 1
        if _trigger(on_n, off_n, loaded, force_n, is_bound) != loaded:
            return
    state.is_contact = loaded


@jit_cached
def _trigger(on_n: float, off_n: float, loaded: int, force_n: float, is_bound: bool) -> int:
    """Return the candidate after a force; a lower bound can prove contact, never its absence.

    A force between the thresholds leaves the candidate as it is; the first one is no load.
    """
    if force_n >= on_n:
        return 1
    if is_bound:
        return loaded
    return 0 if force_n <= off_n or loaded == CONTACT_UNKNOWN else loaded
