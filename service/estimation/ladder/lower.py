"""The lower part of the ladder: counts to the apparent force on every dome, reading by reading.

Apparent is what the static curve gives, before hysteresis and creep of the rubber are undone.

`Pending` holds the frames whose look-ahead is not complete.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from devices.arrays import Arrays, Bools, Floats, Ints, Times
from devices.chips.mpl115a2 import PRESSURE_MAX_KPA, PRESSURE_MIN_KPA
from devices.frames import NOT_READ, FrameBatch, TileStatus
from service.estimation.estimates import EstimateStatus
from service.estimation.foot.kinematics import Readings
from service.estimation.ladder.plan import SIGMAS, SUCTION_MAX_KPA, TARE_OLD_NS, EstimationPlan
from service.estimation.ladder.unseen import EVENLY, Unseen, farthest, was_away
from service.estimation.models import ambient, denoise, gas, skew, temperature
from service.estimation.models.gas import Gas, GasState
from service.estimation.models.outliers import despiked
from service.estimation.models.unwrap import unwrap
from service.estimation.tare.tare import has_warmed
from service.estimation.watch.watch import WatchState


@dataclass(frozen=True)
class PendingFrames(Arrays):
    """Facts of frames that are needed once, when their estimate is due; arrays (n,).

    Attributes:
        seq: number in the stream.
        t_ns: UTC.
        loaded: does the foot seem loaded, from `contact.seeming`?
        since_ns: since when it has seemed so.
    """

    seq: npt.NDArray[np.uint64]
    t_ns: Times
    loaded: Ints
    since_ns: Times


@dataclass(frozen=True)
class Pending:
    """What is known of frames without an estimate so far.

    Attributes:
        forces: of these frames, after those that are only there to be reached back to.
        frames: these frames.
        readings: of the servo in these frames; None without one.
    """

    forces: ApparentForces
    frames: PendingFrames
    readings: Readings | None

    @property
    def first(self) -> int:
        """Row of `forces` at which `frames` begins."""
        return len(self.forces.run) - len(self.frames.seq)

    def followed_by(self, later: Pending) -> Pending:
        """These frames and then later ones."""
        readings = later.readings
        if readings is not None and self.readings is not None:
            readings = Readings.concatenate([self.readings, readings])
        return Pending(
            ApparentForces.concatenate([self.forces, later.forces]),
            PendingFrames.concatenate([self.frames, later.frames]),
            readings,
        )

    def after(self, given: int, *, reach_back: bool) -> Pending:
        """These without the first `given`, but with those that averages will reach back to."""
        n, end = len(self.frames.seq), len(self.forces.run)
        keep = first = self.first + given
        if reach_back:
            t_mono_ns = self.forces.t_mono_ns
            # The next one may not be here yet; it will be no earlier than the last that is.
            oldest_ns = t_mono_ns[min(first, end - 1)] - denoise.PAST_NS
            keep = max(int(np.searchsorted(t_mono_ns, oldest_ns)), first - int(denoise.REACHES[-1]))
        return Pending(
            self.forces.rows(keep, end),
            self.frames.rows(given, n),
            None if self.readings is None else self.readings.rows(given, n),
        )


@dataclass(frozen=True)
class ApparentForces(Arrays):
    """Forces as they appear in n frames; arrays (n, bearing tiles) unless said otherwise.

    Attributes:
        gauge_kpa: (n, all tiles), pressure above the baseline.
        apparent_n: force by the static curve.
        noise_n: standard deviation that a single reading's noise gives it; averages away.
        sigma_n: standard uncertainty from all else but the gas; does not.
        gas_n: standard uncertainty that the gas' correction leaves, with the correction's sign: all
            tiles err to the same side.
        unseen_gas_n: standard uncertainty from what the gas did unseen, with a sign likewise.
        warm_n: what warmth that no model corrects makes of the force, signed; likewise.
        sampled_ns: when each tile was sampled, on the monotonic clock.
        beyond: beyond the calibrated range, or the chip's: a lower bound.
        guess_n: what the force may be where there is only that bound; NaN elsewhere.
        t_mono_ns: (n,), instants of the frames.
        run: (n,), number of the unbroken run that each frame belongs to.
        status: (n,), bits of `EstimateStatus` that these frames have by themselves.
    """

    gauge_kpa: Floats
    apparent_n: Floats
    noise_n: Floats
    sigma_n: Floats
    gas_n: Floats
    unseen_gas_n: Floats
    warm_n: Floats
    sampled_ns: Times
    beyond: Bools
    guess_n: Floats
    t_mono_ns: Times
    run: Ints
    status: npt.NDArray[np.uint16]


@dataclass(frozen=True)
class LowerState:
    """What the lower models remember; None for those that are not named."""

    temperature: temperature.TemperatureState | None = None
    ambient: ambient.AmbientState = ambient.AT_REST
    gas: GasState | None = None
    gas_else: GasState | None = None
    """After the pressures farthest from those that were taken; None: nothing was unseen."""
    skew: skew.SkewState | None = None
    watch: WatchState = WatchState()  # noqa: RUF009  # frozen, so one for all is safe


def tile_kpa(plan: EstimationPlan, frames: FrameBatch) -> Floats:
    """Absolute pressure (n, all tiles), NaN where a tile gave none that could be one."""
    kpa = plan.compensation.readable_kpa(frames)
    if plan.ladder.unwrap:
        kpa = unwrap(kpa, plan.compensation.kpa_per_count(frames.tadc))
    return np.where(kpa >= PRESSURE_MIN_KPA, kpa, np.nan)


def apparent_forces(
    plan: EstimationPlan,
    frames: FrameBatch,
    kpa: Floats,
    neighbours: tuple[Floats, Floats] | None,
    broken: Bools,
    run: Ints,
    state: LowerState,
) -> tuple[ApparentForces, LowerState]:
    """Force on every dome by its static curve.

    Args:
        plan: constants of the estimate.
        frames: n frames, temperatures held.
        kpa: their absolute pressures (n, all tiles), from `tile_kpa`.
        neighbours: those of the frames before and after each; None without look-ahead.
        broken: (n,), frames after a gap.
        run: (n,), number of the unbroken run that each frame belongs to.
        state: from the frames before.
    """
    ladder, columns = plan.ladder, plan.bearing
    status = _frame_status(plan, frames, kpa, broken)
    stuck, edge_kpa, watched = plan.watch.readings(frames, kpa, state.watch)
    if stuck.any():
        status[stuck.any(axis=1)] |= np.uint16(EstimateStatus.STUCK)
        kpa = np.where(stuck, np.nan, kpa)
    if ladder.denoise and neighbours is not None:
        kpa, replaced = despiked(kpa, *neighbours, plan.tare.noise_kpa)
        status[replaced[:, columns].any(axis=1)] |= np.uint16(EstimateStatus.OUTLIER_REPLACED)
    # Owned, in row order: what is compiled is compiled for that.
    t_mono_ns = np.array(frames.t_mono_ns)
    offset_ns = 1000 * frames.sample_offset_us[:, columns].astype(np.int64, order="C")
    sampled_ns = t_mono_ns[:, None] + offset_ns + plan.late_ns
    gauge_kpa = kpa - plan.tare.baseline_kpa
    bearing_kpa = np.ascontiguousarray(kpa[:, columns])
    baseline_variance = np.zeros(bearing_kpa.shape) + plan.baseline_sigma_kpa**2
    if ladder.temperature is not None:
        before = state.temperature or temperature.at_rest(len(columns))
        tadc = np.where(frames.tadc == NOT_READ, np.nan, frames.tadc.astype(np.float64))
        bearing_kpa, sigma_kpa, after = ladder.temperature.at_tare(
            bearing_kpa, tadc[:, columns], sampled_ns, before
        )
        baseline_variance = baseline_variance + sigma_kpa**2
        state = replace(state, temperature=after)
    if ladder.ambient is not None:
        # A bare tile beyond the chip's range shows a fault of its own, not the surroundings.
        beyond_chip = (frames.status & np.uint8(TileStatus.OVER_RANGE)) != 0
        outside_kpa = np.where(beyond_chip, np.nan, gauge_kpa)
        passed_kpa, sigma_kpa, outside = ladder.ambient.passed_on(
            _mean_of(outside_kpa, plan.references), t_mono_ns, state.ambient
        )
        bearing_kpa = bearing_kpa - passed_kpa
        baseline_variance = baseline_variance + sigma_kpa**2
        state = replace(state, ambient=outside)
    if ladder.temperature is not None or ladder.ambient is not None:
        gauge_kpa = gauge_kpa.copy()
        gauge_kpa[:, columns] = bearing_kpa - plan.baseline_kpa
    torn = bearing_kpa - plan.baseline_kpa < -SUCTION_MAX_KPA
    if torn.any():
        bearing_kpa = np.where(torn, np.nan, bearing_kpa)
    # The chip's range is judged by what was read, the calibrated one by what the gas settles at.
    end_kpa = plan.chip_end_kpa
    if edge_kpa is not None:
        end_kpa = np.minimum(end_kpa, edge_kpa)
        status[(kpa[:, columns] > edge_kpa).any(axis=1)] |= np.uint16(EstimateStatus.CLIPPED)
    hidden = kpa[:, columns] > end_kpa
    # As if the chip's end had been read, with what warmth and surroundings have put into it.
    least_kpa = bearing_kpa - np.where(hidden, kpa[:, columns] - end_kpa, 0.0)
    settled_kpa = bearing_kpa
    gas_kpa = unseen_kpa = np.zeros(bearing_kpa.shape)
    if ladder.gas is not None:
        settled_kpa, unseen_kpa, state = _settled(
            ladder.gas, plan.unseen, bearing_kpa, least_kpa, hidden, sampled_ns, state
        )
        gas_kpa = settled_kpa - bearing_kpa
        # A tile whose bench does not tell of its gas goes without, and is that uncertain.
        settled_kpa = np.where(ladder.gas_known, settled_kpa, bearing_kpa)
        least_kpa = ladder.gas.settled_at_least(least_kpa)
    guess_kpa = settled_kpa - plan.baseline_kpa
    settled_kpa = np.where(hidden, least_kpa, settled_kpa)
    static_kpa = settled_kpa - plan.baseline_kpa
    warmed_kpa, watched = plan.watch.warmed_kpa(frames, sampled_ns, watched)
    lost_kpa, astray, watched = plan.watch.lost_kpa(
        np.where(hidden, np.nan, static_kpa), baseline_variance, warmed_kpa, sampled_ns, watched
    )
    baseline_variance = baseline_variance + lost_kpa**2
    status[astray] |= np.uint16(EstimateStatus.BASELINE_LOST)
    static = ladder.curves.force(static_kpa)
    unknown = np.isnan(kpa[:, columns] if plan.tare.is_lost else static.force_n)
    status[unknown.any(axis=1)] |= np.uint16(EstimateStatus.TILE_MISSING)
    beyond = (static_kpa > ladder.curves.high_kpa) | hidden
    guess_n = np.full(beyond.shape, np.nan)
    if beyond.any():
        guess_n = np.where(beyond, plan.unseen.guess_n(ladder.curves, guess_kpa), guess_n)
    status[beyond.any(axis=1)] |= np.uint16(EstimateStatus.SATURATED)
    low_kpa = ladder.curves.low_kpa - SIGMAS * plan.still_kpa
    status[(static_kpa < low_kpa).any(axis=1)] |= np.uint16(EstimateStatus.EXTRAPOLATED)
    over = (kpa[:, columns] > PRESSURE_MAX_KPA) & ~beyond
    status[over.any(axis=1)] |= np.uint16(EstimateStatus.OVER_RATED)
    apparent_n = static.force_n
    if ladder.skew and not ladder.denoise:
        apparent_n, row = skew.aligned(
            apparent_n,
            sampled_ns,
            t_mono_ns,
            broken,
            state.skew or skew.at_rest(len(columns)),
        )
        state = replace(state, skew=row)
    forces = ApparentForces(
        gauge_kpa=gauge_kpa,
        apparent_n=apparent_n,
        noise_n=np.abs(static.slope_n_per_kpa) * plan.noise_kpa,
        sigma_n=np.sqrt(static.slope_n_per_kpa**2 * baseline_variance + static.fit_sigma_n**2),
        gas_n=static.slope_n_per_kpa * ladder.gas_misfit * gas_kpa,
        unseen_gas_n=static.slope_n_per_kpa * unseen_kpa,
        warm_n=static.slope_n_per_kpa * warmed_kpa,
        sampled_ns=sampled_ns,
        beyond=beyond,
        guess_n=guess_n,
        t_mono_ns=t_mono_ns,
        run=run,
        status=status,
    )
    return forces, replace(state, watch=watched)


def _settled(
    model: Gas,
    unseen: Unseen,
    kpa: Floats,
    least_kpa: Floats,
    hidden: Bools,
    t_ns: Times,
    state: LowerState,
) -> tuple[Floats, Floats, LowerState]:
    """Pressures that the gas settles at, and their uncertainty from what it did unseen.

    What is hidden behind the chip's end is taken as it reads: the best guess, which is no more than
    a guess.
    """
    before = state.gas or gas.at_rest(kpa.shape[1])
    taken_kpa = np.where(hidden, np.minimum(kpa, unseen.most_hot_kpa), kpa)
    settled_kpa, after = model.settled(taken_kpa, t_ns, before)
    unseen_kpa, after_else = np.zeros(kpa.shape), state.gas_else
    last_ns = np.where(np.isnan(before.ln_kpa), t_ns[0], before.t_ns)
    if after_else is not None or hidden.any() or was_away(~np.isnan(kpa), t_ns, last_ns):
        else_kpa = np.where(hidden, farthest(taken_kpa, least_kpa, unseen.most_hot_kpa), kpa)
        at_else_kpa, after_else = model.settled(
            else_kpa, t_ns, after_else or before, away_kpa=unseen.end_hot_kpa
        )
        unseen_kpa = np.where(hidden, 0.0, EVENLY * (at_else_kpa - settled_kpa))
        if after_else.is_same(after):
            after_else = None
    return settled_kpa, unseen_kpa, replace(state, gas=after, gas_else=after_else)


def _frame_status(
    plan: EstimationPlan, frames: FrameBatch, kpa: Floats, broken: Bools
) -> npt.NDArray[np.uint16]:
    status = np.zeros(len(frames), dtype=np.uint16)
    known = ~np.isnan(kpa)
    status[broken] |= np.uint16(EstimateStatus.GAP)
    if plan.assumed_scale:
        status |= np.uint16(EstimateStatus.ASSUMED_SCALE)
    if plan.tare.is_lost:
        return status | np.uint16(EstimateStatus.TARE_LOST)
    doubtful = frames.t_ns - plan.tare.t_ns > TARE_OLD_NS
    if plan.ladder.temperature is None:
        doubtful |= (known & has_warmed(plan.tare, frames.tadc))[:, plan.bearing].any(axis=1)
    status[doubtful] |= np.uint16(EstimateStatus.TARE_OLD)
    return status


def _mean_of(values: Floats, columns: npt.NDArray[np.intp]) -> Floats:
    """Mean over columns, without NaN; summed column by column, as every sum here."""
    total, count = np.zeros(len(values)), np.zeros(len(values))
    for column in columns:
        good = np.isfinite(values[:, column])
        total = total + np.where(good, values[:, column], 0.0)
        count = count + good
    return np.where(count > 0.0, total, np.nan) / np.maximum(count, 1.0)
