"""Frames in, estimates out: one code path for ten rows live and ten million offline.

`step` takes the next frames and gives the estimates that are now due, `finish` those that are left.
Estimates come `lag` later than their frames, in order, exactly one per frame. Any way of cutting a
recording into batches gives the same bits: nothing here is summed over time, multiplied as a
matrix, or dependent on how rows lie in memory.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from devices.arrays import Bools, Floats
from devices.frames import FrameBatch
from devices.temperature import HeldTemperature, hold_temperature
from service.estimation.estimates import COP_COLUMNS, Estimates, EstimateStatus
from service.estimation.foot.contact import (
    UNKNOWN,
    UNLOADED,
    UNSEEN_NS,
    RunState,
    believed,
    seeming,
)
from service.estimation.foot.geometry import angle_rad, to_ground_x_m
from service.estimation.foot.kinematics import Readings, counts_at, readings_of
from service.estimation.ladder.averaged import summed
from service.estimation.ladder.lower import (
    LowerState,
    Pending,
    PendingFrames,
    apparent_forces,
    tile_kpa,
)
from service.estimation.ladder.plan import SIGMAS, EstimationPlan
from service.estimation.ladder.upper import Foot, UpperState, foot_of, grid_index, tile_forces

HULL_SIGMAS = 3.0  # noise about the edge of the tiles is no reason to mask


@dataclass(frozen=True)
class EstimationState:
    """What `step` hands on to the next `step`. Begin with `EstimationState()`."""

    pending: Pending | None = None
    waiting: FrameBatch | None = None
    """The last frame, if it waits for the next one to show whether it is an outlier."""
    before_kpa: Floats | None = None
    """Pressures of the frame before it."""
    temperature: HeldTemperature | None = None
    lower: LowerState = LowerState()  # noqa: RUF009  # frozen, so one for all is safe
    upper: UpperState = UpperState()  # noqa: RUF009  # likewise
    contact_run: RunState = UNLOADED
    contact: int = 0
    runs: int = 0
    last_seq: int | None = None
    last_t_ns: int = 0
    last_reading: Readings | None = None
    """One row."""


def step(
    plan: EstimationPlan, frames: FrameBatch, state: EstimationState
) -> tuple[Estimates, EstimationState]:
    """Take the next frames, in order; return the estimates that are due.

    Args:
        plan: constants of this estimate.
        frames: n frames with rising `seq` and `t_mono_ns`.
        state: from the step before.

    Returns:
        The estimates due (any number, possibly none), and the state for the next step.
    """
    if not len(frames):
        return _no_estimates(plan), state
    frames, temperature = hold_temperature(frames, state.temperature)
    state = replace(state, temperature=temperature)
    newest_ns = int(frames.t_mono_ns[-1])
    if plan.waits:
        if state.waiting is not None:
            frames = FrameBatch.concatenate([state.waiting, frames])
        state = replace(state, waiting=frames.rows(len(frames) - 1, len(frames)))
        state = _taken(plan, frames, len(frames) - 1, state)
    else:
        state = _taken(plan, frames, len(frames), state)
    pending = state.pending
    if pending is None:
        return _no_estimates(plan), state
    t_mono_ns = pending.forces.t_mono_ns[pending.first :]
    due = int(np.searchsorted(t_mono_ns, newest_ns - plan.lag_ns, side="right"))
    return _release(plan, pending, due, state)


def finish(plan: EstimationPlan, state: EstimationState) -> Estimates | None:
    """The estimates that still wait for their look-ahead, at the end; None if none wait."""
    if state.waiting is not None:
        state = _taken(plan, state.waiting, 1, state)
    pending = state.pending
    if pending is None or not len(pending.frames.seq):
        return None
    estimates, _ = _release(plan, pending, len(pending.frames.seq), state)
    return estimates


def _taken(
    plan: EstimationPlan, frames: FrameBatch, n: int, state: EstimationState
) -> EstimationState:
    """Add the first `n` of `frames` to those pending; later frames show their outliers."""
    broken = _after_gap(plan, frames, state)
    kpa = tile_kpa(plan, frames)
    neighbours = None
    if plan.waits:
        none = np.full((1, kpa.shape[1]), np.nan)
        first = none if state.before_kpa is None else state.before_kpa
        before = np.where(broken[:, None], np.nan, np.concatenate([first, kpa[:-1]]))
        after = np.concatenate([np.where(broken[1:, None], np.nan, kpa[1:]), none])
        neighbours = before[:n], after[:n]
    if not n:
        return state
    frames, broken = frames.rows(0, n), broken[:n]
    run = state.runs + np.cumsum(broken)
    forces, lower = apparent_forces(plan, frames, kpa[:n], neighbours, broken, run, state.lower)
    loaded, since_ns, contact_run = seeming(
        plan.contact,
        _loading_n(plan, forces.apparent_n),
        frames.t_mono_ns,
        _unseen(frames, state),
        state.contact_run,
    )
    readings = None
    if plan.info.servo is not None:
        turn = plan.info.servo.counts_per_turn
        readings = readings_of(frames, broken, state.last_reading, turn)
    new = Pending(forces, PendingFrames(frames.seq, frames.t_ns, loaded, since_ns), readings)
    return replace(
        state,
        pending=new if state.pending is None else state.pending.followed_by(new),
        before_kpa=kpa[n - 1 : n],
        lower=lower,
        contact_run=contact_run,
        runs=int(run[-1]),
        last_seq=int(frames.seq[-1]),
        last_t_ns=int(frames.t_mono_ns[-1]),
        last_reading=None if readings is None else readings.rows(n - 1, n),
    )


def _release(
    plan: EstimationPlan, pending: Pending, due: int, state: EstimationState
) -> tuple[Estimates, EstimationState]:
    """Estimate the next `due` frames of `pending`, now that their look-ahead is there."""
    if not due:
        return _no_estimates(plan), state
    forces, frames, first = pending.forces, pending.frames, pending.first
    stop = first + due
    tiles, upper = tile_forces(plan, forces, first, stop, state.upper)
    foot = foot_of(plan, tiles)
    contact = believed(
        plan.contact,
        plan.look_ns,
        due,
        frames.loaded,
        frames.since_ns,
        forces.t_mono_ns[first:],
        state.contact,
    )
    masked = _cop_masked(plan, foot) | (contact == 0)
    # A bound tells that there is contact, and never that there is none.
    decided = ~np.isnan(foot.grf_n) | ((contact == 1) & (foot.at_least_n >= plan.contact.on_n))
    gauge_kpa = forces.gauge_kpa[first:stop]
    index_x, index_y = grid_index(plan, gauge_kpa)
    x_m, y_m, z_m = foot.cop_m
    ground_x_m = ground_y_m = angle = np.full(due, np.nan)
    servo = plan.info.servo
    if servo is not None and pending.readings is not None:
        angle = angle_rad(servo, counts_at(pending.readings, due, plan.look_ns))
        travel = servo.ankle_travel_m_per_rad
        ground_x_m = to_ground_x_m(x_m, z_m, angle, travel)
        ground_y_m = y_m if travel is not None else ground_y_m

    def shown(values: Floats) -> Floats:
        return np.where(masked, np.nan, values)

    def by_tile(values: Floats) -> Floats:
        of_all = np.full(gauge_kpa.shape, np.nan)
        of_all[:, plan.bearing] = values
        return of_all

    out = Estimates(
        seq=frames.seq[:due],
        t_ns=frames.t_ns[:due],
        gauge_kpa=gauge_kpa,
        force_n=by_tile(tiles.stated_n),
        force_sigma_n=by_tile(tiles.stated_sigma_n),
        grf_n=foot.grf_n,
        grf_sigma_n=foot.grf_sigma_n,
        grf_at_least_n=foot.at_least_n,
        cop_x_m=shown(x_m),
        cop_y_m=shown(y_m),
        cop_sigma_x_m=shown(foot.cop_sigma_m[0]),
        cop_sigma_y_m=shown(foot.cop_sigma_m[1]),
        cop_index_x=shown(index_x),
        cop_index_y=shown(index_y),
        cop_ground_x_m=shown(ground_x_m),
        cop_ground_y_m=shown(ground_y_m),
        angle_rad=angle,
        contact=np.where(decided, contact, UNKNOWN).astype(np.uint8),
        estimate_status=forces.status[first:stop]
        | np.where(masked, EstimateStatus.COP_MASKED, 0).astype(np.uint16)
        | np.where(tiles.unsettled, EstimateStatus.AFTER_SATURATION, 0).astype(np.uint16),
    )
    return out, replace(
        state,
        pending=pending.after(due, reach_back=plan.ladder.denoise),
        upper=upper,
        contact=int(contact[-1]),
    )


def _no_estimates(plan: EstimationPlan) -> Estimates:
    tiles = np.empty((0, len(plan.info.tiles)))
    none = np.empty(0)
    return Estimates(
        seq=np.empty(0, dtype=np.uint64),
        t_ns=np.empty(0, dtype=np.int64),
        **dict.fromkeys(("gauge_kpa", "force_n", "force_sigma_n"), tiles),
        **dict.fromkeys(("grf_n", "grf_sigma_n", "grf_at_least_n"), none),
        **dict.fromkeys((*COP_COLUMNS, "angle_rad"), none),
        contact=np.empty(0, dtype=np.uint8),
        estimate_status=np.empty(0, dtype=np.uint16),
    )


def _cop_masked(plan: EstimationPlan, foot: Foot) -> Bools:
    """Where a centre of pressure would be more doubtful than useful."""
    normals, offsets_m = plan.hull
    (x_m, y_m, _), (sigma_x_m, sigma_y_m) = foot.cop_m, foot.cop_sigma_m
    with np.errstate(invalid="ignore"):
        good = (
            (foot.grf_n >= SIGMAS * foot.grf_sigma_n)
            & (sigma_x_m <= plan.cop_sigma_max_m)
            & (sigma_y_m <= plan.cop_sigma_max_m)
        )
        for (nx, ny), offset_m in zip(normals, offsets_m, strict=True):
            beyond_m = nx * x_m + ny * y_m - offset_m
            sigma_m = np.sqrt((nx * sigma_x_m) ** 2 + (ny * sigma_y_m) ** 2)
            # Noise about the edge is let through, or the mean of what is left would lie inside.
            good &= beyond_m <= HULL_SIGMAS * sigma_m + 1e-9
    return ~good


def _loading_n(plan: EstimationPlan, apparent_n: Floats) -> Floats:
    """Sum of the apparent forces (n,), by which contact is judged.

    If a tile is missing it is NaN, unless those that are known show contact by themselves.
    """
    total_n = summed(apparent_n)
    if np.isnan(total_n).any():
        of_known_n = summed(np.nan_to_num(apparent_n))
        total_n = np.where(
            np.isnan(total_n) & (of_known_n >= plan.contact.on_n), of_known_n, total_n
        )
    return total_n


def _unseen(frames: FrameBatch, state: EstimationState) -> Bools:
    """Frames after a pause of more than `UNSEEN_NS`: the foot may have been anywhere meanwhile.

    A few lost frames are no reason to start over: on a link that loses every third frame no contact
    would ever last.
    """
    last_t_ns = frames.t_mono_ns[0] if state.last_seq is None else state.last_t_ns
    return np.asarray(np.diff(frames.t_mono_ns, prepend=last_t_ns) > UNSEEN_NS)


def _after_gap(plan: EstimationPlan, frames: FrameBatch, state: EstimationState) -> Bools:
    # Unsigned throughout: a difference wraps, and a number of any size is compared as it is.
    first = frames.seq[:1] - np.uint64(1) if state.last_seq is None else [state.last_seq]
    before = np.concatenate([np.asarray(first, dtype=np.uint64), frames.seq[:-1]])
    last_t_ns = frames.t_mono_ns[0] if state.last_seq is None else state.last_t_ns
    late = np.diff(frames.t_mono_ns, prepend=last_t_ns) > plan.gap_ns
    return np.asarray((frames.seq - before != 1) | late)
