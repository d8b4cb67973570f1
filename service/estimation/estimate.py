"""Frames in, estimates out: one code path for ten rows live and ten million offline.

`step` takes the next frames and gives the estimates that are now due, `finish` those that are left.
Estimates come `lag` later than their frames, in order, exactly one per frame. Any way of cutting a
recording into batches gives the same bits: nothing here is summed over time, multiplied as a
matrix, or dependent on how rows lie in memory.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from devices.frames import FrameBatch
from devices.temperature import HeldTemperature, hold_temperature
from service.estimation.contact import UNKNOWN, UNLOADED, RunState, believed, seeming
from service.estimation.estimates import Estimates, EstimateStatus
from service.estimation.geometry import angle_rad, to_ground_x_m
from service.estimation.instant import estimate_instants
from service.estimation.kinematics import Readings, counts_at, readings_of
from service.estimation.plan import SIGMAS, EstimationPlan

Floats = npt.NDArray[np.float64]

HULL_SIGMAS = 3.0


_COP_COLUMNS = (
    "cop_x_m",
    "cop_y_m",
    "cop_sigma_x_m",
    "cop_sigma_y_m",
    "cop_index_x",
    "cop_index_y",
    "cop_ground_x_m",
    "cop_ground_y_m",
)


@dataclass(frozen=True)
class _Pending:
    """Frames whose look-ahead is not complete."""

    estimates: Estimates
    cop_z_m: Floats
    readings: Readings | None
    """None without a servo."""
    loaded: npt.NDArray[np.int64]
    since_ns: npt.NDArray[np.int64]
    t_ns: npt.NDArray[np.int64]


@dataclass(frozen=True)
class EstimationState:
    """What `step` hands on to the next `step`. Begin with `EstimationState()`."""

    pending: _Pending | None = None
    temperature: HeldTemperature | None = None
    run: RunState = UNLOADED
    contact: int = 0
    last_seq: int | None = None
    last_t_ns: int = 0
    last_reading: Readings | None = None
    """One row."""


def step(
    plan: EstimationPlan, frames: FrameBatch, state: EstimationState
) -> tuple[Estimates, EstimationState]:
    """Take the next frames, in order; give the estimates that are due.

    Args:
        plan: constants of this estimate.
        frames: n frames with rising `seq` and `t_mono_ns`.
        state: from the step before.

    Returns:
        The estimates due (any number, possibly none), and the state for the next step.
    """
    if not len(frames):
        return estimate_instants(plan, frames, np.zeros(0, dtype=np.bool_))[0], state
    broken = _after_gap(plan, frames, state)
    frames, temperature = hold_temperature(frames, state.temperature)
    now, cop_z_m = estimate_instants(plan, frames, broken)
    loaded, since_ns, run = seeming(plan.contact, now.grf_n, frames.t_mono_ns, broken, state.run)
    readings = None
    if plan.info.servo is not None:
        turn = plan.info.servo.counts_per_turn
        readings = readings_of(frames, broken, state.last_reading, turn)
    new = _Pending(now, cop_z_m, readings, loaded, since_ns, frames.t_mono_ns)
    known = _append(state.pending, new)
    due = int(np.searchsorted(known.t_ns, known.t_ns[-1] - plan.lag_ns, side="right"))
    state = replace(
        state,
        temperature=temperature,
        run=run,
        last_seq=int(frames.seq[-1]),
        last_t_ns=int(frames.t_mono_ns[-1]),
        last_reading=None if readings is None else readings.rows(len(frames) - 1, len(frames)),
    )
    return _release(plan, known, due, state)


def finish(plan: EstimationPlan, state: EstimationState) -> Estimates | None:
    """The estimates that still wait for a look-ahead that will not come; None if none do."""
    if state.pending is None:
        return None
    known = state.pending
    estimates, _ = _release(plan, known, len(known.t_ns), state)
    return estimates


def _release(
    plan: EstimationPlan, known: _Pending, due: int, state: EstimationState
) -> tuple[Estimates, EstimationState]:
    """Give away the first `due` estimates of `known`.

    Decides their contact and where the foot stands, and masks their COP.
    """
    contact = believed(
        plan.contact, plan.lag_ns, due, known.loaded, known.since_ns, known.t_ns, state.contact
    )
    out = _placed(plan, known, due)
    in_doubt = np.isnan(out.grf_n)
    masked = _cop_masked(plan, out) | (contact == 0)
    columns = {name: np.where(masked, np.nan, getattr(out, name)) for name in _COP_COLUMNS}
    out = replace(
        out,
        **columns,
        contact=np.where(in_doubt, UNKNOWN, contact).astype(np.uint8),
        estimate_status=out.estimate_status
        | np.where(masked, EstimateStatus.COP_MASKED, 0).astype(np.uint16),
    )
    rest = len(known.t_ns) - due
    pending = None
    if rest:
        pending = _Pending(
            known.estimates.rows(due, due + rest),
            known.cop_z_m[due:],
            None if known.readings is None else known.readings.rows(due, due + rest),
            known.loaded[due:],
            known.since_ns[due:],
            known.t_ns[due:],
        )
    return out, replace(state, pending=pending, contact=int(contact[-1]) if due else state.contact)


def _placed(plan: EstimationPlan, known: _Pending, due: int) -> Estimates:
    """The first `due` estimates of `known` with the segment's angle, and COP on the ground."""
    out = known.estimates.rows(0, due)
    servo = plan.info.servo
    if servo is None or known.readings is None:
        return out
    angle = angle_rad(servo, counts_at(known.readings, due, plan.lag_ns))
    travel = servo.ankle_travel_m_per_rad
    return replace(
        out,
        angle_rad=angle,
        cop_ground_x_m=to_ground_x_m(out.cop_x_m, known.cop_z_m[:due], angle, travel),
        cop_ground_y_m=out.cop_y_m if travel is not None else out.cop_ground_y_m,
    )


