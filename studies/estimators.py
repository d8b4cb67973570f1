"""Estimators by name: that of the models, and a plain low-pass to compare it with.

The low-pass has no model but the static curve, whose force it smooths tile by tile, without
look-ahead. A missing reading is NaN, and the low-pass starts again after it.
"""

from __future__ import annotations

from typing import Any, ClassVar, Self

import numpy as np

from devices.arrays import Floats, Ints
from devices.chips.pressure_chips import Compensation, get_raw_type
from devices.errors import UsageError
from devices.flags import CONTACT_UNKNOWN, EstimateFlag
from devices.frames import NOT_READ, FrameBatch, HeldTemperature, hold_temperature
from service.estimation.estimate import Estimator, ModelEstimator
from service.estimation.models.static import compute_forces
from service.estimation.pipeline.plan import SIGNIFICANCE_SIGMAS, EstimationPlan
from service.estimation.pipeline.smoothing_stage import BOUND_SIGMAS
from service.estimation.records import ColumnDict, Estimates

TIME_CONSTANT_S = 0.005  # two or three readings: short against a footstep


class LowPassEstimator:
    """Estimator by the static curve and a low-pass; of the plan's models only `static` is used."""

    name: ClassVar = "low-pass"

    def __init__(self, plan: EstimationPlan) -> None:
        self.plan = plan
        unknown_n = np.full(len(plan.load_bearing_columns), np.nan)  # there the low-pass starts
        tiles = plan.info.tiles
        # The last smoothed forces; their instant in ns, and contact; the last temperatures.
        self._state: ColumnDict = {"force_n": unknown_n, "last": np.zeros(2, np.int64)}
        self._state["held"] = np.full(len(tiles), NOT_READ, get_raw_type(tiles))
        self._state["held_ns"] = np.zeros(len(tiles), np.int64)

    def process_frames(self, frames: FrameBatch) -> Estimates:
        """Return the estimates of the next frames, all at once."""
        plan, bearing, curves = self.plan, self.plan.load_bearing_params, self.plan.curves
        places, gain = plan.load_bearing_columns, bearing["mount_gain"]
        state, compensation = self._state, Compensation(plan.info.tiles)
        held = HeldTemperature(state["held"], state["held_ns"])
        frames, held = hold_temperature(frames, held)
        state["held"], state["held_ns"] = held.temperature_raw, held.t_mono_ns
        kpa = compensation.compute_usable_kpa(frames)
        # A reading below the rated range is invalid: the count of an MPL115A2 has wrapped.
        gauge_kpa = np.where(kpa >= compensation.min_kpa, kpa, np.nan) - plan.tare.baseline_kpa
        static = compute_forces(curves, np.ascontiguousarray(gauge_kpa[:, places]))
        unloaded_sigma_kpa = np.hypot(bearing["noise_kpa"], np.sqrt(bearing["baseline_variance"]))
        sigma_n = gain * np.hypot(static.slope_n_per_kpa * unloaded_sigma_kpa, static.fit_sigma_n)
        force_n = self._smooth(frames.t_mono_ns.tolist(), gain * static.force_n)
        is_saturated = gauge_kpa[:, places] > curves["range_high_kpa"]
        bounds_n = np.where(is_saturated, force_n - BOUND_SIGMAS * sigma_n, force_n)
        sigma_n = np.where(is_saturated | np.isnan(force_n), np.nan, sigma_n)
        measured_n, stated_n = np.where(is_saturated, np.nan, force_n), np.nan_to_num(sigma_n)
        grf_n, variance = _add_tiles(measured_n), _add_tiles(stated_n**2)
        bound_n = _add_tiles(np.nan_to_num(bounds_n))
        grf_sigma_n = np.where(np.isnan(grf_n), np.nan, np.sqrt(variance))
        contact = self._detect_contact(grf_n.tolist())
        is_masked = ~((contact == 1) & (grf_n >= SIGNIFICANCE_SIGMAS * grf_sigma_n))
        divisor_n, nothing = np.where(is_masked, np.nan, grf_n), np.full(len(frames), np.nan)
        cop_m, cop_sigma_m = [nothing, nothing], [nothing, nothing]
        for axis in np.flatnonzero(plan.cop_measured):
            place_m = bearing["position_m"][:, axis]
            cop_m[axis] = _add_tiles(place_m * measured_n) / divisor_n
            levers_m = place_m - cop_m[axis][:, None]
            cop_sigma_m[axis] = np.sqrt(_add_tiles((levers_m * stated_n) ** 2)) / divisor_n
        flags = EstimateFlag.TILE_MISSING * np.isnan(force_n).any(axis=1)
        flags |= EstimateFlag.SATURATED * is_saturated.any(axis=1)
        flags |= EstimateFlag.COP_MASKED * is_masked
        flags |= EstimateFlag.ASSUMED_SCALE * plan.is_scale_assumed
        flags |= EstimateFlag.TARE_LOST * plan.tare.is_lost
        by_tile = np.full((2, *kpa.shape), np.nan)
        by_tile[:, :, places] = bounds_n, sigma_n
        bound_n = np.where(np.isnan(force_n).all(axis=1), np.nan, bound_n)
        columns: list[Any] = [frames.seq, frames.t_ns, gauge_kpa, *by_tile, grf_n, grf_sigma_n]
        columns += [bound_n - BOUND_SIGMAS * np.sqrt(variance), *cop_m, *cop_sigma_m]
        return Estimates(
            *[*columns, *[nothing] * 5, contact.astype(np.uint8), flags.astype(np.uint16)]
        )

    def finish(self) -> None:
        """Return None: no estimate waits."""

    def state_dict(self) -> ColumnDict:
        """Return a copy of the state for `from_state`."""
        return {name: column.copy() for name, column in self._state.items()}

    @classmethod
    def from_state(cls, plan: EstimationPlan, state: ColumnDict) -> Self:
        """Make an estimator that continues from a state; ValueError if it is of another plan."""
        new = cls(plan)
        for name, memory in new._state.items():
            if (state[name].dtype, state[name].shape) != (memory.dtype, memory.shape):
                raise ValueError(f"{name} is {state[name].shape}, not {memory.shape}")
            memory[...] = state[name]
        return new

    def _smooth(self, t_ns: list[int], force_n: Floats) -> Floats:
        smooth_n, last = np.empty_like(force_n), self._state["force_n"]
        for i, now_ns in enumerate(t_ns):
            step_s = max(0.0, 1e-9 * (now_ns - int(self._state["last"][0])))
            moved_n = last + step_s / (TIME_CONSTANT_S + step_s) * (force_n[i] - last)
            smooth_n[i] = last[:] = np.where(np.isnan(last), force_n[i], moved_n)
            self._state["last"][0] = now_ns
        return smooth_n

    def _detect_contact(self, grf_n: list[float]) -> Ints:
        last, foot = self._state["last"], self.plan.params.foot
        contact = np.empty(len(grf_n), np.int64)
        on_n, off_n = float(foot["contact_on_n"][0]), float(foot["contact_off_n"][0])
        for i, force_n in enumerate(grf_n):
            last[1] = 1 if force_n >= on_n else 0 if force_n <= off_n else last[1]
            contact[i] = CONTACT_UNKNOWN if np.isnan(force_n) else last[1]
        return contact


def _add_tiles(values: Floats) -> Floats:
    total = np.zeros(len(values))
    for column in values.T:  # in the same order for any batch
        total = total + column
    return total


ESTIMATORS: dict[str, type[Estimator]] = {e.name: e for e in (ModelEstimator, LowPassEstimator)}


def get_estimator(name: str) -> type[Estimator]:
    """Return the estimator of a name; raise UsageError if there is none."""
    if name not in ESTIMATORS:
        raise UsageError(f"--estimator {name}", expected=" or ".join(ESTIMATORS))
    return ESTIMATORS[name]
