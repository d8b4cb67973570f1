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

from devices.arrays import Arrays, Floats, Times
from devices.compiled import compiled
from service.estimation.foot.contact import UNSEEN_NS

RESTART = 5.0
"""After this many gamma tau without a reading the gas is as warm as its wall."""


@dataclass(frozen=True)
class GasState(Arrays):
    """Of every tile: temperature over the wall's, and the reading before (NaN: none)."""

    temperature: Floats
    ln_kpa: Floats
    t_ns: Times


def at_rest(tiles: int) -> GasState:
    """Before the first reading."""
    return GasState(np.ones(tiles), np.full(tiles, np.nan), np.zeros(tiles, dtype=np.int64))


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

    def settled_at_least(self, kpa: Floats) -> Floats:
        """Least pressure that the gas can settle at from one that it has now, or had more of.

        None of its heat has gone: p (p0/p)^k. Heat that has gone before only leaves it colder.

        Args:
            kpa: absolute pressures over tiles; below the baseline it may have settled already.
        """
        k = (self.gamma - 1.0) / self.gamma
        return np.asarray(kpa * (self.baseline_kpa / np.maximum(kpa, self.baseline_kpa)) ** k)

    def settled(
        self, kpa: Floats, t_ns: Times, state: GasState, *, away_kpa: Floats | None = None
    ) -> tuple[Floats, GasState]:
        """Pressures that measured ones would settle at.

        Args:
            kpa: absolute pressures (n, tiles); NaN stays NaN and changes nothing after it.
            t_ns: instants of the readings (n, tiles).
            state: from the readings before.
            away_kpa: (tiles,), pressure that the gas may have had until just now, if there was no
                reading for more than `UNSEEN_NS`: it had this one or its baseline, whichever is
                farther from the present; None: a straight line was between, or it has cooled.
        """
        out = np.empty_like(kpa)
        after = state.copy()
        _settle(
            np.ascontiguousarray(kpa),
            np.ascontiguousarray(t_ns),
            self.gamma,
            self.tau_s,
            self.wall_per_kpa,
            self.baseline_kpa,
            np.full(len(self.gamma), math.nan) if away_kpa is None else away_kpa,
            after.temperature,
            after.ln_kpa,
            after.t_ns,
            out,
        )
        return out, after


@compiled
def warmed(before: float, change_ln_p: float, h: float, k: float) -> float:
    """Temperature over the wall's after a step of `h` gamma tau in which ln p changes linearly."""
    x = h - k * change_ln_p
    # (1 - exp(-x))/x, which is 1 at x = 0
    mean = -math.expm1(-x) / x if x != 0.0 else 1.0
    return before * math.exp(-x) + h * mean


@compiled
def _settle(
    kpa: Floats,
    t_ns: Times,
    gamma: Floats,
    tau_s: Floats,
    wall_per_kpa: Floats,
    baseline_kpa: Floats,
    away_kpa: Floats,
    temperature: Floats,
    ln_kpa: Floats,
    last_ns: Times,
    out: Floats,
) -> None:
    n, tiles = kpa.shape
    for j in range(tiles):
        gamma_tau_ns = gamma[j] * tau_s[j] * 1e9
        k = (gamma[j] - 1.0) / gamma[j]
        c, p0 = wall_per_kpa[j], baseline_kpa[j]
        now, before, before_ns = temperature[j], ln_kpa[j], last_ns[j]
        for i in range(n):
            p = kpa[i, j]
            if not 0.0 < p < math.inf:
                out[i, j] = math.nan
                continue
            ln_p = math.log(p)
            h = (t_ns[i, j] - before_ns) / gamma_tau_ns
            if math.isnan(before) or not 0.0 <= h <= RESTART:
                now = 1.0
            else:
                now = warmed(now, ln_p - before, h, k)
            if away_kpa[j] > p0 and t_ns[i, j] - before_ns > UNSEEN_NS and not math.isnan(before):
                farther = away_kpa[j] if away_kpa[j] * p0 > p * p else p0
                now = (p / farther) ** k
            before, before_ns = ln_p, t_ns[i, j]
            iso = p / now
            out[i, j] = iso * (1.0 + c * (p - p0)) / (1.0 + c * (iso - p0))
        temperature[j], ln_kpa[j], last_ns[j] = now, before, before_ns
