"""Time steps of the dome's equations: creep, hysteresis and flow of the rubber, and gas.

Gas: heat conduction in a sphere with an isothermal wall, eight modes. Rubber: Prony terms, as many
as the part has, four play operators, and for some parts a viscous branch (Bergstrom and Boyce 1998:
filled rubbers lose energy in chains that creep past one another, at a rate that is a high power of
their stress, so that the loop grows slowly with speed; there about the fourth). The estimator uses
only that last equation, with other part, power and width for each dome, and no number from here.

Arrays are (times, domes); state is updated in place. Every point follows from the previous one, so
that the bits do not depend on the split of time into chunks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.emulation.parts import DomeProperties
from devices.jit import jit_cached

_MODES = np.arange(1, 9)
_MODE_WEIGHTS: Floats = (
    6.0 / (np.pi * _MODES.astype(np.float64)) ** 2
)  # weights of the modes in the mean temperature of a heated sphere
_ROUNDS_MAX = 60  # a bound; each contracts by kappa
_ROUNDS_END_K = 1e-9  # 3e-10 kPa


@jit_cached
def apply_creep(
    force_n: Floats, last_n: Floats, parts: Floats, decay: Floats, mean: Floats, slow_n: Floats
) -> Floats:
    """Apply creep: each term's part of the force appears with a delay, finally in full.

    Args:
        force_n: (times, domes).
        last_n: (domes,), force at the previous point.
        parts: (domes, terms), parts of the force; 0: no such term.
        decay: (domes, terms), decay within a step.
        mean: (domes, terms), mean of a term's decay over a step.
        slow_n: (domes, terms), state: delayed force.
    """
    apparent_n = np.empty_like(force_n)
    for dome in range(force_n.shape[1]):
        before_n = last_n[dome]
        for k in range(force_n.shape[0]):
            f_n = force_n[k, dome]
            felt_n = f_n
            for term in range(parts.shape[1]):
                keep, evenly = decay[dome, term], mean[dome, term]
                # Exact for a force that is linear between grid points.
                driven_n = (evenly - keep) * before_n + (1.0 - evenly) * f_n
                slow_n[dome, term] = driven_n + keep * slow_n[dome, term]
                felt_n += parts[dome, term] * (slow_n[dome, term] - f_n)
            apparent_n[k, dome] = max(felt_n, 0.0)
            before_n = f_n
    return apparent_n


@jit_cached
def apply_play_hysteresis(
    force_n: Floats, widths_n: Floats, weights: Floats, play_n: Floats
) -> Floats:
    """Apply hysteresis by generalised play: operators lag between branches that meet at zero load.

    Args:
        force_n: (times, domes).
        widths_n: (operators,), widths of the operators.
        weights: (domes,), weight of every operator.
        play_n: (domes, operators), state.
    """
    looped_n = np.empty_like(force_n)
    for dome in range(force_n.shape[1]):
        for k in range(force_n.shape[0]):
            f_n = force_n[k, dome]
            lag_n = 0.0
            for i in range(len(widths_n)):
                half_n = widths_n[i] * -math.expm1(-f_n / (3.0 * widths_n[i]))
                y_n = min(max(play_n[dome, i], f_n - half_n), f_n + half_n)
                play_n[dome, i] = y_n
                lag_n += y_n - f_n
            looped_n[k, dome] = f_n + weights[dome] * lag_n
    return looped_n


@dataclass(frozen=True)
class ViscousBranches:
    """Viscous branches of all domes, and their state.

    Attributes:
        constants: (domes, 3), part of the force, power of the stress, and rate; part 0: no branch.
        last_n: (domes,), force at the previous point.
        branch_n: (domes,), stress of the branch.
    """

    constants: Floats
    last_n: Floats
    branch_n: Floats

    @classmethod
    def from_parts(cls, parts: Sequence[DomeProperties], n_per_s: float) -> ViscousBranches:
        """Build the branches of domes; loops have their stated width at a rate of `n_per_s`."""
        constants = np.zeros((len(parts), 3))
        for dome, part in enumerate(parts):
            if part.viscous_n > 0.0:
                more = part.flow_power - 1.0
                per_s = more * part.flow_part * n_per_s / part.viscous_n**part.flow_power
                constants[dome] = part.flow_part, part.flow_power, per_s
        return cls(constants, np.zeros(len(parts)), np.zeros(len(parts)))

    @property
    def has_any(self) -> bool:
        """True if any dome has a viscous branch."""
        return bool((self.constants[:, 0] > 0.0).any())


@jit_cached
def apply_viscous_flow(
    force_n: Floats, constants: Floats, step_s: float, last_n: Floats, branch_n: Floats
) -> Floats:
    """Subtract the stress of viscous branches from forces; the bubble gets the rest.

    Branch stress s: ds/dt = part dF/dt - rate |s|^power sign(s). The flow alone has a closed form,
    applied between two halves of the step in force; at the rate of force given to
    `ViscousBranches.from_parts` s tends to `viscous_n`.

    Args:
        force_n: (times, domes).
        constants: (domes, 3), as of `ViscousBranches`.
        step_s: seconds between two times.
        last_n: (domes,), state: force at the previous point.
        branch_n: (domes,), state.
    """
    rest_n = force_n.copy()
    for dome in range(force_n.shape[1]):
        part, power, per_s = constants[dome]
        if part <= 0.0:
            continue
        more = power - 1.0
        flow, root = per_s * step_s, -1.0 / more
        s = branch_n[dome]
        for k in range(force_n.shape[0]):
            half = 0.5 * part * (force_n[k, dome] - last_n[dome])
            last_n[dome] = force_n[k, dome]
            s += half
            s = s * (1.0 + flow * abs(s) ** more) ** root + half
            rest_n[k, dome] = max(force_n[k, dome] - s, 0.0)
        branch_n[dome] = s
    return rest_n


@dataclass(frozen=True)
class BubbleState:
    """Gas of all domes, and its state.

    Attributes:
        constants: (domes, 4), pressure and temperature at sealing, compliance of the wall per kPa,
            and kappa.
        weights: (modes,), weights in the mean temperature.
        rates_per_s: (domes, modes), decay rates.
        modes_k: (domes, modes), temperatures of the modes.
        last_ln_p: (domes,), logarithm of the pressure at the previous point.
    """

    constants: Floats
    weights: Floats
    rates_per_s: Floats
    modes_k: Floats
    last_ln_p: Floats

    @classmethod
    def from_parts(cls, parts: Sequence[DomeProperties], seal_k: float) -> BubbleState:
        """Build the gas of domes, at rest."""
        constants = np.array(
            [(part.seal_kpa, seal_k, part.wall_per_kpa, part.kappa) for part in parts]
        )
        conduction_s = np.array([part.conduction_s for part in parts])
        return cls(
            constants,
            _MODE_WEIGHTS,
            _MODES**2 / conduction_s[:, None],
            np.zeros((len(parts), len(_MODES))),
            np.log(constants[:, 0]),
        )


@jit_cached
def _solve_kpa(
    gas_k: float, volume: float, head_kpa: float, seal_kpa: float, seal_k: float, c: float
) -> float:
    """Solve p volume (1 + c (p - seal - head)) = seal T / T_seal for p."""
    linear = 1.0 - c * (seal_kpa + head_kpa)
    right = seal_kpa * gas_k / (seal_k * volume)
    return 2 * right / (linear + math.sqrt(linear**2 + 4 * c * right))


@jit_cached
def compute_static_kpa(
    wall_k: Floats, volume: Floats, head_kpa: Floats, constants: Floats
) -> Floats:
    """Compute the pressure of gas at its wall's temperature; arguments as of `compute_gas_kpa`."""
    kpa = np.empty_like(volume)
    for dome in range(volume.shape[1]):
        seal_kpa, seal_k, c = constants[dome, 0], constants[dome, 1], constants[dome, 2]
        for k in range(volume.shape[0]):
            kpa[k, dome] = _solve_kpa(
                wall_k[k, dome], volume[k, dome], head_kpa[k, dome], seal_kpa, seal_k, c
            )
    return kpa


