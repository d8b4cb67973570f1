"""`hysteresis`, the rate-dependent part: a viscous branch of the rubber (hardware.md 9).

Beside the spring a branch carries part g of every change of the force F and flows, the faster the
greater its stress; the bubble gets the rest (Bergstrom and Boyce 1998, J. Mech. Phys. Solids 46:
the rate of flow goes with a power n of the stress, about the fourth)::

    apparent = F - s,  ds/dt = g dF/dt - g R |s/S|^n sign(s)

so that under a force that changes by R for long, s is S. The flow alone has a closed form. It
stands between two halves of the step in force, which is stable for any step, and exact for a force
that is linear between samples. Solved for F at every sample, because s depends on F.
"""

from __future__ import annotations

import math

import numpy as np

from devices.jit import jit_cached
from service.estimation import LONG_GAP_NS
from service.estimation.records import KernelRecord

STROKE_N_PER_S = 10.0
"""R: about that of a rig's slow stroke, so that the stroke determines the fitted value."""
_ITERATIONS = 50  # a bound; three to five are the rule
_CLOSE = 1e-14  # of the force, or of a newton


class FlowParams(KernelRecord):
    """Parameters of a tile; those of a tile without the branch are the initial ones."""

    fraction: float  # g, part of a change of force that the branch carries at first
    stress_scale_n: float = (
        1.0  # S, force on the branch while the force changes by `STROKE_N_PER_S`
    )
    exponent: float = 4.0  # n, above 1


class FlowState(KernelRecord):
    """State of a tile's viscous branch."""

    stress_n: float  # force on the branch
    force_n: float = np.nan  # force on the dome at the previous reading; NaN before the first
    t_ns: int  # instant of that reading


@jit_cached
def compensate_flow(
    params: FlowParams,
    state: FlowState,
    apparent_n: float,
    t_ns: int,
    state_override_n: float,
    possible_gap_force_n: float,
) -> float:
    """Correct an apparent force for flow; update the state. NaN changes nothing.

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
    before, stress, passed_ns = state.force_n, state.stress_n, t_ns - state.t_ns
    dt = max(0.0, passed_ns * 1e-9)
    if possible_gap_force_n > 0.0 and passed_ns > LONG_GAP_NS:  # until just now
        before = possible_gap_force_n if before + apparent_n < possible_gap_force_n else 0.0
        stress, dt = 0.0, 0.0
    g, scale_n, n = params.fraction, params.stress_scale_n, params.exponent
    found = _solve_force(apparent_n, before, stress, g, scale_n, n, dt)
    now = found if math.isnan(state_override_n) else state_override_n
    state.stress_n = step_branch_stress(stress, g, scale_n, n, now - before, dt)
    state.force_n, state.t_ns = now, t_ns
    return found


@jit_cached
def settle_state(state: FlowState, force_n: float, t_ns: int) -> None:
    """Set the state of a branch that has relaxed under a force, until `t_ns`."""
    state.stress_n, state.force_n, state.t_ns = 0.0, force_n, t_ns


@jit_cached
def copy_state(state: FlowState, to: FlowState) -> None:
    """Copy a state into another."""
    to.stress_n, to.force_n, to.t_ns = state.stress_n, state.force_n, state.t_ns


@jit_cached
def is_same_state(one: FlowState, other: FlowState) -> bool:
    """Return whether two states are equal; NaN does not equal NaN."""
    forces = one.stress_n == other.stress_n and one.force_n == other.force_n
    return bool(forces and one.t_ns == other.t_ns)


@jit_cached
def step_branch_stress(
    stress_n: float,
    fraction: float,
    stress_scale_n: float,
    exponent: float,
    force_rise_n: float,
    dt_s: float,
) -> float:
    """Return the force on the branch after the dome's has risen by `force_rise_n` within `dt_s`."""
    half = 0.5 * fraction * force_rise_n
    between = stress_n + half
    decay = _compute_flow_decay(between, fraction, stress_scale_n, exponent, dt_s)
    return float(between * decay ** (1.0 / (1.0 - exponent)) + half)


@jit_cached
def _compute_flow_decay(
    stress: float, fraction: float, stress_scale_n: float, exponent: float, dt: float
) -> float:
    """Return (s(0)/s(t))^(n - 1) of the flow alone, within `dt`."""
    rate_per_s = (exponent - 1.0) * fraction * STROKE_N_PER_S / stress_scale_n
    decay: float = 1.0 + rate_per_s * dt * (abs(stress) / stress_scale_n) ** (exponent - 1.0)
    return decay


@jit_cached
def _solve_force(
    apparent: float,
    before: float,
    stress: float,
    fraction: float,
    stress_scale_n: float,
    exponent: float,
    dt: float,
) -> float:
    """Solve for the force whose apparent force at the end of a step is `apparent`.

    The slope of the apparent force over the force is between 1 - g and 1. With g below a half
    Newton's method converges from any start.
    """
    force = apparent + stress
    for _ in range(_ITERATIONS):
        half = 0.5 * fraction * (force - before)
        between = stress + half
        decay = _compute_flow_decay(between, fraction, stress_scale_n, exponent, dt)
        value = force - half - between * decay ** (1.0 / (1.0 - exponent))
        slope = 1.0 - 0.5 * fraction * (1.0 + decay ** (exponent / (1.0 - exponent)))
        step = (value - apparent) / slope
        force -= step
        if abs(step) <= _CLOSE * max(abs(force), 1.0):
            break
    return force
