"""`rubber`: creep of the dome, whose rubber gives way to a force within seconds (hardware.md 9).

Of a force F a part appears in the bubble at once and the rest later; two Prony terms with the parts
g and times tau::

    apparent = F - sum g (F - z),  tau dz/dt = F - z

Inverted for F with F linear between samples, which is exact, and stable for any step. A settled
force appears whole, so the static curve is unchanged.
"""

from __future__ import annotations

import math
from typing import Annotated, Self

import numpy as np

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation import LONG_GAP_NS
from service.estimation.effects import MISFIT_MIN, TERMS_MAX, parameter_values
from service.estimation.models import LoadBearingTiles, ModelParams
from service.estimation.records import KernelRecord, RecordArray


class RubberParams(ModelParams):
    """Parameters of a tile; a tile without creep, or with fewer terms, has fractions of zero."""

    effect = "rubber"

    creep_fraction: Annotated[Floats, (TERMS_MAX,)]  # parts of the force that appear later
    tau_s: Annotated[Floats, (TERMS_MAX,)]  # time constants
    n_terms: int  # largest number of terms of any tile

    @classmethod
    def make(cls, tiles: LoadBearingTiles) -> RecordArray[Self]:
        """Make the parameters of load-bearing tiles, (tiles,)."""
        found = [tile.effects.rubber for tile in tiles.calibrations]
        terms = [0 if effect is None else len(effect.part) for effect in found]
        made = cls.array(len(found), n_terms=max(terms), tau_s=1.0)
        for i, effect in enumerate(found):
            if effect is not None:
                made["creep_fraction"][i, : terms[i]] = parameter_values(effect.part)
                made["tau_s"][i, : terms[i]] = parameter_values(effect.tau_s)
        return made

    @classmethod
    def longest_time_constant_s(cls, params: RecordArray[Self]) -> float:
        """Return the longest time constant of a tile's creep."""
        return float(params["tau_s"][params["creep_fraction"] > 0.0].max())


def collect_misfits(tiles: LoadBearingTiles) -> Floats:
    """Return the uncertain part of each tile's corrections of creep and loop."""
    found = [tile.effects.rubber for tile in tiles.calibrations]
    return np.array([0.0 if e is None else max(e.misfit, MISFIT_MIN) for e in found])


class RubberState(KernelRecord):
    """State of a tile's creep."""

    force_n: float = np.nan  # at the previous reading; NaN before the first
    t_ns: int  # instant of that reading
    crept_n: Annotated[Floats, (TERMS_MAX,)]  # z of each term
    force_share: Annotated[Floats, (TERMS_MAX,)]  # scratch: weight of the present force in z


@jit_cached
def compensate_creep(
    params: RubberParams,
    state: RubberState,
    apparent_n: float,
    t_ns: int,
    state_override_n: float,
    possible_gap_force_n: float,
) -> float:
    """Correct an apparent force for creep; update the state. NaN changes nothing.

    Args:
        params: of the tile.
        state: after the tile's readings before; updated.
        apparent_n: apparent force.
        t_ns: instant.
        state_override_n: force that updates the state instead of the returned one; NaN: that one.
        possible_gap_force_n: force that the dome may have borne during more than `LONG_GAP_NS`
            without a reading: the farther of this force and none from a straight line; NaN: the
            straight line.
    """
    if not math.isfinite(apparent_n):
        return math.nan
    if math.isnan(state.force_n):  # the first reading: at rest without a force
        state.force_n, state.t_ns = 0.0, t_ns
    before, passed_ns = state.force_n, t_ns - state.t_ns
    after_gap = possible_gap_force_n > 0.0 and passed_ns > LONG_GAP_NS
    meanwhile_n = possible_gap_force_n if before + apparent_n < possible_gap_force_n else 0.0
    divisor, known = 1.0, apparent_n
    for m in range(params.n_terms):
        decay, of_before, of_now = compute_creep_weights(
            max(0.0, passed_ns * 1e-9 / params.tau_s[m])
        )
        if after_gap:  # until just now
            carried, share = decay * state.crept_n[m] + (1.0 - decay) * meanwhile_n, 0.0
        else:
            carried, share = decay * state.crept_n[m] + of_before * before, of_now
        divisor -= params.creep_fraction[m] * (1.0 - share)
        known -= params.creep_fraction[m] * carried
        state.crept_n[m], state.force_share[m] = carried, share
    found = known / divisor
    now = found if math.isnan(state_override_n) else state_override_n
    for m in range(params.n_terms):
        state.crept_n[m] += state.force_share[m] * now
    state.force_n, state.t_ns = now, t_ns
    return found


@jit_cached
def settle_state(params: RubberParams, state: RubberState, force_n: float, t_ns: int) -> None:
    """Set the state of a dome that has borne a force for long, until `t_ns`."""
    state.force_n, state.t_ns = force_n, t_ns
    for m in range(params.n_terms):
        state.crept_n[m] = force_n


@jit_cached
def sum_fractions(params: RubberParams) -> float:
    """Return the part of a force that appears later, by all terms."""
    total = 0.0
    for m in range(params.n_terms):
        total += params.creep_fraction[m]
    return total


@jit_cached
def copy_state(state: RubberState, to: RubberState) -> None:
    """Copy a state into another."""
    to.force_n, to.t_ns = state.force_n, state.t_ns
    for m in range(len(state.crept_n)):
        to.crept_n[m] = state.crept_n[m]


@jit_cached
def is_same_state(one: RubberState, other: RubberState) -> bool:
    """Return whether two states are equal; NaN does not equal NaN."""
    for m in range(len(one.crept_n)):
        if one.crept_n[m] != other.crept_n[m]:
            return False
    return bool(one.force_n == other.force_n and one.t_ns == other.t_ns)


@jit_cached
def compute_creep_weights(step_time_constants: float) -> tuple[float, float, float]:
    """Return the weights of z, of the previous and of the present force after a step.

    Their sum is the crept part z at the end of a step in which the force is linear.
    """
    decay = math.exp(-step_time_constants)
    mean = (
        -math.expm1(-step_time_constants) / step_time_constants
        if step_time_constants > 0.0
        else 1.0
    )
    return decay, mean - decay, 1.0 - mean
