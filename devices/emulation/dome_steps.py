"""The equations of the dome, step by step in time: rubber that creeps, sticks and flows, and gas.

The gas is heat conduction in a sphere with an isothermal wall, eight modes; the rubber Prony terms,
as many as the part has, and four play operators, and where the part has it a branch that flows
(Bergstrom and Boyce 1998: filled rubbers lose energy in chains that creep past one another, at a
rate that is a high power of their stress, so that the loop grows slowly with speed; there about the
fourth). None of these equations is the estimator's but that one, whose part, power and width are
each dome's own; and no number is.

Arrays are (times, domes); state is written in place. Every point follows from the one before, so
that the bits are the same however time is cut into pieces.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.compiled import compiled
from devices.emulation.parts import DomePart

_MODES = np.arange(1, 9)
_MODE_WEIGHTS: Floats = (
    6.0 / (np.pi * _MODES.astype(np.float64)) ** 2
)  # of the mean temperature of a heated sphere
_ROUNDS_MAX = 60  # a bound; each contracts by kappa
_ROUNDS_END_K = 1e-9  # 3e-10 kPa


@compiled
def crept_n(
    force_n: Floats, last_n: Floats, parts: Floats, decay: Floats, mean: Floats, slow_n: Floats
) -> Floats:
    """Creep: part of the force appears only after each term's time, statically all of it.

    Args:
        force_n: (times, domes).
        last_n: (domes,), at the point before.
        parts: (domes, terms), of the force; 0: there is no such term.
        decay: (domes, terms), within a step.
        mean: (domes, terms), of a term's decay over a step.
        slow_n: (domes, terms), state: what has appeared.
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


@compiled
def played_n(force_n: Floats, widths_n: Floats, weights: Floats, play_n: Floats) -> Floats:
    """Generalised play: each operator lags between two branches that meet at zero load.

    Args:
        force_n: (times, domes).
        widths_n: (operators,).
        weights: (domes,), of each operator.
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
class FlowParts:
    """Branches that flow, and their state.

    Attributes:
        constants: (domes, 3), part of the force, power of the stress, and rate; part 0: none.
        last_n: (domes,), force at the point before.
        branch_n: (domes,), stress of the branch.
    """

    constants: Floats
    last_n: Floats
    branch_n: Floats

    @classmethod
    def of(cls, parts: Sequence[DomePart], n_per_s: float) -> FlowParts:
        """Of these domes; a loop is as wide as its part says where the force changes so fast."""
        constants = np.zeros((len(parts), 3))
        for dome, part in enumerate(parts):
            if part.viscous_n > 0.0:
                more = part.flow_power - 1.0
                per_s = more * part.flow_part * n_per_s / part.viscous_n**part.flow_power
                constants[dome] = part.flow_part, part.flow_power, per_s
        return cls(constants, np.zeros(len(parts)), np.zeros(len(parts)))

    @property
    def is_there(self) -> bool:
        """Has any dome such a branch?"""
        return bool((self.constants[:, 0] > 0.0).any())


@compiled
def flowed_n(
    force_n: Floats, constants: Floats, step_s: float, last_n: Floats, branch_n: Floats
) -> Floats:
    """A branch beside the spring bears part of a change, and flows: the bubble gets the rest.

    Branch stress s: ds/dt = part dF/dt - rate |s|^power sign(s). The flow by itself has a closed
    form, which stands between two halves of the step in force; where F changes as fast as
    `FlowParts.of` was told it ends at s = `viscous_n`.

    Args:
        force_n: (times, domes).
        constants: (domes, 3), as of `FlowParts`.
        step_s: seconds between two times.
        last_n: (domes,), state: force at the point before.
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
class GasParts:
    """The gas of each dome, and its state.

    Attributes:
        constants: (domes, 4), pressure and temperature at which it was sealed, give of the wall for
            each kPa over it, and kappa.
        weights: (modes,), of the mean temperature.
        rates_per_s: (domes, modes), at which modes decay.
        modes_k: (domes, modes).
        last_ln_p: (domes,), at the point before.
    """

    constants: Floats
    weights: Floats
    rates_per_s: Floats
    modes_k: Floats
    last_ln_p: Floats

    @classmethod
    def of(cls, parts: Sequence[DomePart], seal_k: float) -> GasParts:
        """Of these domes, at rest."""
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


@compiled
def _kpa(
    gas_k: float, volume: float, head_kpa: float, seal_kpa: float, seal_k: float, c: float
) -> float:
    """Solve p volume (1 + c (p - seal - head)) = seal T / T_seal for p."""
    linear = 1.0 - c * (seal_kpa + head_kpa)
    right = seal_kpa * gas_k / (seal_k * volume)
    return 2 * right / (linear + math.sqrt(linear**2 + 4 * c * right))


@compiled
def static_kpa(wall_k: Floats, volume: Floats, head_kpa: Floats, constants: Floats) -> Floats:
    """Pressure of gas that is as warm as its wall; arguments as of `gas_kpa`."""
    kpa = np.empty_like(volume)
    for dome in range(volume.shape[1]):
        seal_kpa, seal_k, c = constants[dome, 0], constants[dome, 1], constants[dome, 2]
        for k in range(volume.shape[0]):
            kpa[k, dome] = _kpa(
                wall_k[k, dome], volume[k, dome], head_kpa[k, dome], seal_kpa, seal_k, c
            )
    return kpa


@compiled
def gas_kpa(
    wall_k: Floats,
    volume: Floats,
    head_kpa: Floats,
    constants: Floats,
    gain: Floats,
    decay: Floats,
    modes_k: Floats,
    last_ln_p: Floats,
) -> Floats:
    """Pressure of gas that is warmed by being squeezed.

    Mean gas temperature T = wall + sum of modes; mode n is driven by kappa T d(ln p) times its
    weight and decays with conduction_s / n^2. The wall yields to the pressure difference over it.
    Pressure and temperature depend on each other: Picard iteration at each point, which contracts
    by less than kappa.

    Args:
        wall_k: (times, domes), temperature of the wall.
        volume: (times, domes), of the unstretched bubble, relative.
        head_kpa: (times, domes), pressure around it above the atmosphere's.
        constants: (domes, 4), as of `GasParts`.
        gain: (domes, modes), of what drives a mode within a step.
        decay: (domes, modes), within a step.
        modes_k: (domes, modes), state.
        last_ln_p: (domes,), state.
    """
    kpa = np.empty_like(volume)
    for dome in range(volume.shape[1]):
        seal_kpa, seal_k, c = constants[dome, 0], constants[dome, 1], constants[dome, 2]
        kappa = constants[dome, 3]
        # Loops and numbers, for sums and rows take numba a quarter of a second longer to compile,
        # which a first start waits for.
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
                p = _kpa(gas_k, volume[k, dome], head_kpa[k, dome], seal_kpa, seal_k, c)
                drive_k = kappa * gas_k * (math.log(p) - last_ln_p[dome])
                new_k = left_k + gain_of_all * drive_k
                change_k = abs(new_k - excess_k)
                excess_k = new_k
                if change_k < _ROUNDS_END_K:
                    break
            gas_k = wall_k[k, dome] + excess_k
            kpa[k, dome] = _kpa(gas_k, volume[k, dome], head_kpa[k, dome], seal_kpa, seal_k, c)
            last_ln_p[dome] = math.log(kpa[k, dome])
            for mode in range(decay.shape[1]):
                modes_k[dome, mode] = (
                    decay[dome, mode] * modes_k[dome, mode] + gain[dome, mode] * drive_k
                )
    return kpa
