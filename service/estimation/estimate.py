"""Frames in, estimates out: one code path for ten rows live and ten million offline.

`step` takes the next frames and gives the estimates that are now due, `finish` those that are left.
Estimates come `lag` later than their frames, in order, exactly one per frame. Any way of cutting a
recording into batches gives the same bits: nothing here is summed over time, multiplied as a
matrix, or dependent on how rows lie in memory.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntFlag

import numpy as np
import numpy.typing as npt

from devices.frames import FrameBatch, FrameStatus
from devices.mpl115a2 import PRESSURE_MAX_KPA, PRESSURE_MIN_KPA
from service.estimation.contact import UNKNOWN, UNLOADED, RunState, believed, seeming
from service.estimation.geometry import angle_rad, to_ground_x_m
from service.estimation.models.unwrap import unwrap
from service.estimation.plan import TARE_OLD_NS, EstimationPlan

Floats = npt.NDArray[np.float64]

SIGMAS = 5.0
"""COP needs a GRF of so many sigma: below, the first-order variance of a ratio is not valid. And a
pressure so many sigma below the calibrated range is no noise."""
HULL_SIGMAS = 3.0


class EstimateStatus(IntFlag):
    """Bits of `Estimates.estimate_status`, one value per frame."""

    SATURATED = 1
    """A tile is beyond its calibrated range: force and GRF are lower bounds."""
    EXTRAPOLATED = 2
    """A tile is below its calibrated range: suction, or a tare that no longer holds."""
    OUTLIER_REPLACED = 4
    GAP = 8
    """Frames are missing before this one."""
    COP_MASKED = 16
    """No centre of pressure: no contact, or it would be too uncertain."""
    TILE_MISSING = 32
    """A tile gave no pressure, so there is no sum."""
    ASSUMED_SCALE = 64
    """The calibration's scale is assumed: newtons are not to be trusted."""
    TARE_OLD = 128
    OVER_RATED = 256
    """A tile is above the chip's 115 kPa, but within its calibration."""


@dataclass(frozen=True)
class Estimates:
    """Estimates of n frames; the columns of `storage.schema.ESTIMATES` in float64.

    Arrays are (n,), those of tiles (n, tiles). Undefined is NaN, contact 255.
    """

    seq: npt.NDArray[np.uint64]
    t_ns: npt.NDArray[np.int64]
    gauge_kpa: Floats
    force_n: Floats
    force_sigma_n: Floats
    grf_n: Floats
    grf_sigma_n: Floats
    cop_x_m: Floats
    cop_y_m: Floats
    cop_sigma_x_m: Floats
    cop_sigma_y_m: Floats
    cop_index_x: Floats
    cop_index_y: Floats
    cop_ground_x_m: Floats
    cop_ground_y_m: Floats
    angle_rad: Floats
    contact: npt.NDArray[np.uint8]
    estimate_status: npt.NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.seq)

    def rows(self, start: int, stop: int) -> Estimates:
        """Rows `start` to `stop` as views."""
        return Estimates(**{f.name: getattr(self, f.name)[start:stop] for f in fields(self)})


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
    loaded: npt.NDArray[np.int64]
    since_ns: npt.NDArray[np.int64]
    t_ns: npt.NDArray[np.int64]


@dataclass(frozen=True)
class EstimationState:
    """What `step` hands on to the next `step`. Begin with `EstimationState()`."""

    pending: _Pending | None = None
    run: RunState = UNLOADED
    contact: int = 0
    last_seq: int | None = None
    last_t_ns: int = 0


def step(
    plan: EstimationPlan, frames: FrameBatch, state: EstimationState
) -> tuple[Estimates, EstimationState]:
    """Take the next frames, in order; give the estimates that are due.

    Args:
        plan: constants of this estimate.
        frames: n >= 1 frames with rising `seq` and `t_mono_ns`.
        state: from the step before.

    Returns:
        The estimates due (any number, possibly none), and the state for the next step.
    """
    now, broken = _memoryless(plan, frames, state)
    loaded, since_ns, run = seeming(plan.contact, now.grf_n, frames.t_mono_ns, broken, state.run)
    known = _append(state.pending, _Pending(now, loaded, since_ns, frames.t_mono_ns))
    due = int(np.searchsorted(known.t_ns, known.t_ns[-1] - plan.lag_ns, side="right"))
    state = replace(
        state,
        run=run,
        last_seq=int(frames.seq[-1]),
        last_t_ns=int(frames.t_mono_ns[-1]),
    )
    return _release(plan, known, due, state)


