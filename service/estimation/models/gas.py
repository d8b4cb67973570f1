"""`gas`: pressure of the bubble after its gas has cooled (hardware.md 9).

A fast squeeze heats the sealed gas, which gives the heat to its wall within 5 to 42 ms. With T the
gas' mean temperature over that of its wall, p measured, and an effective ratio of heat capacities
gamma between 1 and 1.4::

    gamma dT/dt = (gamma - 1) T/p dp/dt - (T - 1)/tau

With u = T p^-k, k = (gamma - 1)/gamma, that is one linear low-pass. With ln p linear between
samples it is exact, and stable for any step. The wall gives way to the pressure over it by the part
c of its volume for every kPa, so the pressure after cooling is::

    p_static = p_iso (1 + c g)/(1 + c g_iso),  p_iso = p/T,  g = p - p0,  g_iso = p_iso - p0
"""

from __future__ import annotations

import math
from typing import Self

import numpy as np

from devices.jit import jit_cached
from service.estimation import LONG_GAP_NS
from service.estimation.effects import MISFIT_MIN, parameter_values
from service.estimation.models import LoadBearingTiles, ModelParams
from service.estimation.records import KernelRecord, RecordArray

RESTART_TIME_CONSTANTS = 5.0
"""Time without a reading, in gamma tau, after which the gas is as warm as its wall."""


class GasParams(ModelParams):
    """Parameters of a tile.

    A tile whose calibration has no gas has that of a median tile, for its uncertainty only.
    """

    effect = "gas"

    gamma: float  # effective ratio of heat capacities
    tau_s: float  # time constant of the gas' cooling at constant volume
    wall_per_kpa: float  # compliance of the wall: part of the bubble's volume for a kPa
    baseline_kpa: float  # absolute pressure unloaded
    is_known: int  # 1: the calibration has the tile's gas
    misfit: float  # uncertain part of the correction

    @classmethod
    def make(cls, tiles: LoadBearingTiles) -> RecordArray[Self]:
        """Make the parameters of load-bearing tiles, (tiles,)."""
        found = [tile.effects.gas for tile in tiles.calibrations]
        known = [effect for effect in found if effect is not None]
        gamma = np.median(parameter_values(effect.gamma for effect in known))
        tau_s = np.median(parameter_values(effect.tau_s for effect in known))
        return cls.array(
            len(found),
            gamma=[gamma if effect is None else effect.gamma.value for effect in found],
            tau_s=[tau_s if effect is None else effect.tau_s.value for effect in found],
            wall_per_kpa=tiles.wall_per_kpa,
            baseline_kpa=tiles.baseline_kpa,
            is_known=[effect is not None for effect in found],
            misfit=[1.0 if effect is None else max(effect.misfit, MISFIT_MIN) for effect in found],
        )

    @classmethod
    def longest_time_constant_s(cls, params: RecordArray[Self]) -> float:
        """Return the longest time constant of a tile's cooling."""
        return float((params["gamma"] * params["tau_s"]).max())


class GasState(KernelRecord):
    """State of a tile's gas."""

    temperature_ratio: float = 1.0  # over the wall's
    ln_kpa: float = np.nan  # of the previous reading; NaN before the first
    t_ns: int  # instant of that reading


@jit_cached
def compute_isothermal_pressure(
    params: GasParams, state: GasState, kpa: float, t_ns: int, possible_gap_kpa: float
) -> float:
    """Update the state; return the absolute pressure after cooling. NaN changes nothing.

    Args:
        params: of the tile.
        state: after the tile's readings before; updated.
        kpa: absolute pressure.
        t_ns: instant of the reading.
        possible_gap_kpa: pressure that the gas may have had until just now, after more than
            `LONG_GAP_NS` without a reading: the farther of this pressure and the baseline; NaN: a
            straight line in between, or cooled gas.
    """
    if not 0.0 < kpa < math.inf:
        return math.nan
    k = (params.gamma - 1.0) / params.gamma
    c, p0 = params.wall_per_kpa, params.baseline_kpa
    ln_p, passed_ns = math.log(kpa), t_ns - state.t_ns
    h = passed_ns / (params.gamma * params.tau_s * 1e9)
    has_reading = not math.isnan(state.ln_kpa)
    if has_reading and possible_gap_kpa > p0 and passed_ns > LONG_GAP_NS:
        farther = possible_gap_kpa if possible_gap_kpa * p0 > kpa * kpa else p0
        state.temperature_ratio = (kpa / farther) ** k
    elif has_reading and 0.0 <= h <= RESTART_TIME_CONSTANTS:
        state.temperature_ratio = _step_temperature_ratio(
            state.temperature_ratio, ln_p - state.ln_kpa, h, k
        )
    else:
        state.temperature_ratio = 1.0
    state.ln_kpa, state.t_ns = ln_p, t_ns
    iso = kpa / state.temperature_ratio
    return iso * (1.0 + c * (kpa - p0)) / (1.0 + c * (iso - p0))


@jit_cached
def begin_after_gap(state: GasState, t_ns: int) -> None:
    """Set the state of gas that has its first reading at `t_ns`, as after a long gap."""
    state.ln_kpa, state.t_ns = 0.0, t_ns - 2 * LONG_GAP_NS


@jit_cached
def copy_state(state: GasState, to: GasState) -> None:
    """Copy a state into another."""
    to.temperature_ratio, to.ln_kpa, to.t_ns = state.temperature_ratio, state.ln_kpa, state.t_ns


@jit_cached
def is_same_state(one: GasState, other: GasState) -> bool:
    """Return whether two states are equal; NaN equals NaN."""
    pressure = one.ln_kpa == other.ln_kpa or (math.isnan(one.ln_kpa) and math.isnan(other.ln_kpa))
    ratio = one.temperature_ratio == other.temperature_ratio
    return pressure and ratio and one.t_ns == other.t_ns


@jit_cached
def compute_isothermal_lower_bound_kpa(params: GasParams, kpa: float) -> float:
    """Return the lower bound of the pressure after cooling from `kpa`, or from more.

    None of its heat has gone: p (p0/p)^k. Heat that has gone before only leaves the gas colder.

    Args:
        params: of the tile.
        kpa: absolute pressure; below the baseline the gas may have cooled already.
    """
    if not kpa > params.baseline_kpa:
        return kpa
    lowest_kpa: float = kpa * (params.baseline_kpa / kpa) ** ((params.gamma - 1.0) / params.gamma)
    return lowest_kpa


@jit_cached
def _step_temperature_ratio(before: float, change_ln_p: float, h: float, k: float) -> float:
    """Return the temperature over the wall's after a step of `h` gamma tau, ln p linear in it."""
    x = h - k * change_ln_p
    # (1 - exp(-x))/x, which is 1 at x = 0
    mean = -math.expm1(-x) / x if x != 0.0 else 1.0
    return before * math.exp(-x) + h * mean