def _cop_masked(plan: EstimationPlan, e: Estimates) -> npt.NDArray[np.bool_]:
    """Where a centre of pressure would be more doubtful than useful."""
    normals, offsets_m = plan.hull
    with np.errstate(invalid="ignore"):
        good = (
            (e.grf_n >= SIGMAS * e.grf_sigma_n)
            & (e.cop_sigma_x_m <= plan.cop_sigma_max_m)
            & (e.cop_sigma_y_m <= plan.cop_sigma_max_m)
        )
        for (nx, ny), offset_m in zip(normals, offsets_m, strict=True):
            beyond_m = nx * e.cop_x_m + ny * e.cop_y_m - offset_m
            sigma_m = np.sqrt((nx * e.cop_sigma_x_m) ** 2 + (ny * e.cop_sigma_y_m) ** 2)
            # Noise about the edge is let through, or the mean of what is left would lie inside.
            good &= beyond_m <= HULL_SIGMAS * sigma_m + 1e-9
    return ~good


def _append(before: _Pending | None, new: _Pending) -> _Pending:
    if before is None:
        return new
    joined = {
        f.name: np.concatenate([getattr(before.estimates, f.name), getattr(new.estimates, f.name)])
        for f in fields(Estimates)
    }
    readings = new.readings
    if readings is not None and before.readings is not None:
        readings = before.readings.followed_by(readings)
    return _Pending(
        Estimates(**joined),
        np.concatenate([before.cop_z_m, new.cop_z_m]),
        readings,
        np.concatenate([before.loaded, new.loaded]),
        np.concatenate([before.since_ns, new.since_ns]),
        np.concatenate([before.t_ns, new.t_ns]),
    )


def _after_gap(
    plan: EstimationPlan, frames: FrameBatch, state: EstimationState
) -> npt.NDArray[np.bool_]:
    # Unsigned throughout: a difference wraps, and a number of any size is compared as it is.
    first = frames.seq[:1] - np.uint64(1) if state.last_seq is None else [state.last_seq]
    before = np.concatenate([np.asarray(first, dtype=np.uint64), frames.seq[:-1]])
    last_t_ns = frames.t_mono_ns[0] if state.last_seq is None else state.last_t_ns
    late = np.diff(frames.t_mono_ns, prepend=last_t_ns) > plan.gap_ns
    return np.asarray((frames.seq - before != 1) | late)