def finish(plan: EstimationPlan, state: EstimationState) -> Estimates | None:
    """The estimates that still wait for a look-ahead that will not come; None if none do."""
    if state.pending is None:
        return None
    known = state.pending
    estimates, _ = _release(plan, known, len(known.t_ns), state)
    return estimates


def _memoryless(
    plan: EstimationPlan, frames: FrameBatch, state: EstimationState
) -> tuple[Estimates, npt.NDArray[np.bool_]]:
    """All that follows from a frame alone, and which frames come after a gap."""
    kpa = plan.compensation.readable_kpa(frames)
    if "unwrap" in plan.models:
        kpa = unwrap(kpa, plan.compensation.kpa_per_count(frames.tadc))
    missing = ~(kpa >= PRESSURE_MIN_KPA)
    gauge_kpa = np.where(missing, np.nan, kpa - plan.tare.baseline_kpa)

    static = plan.curves.force(gauge_kpa)
    pressure_sigma_kpa = np.sqrt(plan.tare.noise_kpa**2 + plan.tare.baseline_sigma_kpa**2)
    force_sigma_n = np.sqrt(
        (static.slope_n_per_kpa * pressure_sigma_kpa) ** 2 + static.fit_sigma_n**2
    )
    with np.errstate(invalid="ignore"):
        saturated = gauge_kpa > plan.curves.high_kpa
        extrapolated = gauge_kpa < plan.curves.low_kpa - SIGMAS * pressure_sigma_kpa
        over_rated = (kpa > PRESSURE_MAX_KPA) & ~saturated
    # A lower bound has no standard uncertainty.
    force_sigma_n = np.where(saturated, np.nan, force_sigma_n)
    force_n = np.where(plan.bears, static.force_n, np.nan)
    force_sigma_n = np.where(plan.bears, force_sigma_n, np.nan)

    bearing = np.flatnonzero(plan.bears)
    grf_n = _sum(force_n, bearing)
    grf_sigma_n = np.sqrt(_sum(force_sigma_n**2, bearing))
    divisor_n = np.where(grf_n == 0.0, np.nan, grf_n)
    cop_m, cop_sigma_m = [], []
    for axis in range(3):
        arm_m = plan.positions_m[:, axis]
        at_m = _sum(force_n * arm_m, bearing) / divisor_n
        spread = _sum(((arm_m - at_m[:, None]) * force_sigma_n) ** 2, bearing)
        cop_m.append(at_m)
        cop_sigma_m.append(np.sqrt(spread) / np.abs(divisor_n))
    index = _grid_index(plan, gauge_kpa, bearing)
    angle = _angle(plan, frames)
    travel = plan.info.servo.ankle_travel_m_per_rad if plan.info.servo else None

    status = np.zeros(len(frames), dtype=np.uint16)
    broken = _after_gap(plan, frames, state)
    for mask, bit in (
        (_any(saturated, bearing), EstimateStatus.SATURATED),
        (_any(extrapolated, bearing), EstimateStatus.EXTRAPOLATED),
        (_any(over_rated, bearing), EstimateStatus.OVER_RATED),
        (_any(missing, bearing), EstimateStatus.TILE_MISSING),
        (broken, EstimateStatus.GAP),
        (np.full(len(frames), plan.assumed_scale), EstimateStatus.ASSUMED_SCALE),
        (frames.t_ns - plan.tare.t_ns > TARE_OLD_NS, EstimateStatus.TARE_OLD),
    ):
        status[mask] |= np.uint16(bit)
    estimates = Estimates(
        seq=frames.seq,
        t_ns=frames.t_ns,
        gauge_kpa=gauge_kpa,
        force_n=force_n,
        force_sigma_n=force_sigma_n,
        grf_n=grf_n,
        grf_sigma_n=grf_sigma_n,
        cop_x_m=cop_m[0],
        cop_y_m=cop_m[1],
        cop_sigma_x_m=cop_sigma_m[0],
        cop_sigma_y_m=cop_sigma_m[1],
        cop_index_x=index[0],
        cop_index_y=index[1],
        cop_ground_x_m=to_ground_x_m(cop_m[0], cop_m[2], angle, travel),
        cop_ground_y_m=cop_m[1] if travel is not None else np.full(len(frames), np.nan),
        angle_rad=angle,
        contact=np.full(len(frames), UNKNOWN, dtype=np.uint8),
        estimate_status=status,
    )
    return estimates, broken


