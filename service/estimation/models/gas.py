"""`gas`: what the bubble would read if its gas had the time to cool (hardware.md 9).

A fast squeeze heats the sealed gas, which gives the heat to its wall within 5 to 42 ms. With T the
gas' mean temperature over that of its wall, p measured, and an effective ratio of heat capacities
gamma between 1 and 1.4::

    gamma dT/dt = (gamma - 1) T/p dp/dt - (T - 1)/tau

With u = T p^-k, k = (gamma - 1)/gamma, that is one linear low-pass; taken with ln p linear between
samples it is exact and stable for any step. The wall gives way to the pressure over it by the part
c of its volume for every kPa, so the pressure that the gas will settle at is::

    p_static = p_iso (1 + c g)/(1 + c g_iso),  p_iso = p/T,  g = p - p0,  g_iso = p_iso - p0
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.compiled import compiled
from service.estimation.foot import UNSEEN_NS
from service.estimation.records import Record, Records, record_type, records

RESTART = 5.0
"""After this many gamma tau without a reading the gas is as warm as its wall."""


LAW = record_type(
    [(name, np.float64) for name in ("gamma", "tau_s", "wall_per_kpa", "baseline_kpa")]
)
"""Constants of a tile, as in `Gas`."""
STATE = record_type([("temperature", np.float64), ("ln_kpa", np.float64), ("t_ns", np.int64)])
"""Of a tile: temperature over the wall's, and the reading before (NaN: none)."""


def at_rest(tiles: int) -> Records:
    """Before the first reading."""
    return records(STATE, tiles, temperature=1.0, ln_kpa=np.nan)


@dataclass(frozen=True)
class Gas:
    """Parameters over tiles.

    Attributes:
        gamma: effective ratio of heat capacities.
        tau_s: time constant of the gas' cooling at constant volume.
        wall_per_kpa: part of the bubble's volume that its wall gives way for a kPa.
        baseline_kpa: absolute pressure unloaded.
    """

    gamma: Floats
    tau_s: Floats
    wall_per_kpa: Floats
    baseline_kpa: Floats

    def laws(self) -> Records:
        """The constants, tile by tile."""
        return records(LAW, len(self.gamma), **vars(self))


@compiled
def settled(law: Record, state: Record, kpa: float, t_ns: int, away_kpa: float) -> float:
    """Pressure that a measured one would settle at; NaN stays NaN and changes nothing after it.

    Args:
        law: constants of the tile.
        state: from its readings before; becomes that after this one.
        kpa: absolute pressure.
        t_ns: instant of the reading.
        away_kpa: pressure that the gas may have had until just now, if there was no reading for
            more than `UNSEEN_NS`: it had this one or its baseline, whichever is farther from the
            present; NaN: a straight line was between, or it has cooled.
    """
    if not 0.0 < kpa < math.inf:
        return math.nan
    k = (law.gamma - 1.0) / law.gamma
    c, p0 = law.wall_per_kpa, law.baseline_kpa
    ln_p, passed_ns = math.log(kpa), t_ns - state.t_ns
    h = passed_ns / (law.gamma * law.tau_s * 1e9)
    known = not math.isnan(state.ln_kpa)
    if known and away_kpa > p0 and passed_ns > UNSEEN_NS:
        farther = away_kpa if away_kpa * p0 > kpa * kpa else p0
        state.temperature = (kpa / farther) ** k
    elif known and 0.0 <= h <= RESTART:
        state.temperature = warmed(state.temperature, ln_p - state.ln_kpa, h, k)
    else:
        state.temperature = 1.0
    state.ln_kpa, state.t_ns = ln_p, t_ns
    iso = kpa / state.temperature
    of_iso: float = iso * (1.0 + c * (kpa - p0)) / (1.0 + c * (iso - p0))
    return of_iso


@compiled
def copy(state: Record, to: Record) -> None:
    """Remember the same."""
    to.temperature, to.ln_kpa, to.t_ns = state.temperature, state.ln_kpa, state.t_ns


@compiled
def is_same(one: Record, other: Record) -> bool:
    """Do both remember the same?"""
    pressure = one.ln_kpa == other.ln_kpa or (math.isnan(one.ln_kpa) and math.isnan(other.ln_kpa))
    return pressure and one.temperature == other.temperature and one.t_ns == other.t_ns


@compiled
def settled_at_least(law: Record, kpa: float) -> float:
    """Least pressure that the gas can settle at from one that it has now, or had more of.

    None of its heat has gone: p (p0/p)^k. Heat that has gone before only leaves it colder.

    Args:
        law: constants of the tile.
        kpa: absolute pressure; below the baseline it may have settled already.
    """
    if not kpa > law.baseline_kpa:
        return kpa
    cooled: float = kpa * (law.baseline_kpa / kpa) ** ((law.gamma - 1.0) / law.gamma)
    return cooled


@compiled
def warmed(before: float, change_ln_p: float, h: float, k: float) -> float:
    """Temperature over the wall's after a step of `h` gamma tau in which ln p changes linearly."""
    x = h - k * change_ln_p
    # (1 - exp(-x))/x, which is 1 at x = 0
    mean = -math.expm1(-x) / x if x != 0.0 else 1.0
    return before * math.exp(-x) + h * mean
