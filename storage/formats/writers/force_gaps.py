"""Gaps of the force, for a format without a value for unknown numbers.

A short gap is bridged by a straight line, which the file lists. A long one is not filled: no file
is written, or the file ends before it. An unknown force is never 0; in flight it is 0.

Limits: in simulated stances (walks, jumps, hops, mud) a line over 50 ms within a stance has an RMS
error of 0.3 to 1.4 % of the peak, in the median of random places. Over a begin or end of contact
it has 2 to 17 %, over 20 ms there 0.5 to 9 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from devices.arrays import Bools, Floats
from devices.errors import UsageError
from devices.flags import EstimateFlag
from storage.formats.export import Export
from storage.formats.writers.resampling import GroundReaction, make_resampling

BRIDGED_NS = 50_000_000
"""Longest bridged gap with contact on both sides, or with flight: the foot cannot have been lifted
and put down again in it (`service.estimation.LONG_GAP_NS`)."""
BRIDGED_EDGE_NS = 20_000_000
"""Longest bridged gap in which contact begins or ends."""
_HIDES_PEAK = EstimateFlag.SATURATED | EstimateFlag.CLIPPED
"""Flags of frames whose force is above a bound: a line would be below it."""
_LIMITS = (
    f"limit {BRIDGED_NS * 1e-6:g} ms, {BRIDGED_EDGE_NS * 1e-6:g} ms where contact begins or ends "
    "in it; none over a saturated tile"
)
_SLICE_DIGITS = 3


@dataclass(frozen=True)
class BridgedForce:
    """GRF of a session at n samples; short gaps are bridged.

    Attributes:
        force_n: (n,), 0 in flight; NaN in long gaps, and outside the first and last known force.
        is_bridged: (n,), True on a line across a gap.
        gaps_s: lengths of the bridged gaps, between the frames beside them.
    """

    force_n: Floats
    is_bridged: Bools
    gaps_s: Floats


def bridge_force_gaps(reaction: GroundReaction) -> BridgedForce:
    """Return the force at the samples, with lines across short gaps."""
    frame_n = reaction.frame_contact_grf_n
    at = np.flatnonzero(np.isfinite(frame_n))
    steps_ns = np.diff(reaction.t_ns[at])
    has_edge = np.diff(reaction.is_frame_unloaded[at]) != 0
    is_short = steps_ns <= np.where(has_edge, BRIDGED_EDGE_NS, BRIDGED_NS)
    hidden = np.cumsum((reaction.columns["estimate_flags"] & _HIDES_PEAK) != 0)
    is_short &= hidden[at[1:] - 1] == hidden[at[:-1]]
    if "part" in reaction.columns:
        is_short &= np.diff(reaction.columns["part"][at].astype(np.int64)) == 0
    is_next = (np.diff(at) == 1) & reaction.is_consecutive[at[:-1]]
    bridges = make_resampling(reaction.resampling.axis, reaction.t_ns[at], is_next | is_short)
    known_n = reaction.resampling.interpolate(frame_n)
    known_n[reaction.resample_column("contact") == 0.0] = 0.0
    is_known = np.isfinite(known_n)
    force_n = np.where(is_known, known_n, bridges.interpolate(frame_n[at]))
    return BridgedForce(
        force_n, np.isfinite(force_n) & ~is_known, steps_ns[is_short & ~is_next] * 1e-9
    )


def fill_point_gaps(reaction: GroundReaction, frame_points_m: Sequence[Floats]) -> list[Floats]:
    """Return coordinates of the point of application at all samples, (n,) each.

    Within a stance the point is on lines between the stated ones; before the first of a stance and
    after its last it is that one, so that no load acts at a point of another stance. In flight it
    is on a line to the next stance.

    Args:
        reaction: ground reaction; at least one frame has a point.
        frame_points_m: (m,) each, NaN where no point is stated.
    """
    since_ns = (reaction.t_ns - reaction.resampling.axis.begin_ns).astype(np.float64)
    at = np.flatnonzero(np.isfinite(frame_points_m).all(axis=0))
    flights = np.cumsum(reaction.is_frame_unloaded)
    number = flights[at]
    first = np.append(True, number[1:] != number[:-1])
    last = np.append(first[1:], True)
    # The frames in flight beside each stance.
    begins = np.searchsorted(flights, number[first])
    ends = np.minimum(np.searchsorted(flights, number[last] + 1), len(flights) - 1)
    frames = np.concatenate([begins, at, ends])
    values = np.concatenate([at[first], at, at[last]])
    order = np.lexsort((values, frames))
    due_ns = reaction.resampling.elapsed_s * 1e9
    filled = []
    for frame_m in frame_points_m:
        steady_m = reaction.resampling.interpolate(frame_m)
        line_m = np.interp(due_ns, since_ns[frames[order]], frame_m[values[order]])
        filled.append(np.where(np.isfinite(steady_m), steady_m, line_m))
    return filled


@dataclass(frozen=True)
class TrialRows:
    """Rows of a file in which the force of every foot is known.

    Attributes:
        rows: the rows, of n samples.
        text: description of bridged gaps and left out rows, for file and command.
        is_remarkable: True if anything was bridged or left out.
    """

    rows: slice
    text: str
    is_remarkable: bool


def select_trial_rows(
    reactions: Sequence[GroundReaction], forces: Sequence[BridgedForce], exports: Sequence[Export]
) -> TrialRows:
    """Select the rows between the first and the last known force of all feet.

    Args:
        reactions: ground reactions on one time axis, one for each foot.
        forces: their forces.
        exports: their exports; the option `long_gap` says what a long gap does.

    Raises:
        UsageError: a long gap lies between, unless it ends the file; or there are no such rows.
    """
    time_s = reactions[0].resampling.elapsed_s
    is_known = np.logical_and.reduce([np.isfinite(force.force_n) for force in forces])
    edges = np.diff(np.concatenate([[False], is_known, [False]]).astype(np.int8))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    where = " and ".join(export.session_and_node_text for export in exports)
    if not len(begins):
        raise UsageError(
            "at no instant do all feet have a force",
            where=where,
            expected="sessions that were recorded together",
        )
    gaps_s = time_s[begins[1:]] - time_s[ends[:-1] - 1]
    if len(gaps_s) and exports[0].options.long_gap != "end":
        raise _refuse_long_gaps(reactions[0], exports[0], begins, ends, gaps_s, where)
    rows = slice(int(begins[0]), int(ends[0]))
    bridged_s = np.concatenate([force.gaps_s for force in forces])
    longest = f", the longest {bridged_s.max() * 1e3:.1f} ms" if len(bridged_s) else ""
    text = f"{len(bridged_s)} gaps of the force are straight lines{longest} ({_LIMITS})"
    begin_s, end_s = time_s[rows.start], time_s[rows.stop - 1]
    if len(gaps_s):
        text += f"; the file ends at {end_s:.3f} s, before a gap of {gaps_s[0]:.3f} s"
        text += f", {time_s[-1] - end_s:.3f} s before the session's end"
    elif rows != slice(0, len(time_s)):
        text += f"; rows from {begin_s:.3f} s to {end_s:.3f} s of {time_s[-1]:.3f} s: "
        text += "the force is not known before and after"
    is_remarkable = bool(len(bridged_s)) or rows != slice(0, len(time_s))
    return TrialRows(rows, text, is_remarkable)


def _refuse_long_gaps(
    reaction: GroundReaction,
    export: Export,
    begins: np.ndarray,
    ends: np.ndarray,
    gaps_s: Floats,
    where: str,
) -> UsageError:
    """Return the error that names the longest slice without a long gap."""
    time_s = reaction.resampling.elapsed_s
    zero_s = reaction.compute_slice_time_s(export)
    worst, best = int(np.argmax(gaps_s)), int(np.argmax(ends - begins))
    from_s, to_s = (zero_s + time_s[row] for row in (begins[best], ends[best] - 1))
    scale = 10**_SLICE_DIGITS
    count = f"{len(gaps_s)} gaps of the force are" if len(gaps_s) > 1 else "a gap of the force is"
    return UsageError(
        f"{count} too long for a line, the longest {gaps_s[worst]:.3f} s at "
        f"{zero_s + time_s[ends[worst] - 1]:.3f} s, and this format has no value for unknown",
        where=where,
        expected=f"a slice without, the longest from {np.ceil(from_s * scale) / scale:.3f} s to "
        f"{np.floor(to_s * scale) / scale:.3f} s",
        remedy="Ask for long_gap=end (--long-gap end), which ends the file before the first one",
    )