def _release(
    plan: EstimationPlan, known: _Pending, due: int, state: EstimationState
) -> tuple[Estimates, EstimationState]:
    """Give away the first `due` estimates of `known`; decide their contact and mask their COP."""
    contact = believed(
        plan.contact, plan.lag_ns, due, known.loaded, known.since_ns, known.t_ns, state.contact
    )
    out = known.estimates.rows(0, due)
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
            known.loaded[due:],
            known.since_ns[due:],
            known.t_ns[due:],
        )
    return out, replace(state, pending=pending, contact=int(contact[-1]) if due else state.contact)


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


def _grid_index(
    plan: EstimationPlan, gauge_kpa: Floats, bearing: npt.NDArray[np.intp]
) -> tuple[Floats, Floats]:
    """Paper eq. 4 to the letter: grid indices from 1, weighted by gauge pressure."""
    if plan.grid is None:
        nothing = np.full(len(gauge_kpa), np.nan)
        return nothing, nothing
    total_kpa = _sum(gauge_kpa, bearing)
    divisor_kpa = np.where(total_kpa == 0.0, np.nan, total_kpa)
    x, y = (
        _sum(gauge_kpa[:, bearing] * index, range(len(bearing))) / divisor_kpa
        for index in plan.grid
    )
    return x, y


def _angle(plan: EstimationPlan, frames: FrameBatch) -> Floats:
    if plan.info.servo is None:
        return np.full(len(frames), np.nan)
    angle = angle_rad(plan.info.servo, frames.servo_counts)
    return np.where((frames.frame_status & FrameStatus.SERVO_STALE) != 0, np.nan, angle)


def _after_gap(
    plan: EstimationPlan, frames: FrameBatch, state: EstimationState
) -> npt.NDArray[np.bool_]:
    # Unsigned throughout: a difference wraps, and a number of any size is compared as it is.
    first = frames.seq[:1] - np.uint64(1) if state.last_seq is None else [state.last_seq]
    before = np.concatenate([np.asarray(first, dtype=np.uint64), frames.seq[:-1]])
    last_t_ns = frames.t_mono_ns[0] if state.last_seq is None else state.last_t_ns
    late = np.diff(frames.t_mono_ns, prepend=last_t_ns) > plan.gap_ns
    return np.asarray((frames.seq - before != 1) | late)


def _sum(values: Floats, tiles: npt.NDArray[np.intp] | range) -> Floats:
    # One tile after the other: numpy's own sum over an axis may round in another order.
    total = np.zeros(len(values))
    for tile in tiles:
        total = total + values[:, tile]
    return total


def _any(masks: npt.NDArray[np.bool_], tiles: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
    return np.asarray(masks[:, tiles].any(axis=1))


def _append(before: _Pending | None, new: _Pending) -> _Pending:
    if before is None:
        return new
    joined = {
        f.name: np.concatenate([getattr(before.estimates, f.name), getattr(new.estimates, f.name)])
        for f in fields(Estimates)
    }
    return _Pending(
        Estimates(**joined),
        np.concatenate([before.loaded, new.loaded]),
        np.concatenate([before.since_ns, new.since_ns]),
        np.concatenate([before.t_ns, new.t_ns]),
    )
