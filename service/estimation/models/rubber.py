"""`rubber`: creep of the dome, whose rubber gives way to a force within seconds (hardware.md 9).

Of a force F a part appears in the bubble at once and the rest later; two Prony terms with the parts
g and times tau::

    apparent = F - sum g (F - z),  tau dz/dt = F - z

Inverted for F with F linear between samples, which is exact, and stable for any step. A settled
force appears whole, so the static curve is unchanged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation.effects import TERMS_MAX
from service.estimation.foot import LONG_GAP_NS
from service.estimation.records import KernelRecord, RecordArray


class RubberParams(KernelRecord):
    """Parameters of a tile, as in `CreepModel`."""

    creep_fraction: Annotated[Floats, (TERMS_MAX,)]
    tau_s: Annotated[Floats, (TERMS_MAX,)]
    n_terms: int


class RubberState(KernelRecord):
    """State of a tile's creep."""

    force_n: float  # at the previous reading; NaN before the first
    t_ns: int  # instant of that reading
    crept_n: Annotated[Floats, (TERMS_MAX,)]  # z of each term
    force_share: Annotated[Floats, (TERMS_MAX,)]  # scratch: weight of the present force in z


def initial_state(tiles: int) -> RecordArray[RubberState]:
    """Make the states before the first reading, (tiles,)."""
    return RubberState.array(tiles, force_n=np.nan)


@dataclass(frozen=True)
class CreepModel:
    """Parameters (tiles, terms): parts of the force that appear later, and their time constants."""

    creep_fraction: Floats
    tau_s: Floats

    def to_records(self) -> RecordArray[RubberParams]:
        """Make the kernel's parameters, (tiles,)."""
        tiles, terms = self.creep_fraction.shape
        made = RubberParams.array(tiles, n_terms=terms)
        made["creep_fraction"][:, :terms] = self.creep_fraction
        made["tau_s"][:, :terms] = self.tau_s
        return made


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