@jit_cached
def compute_gas_kpa(
    wall_k: Floats,
    volume: Floats,
    head_kpa: Floats,
    constants: Floats,
    gain: Floats,
    decay: Floats,
    modes_k: Floats,
    last_ln_p: Floats,
) -> Floats:
    """Compute the pressure of gas with adiabatic heating and heat conduction.

    Mean gas temperature T = wall + sum of modes; mode n is driven by kappa T d(ln p) times its
    weight and decays with conduction_s / n^2. The wall yields to the pressure difference over it.
    Pressure and temperature depend on each other: Picard iteration at each point, which contracts
    by less than kappa.

    Args:
        wall_k: (times, domes), temperature of the wall.
        volume: (times, domes), relative volume of the unstretched bubble.
        head_kpa: (times, domes), pressure around it above the atmosphere's.
        constants: (domes, 4), as of `BubbleState`.
        gain: (domes, modes), gain of a mode's drive within a step.
        decay: (domes, modes), decay within a step.
        modes_k: (domes, modes), state.
        last_ln_p: (domes,), state.
    """
    kpa = np.empty_like(volume)
    for dome in range(volume.shape[1]):
        seal_kpa, seal_k, c = constants[dome, 0], constants[dome, 1], constants[dome, 2]
        kappa = constants[dome, 3]
        # Scalar loops: array sums compile a quarter of a second longer, which delays a first start.
        gain_of_all, excess_k = 0.0, 0.0
        for mode in range(decay.shape[1]):
            gain_of_all += gain[dome, mode]
            excess_k += modes_k[dome, mode]
        for k in range(volume.shape[0]):
            left_k = 0.0
            for mode in range(decay.shape[1]):
                left_k += decay[dome, mode] * modes_k[dome, mode]
            drive_k = 0.0
            for _ in range(_ROUNDS_MAX):
                gas_k = wall_k[k, dome] + excess_k
                p = _solve_kpa(gas_k, volume[k, dome], head_kpa[k, dome], seal_kpa, seal_k, c)
                drive_k = kappa * gas_k * (math.log(p) - last_ln_p[dome])
                new_k = left_k + gain_of_all * drive_k
                change_k = abs(new_k - excess_k)
                excess_k = new_k
                if change_k < _ROUNDS_END_K:
                    break
            gas_k = wall_k[k, dome] + excess_k
            kpa[k, dome] = _solve_kpa(
                gas_k, volume[k, dome], head_kpa[k, dome], seal_kpa, seal_k, c
            )
            last_ln_p[dome] = math.log(kpa[k, dome])
            for mode in range(decay.shape[1]):
                modes_k[dome, mode] = (
                    decay[dome, mode] * modes_k[dome, mode] + gain[dome, mode] * drive_k
                )
    return kpa
