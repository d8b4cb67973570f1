"""Dome physics: contact force in, gas pressure on the chip out.

Signal chain (hardware.md 9): contact force -> creep of the rubber -> hysteresis -> volume of the
bubble -> gas temperature -> absolute pressure.

Pressures of all domes are computed in chunks on a fine time grid, and interpolated at the sample
instants: the result does not depend on the chunks or on the times of the samples.

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
from functools import partial
from typing import Protocol

import numpy as np

from devices.arrays import Floats
from devices.emulation.parts import DomeProperties, make_rng
from devices.emulation.surroundings import Surroundings
from devices.jit import jit_cached
from devices.scene.emulation_sections import EmulationSection

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


GRID_S = 0.0005
"""Grid interval. Linear interpolation of pressure is off by 0.01 kPa in a tap of 20 ms."""
_CHUNK_POINTS = 100  # grid points of a chunk, 50 ms: short, so that no transfer waits for long
_STORED_POINTS = 2000  # grid points stored behind the latest requested one
_LAG_POINTS = 20_000  # grid points, 10 s: lag beyond which coarse steps are used
_COARSE_POINTS = 40  # grid points of a coarse step, 20 ms

_KELVIN = 273.15
_PLAY_WIDTHS_N = np.array([0.5, 1.0, 2.0, 4.0])
_FLOW_N_PER_S = 7.5  # rate of force at which the viscous loop has its stated width: 30 N in 4 s
_UNLOADED_N = 0.05  # below it a dome is untouched: the next contact is a new loading


class DomeLoad(Protocol):
    """Load on the domes."""

    def forces_n(self, t_s: Floats) -> Floats:
        """Compute the force on each dome along its axis, (len(t_s), domes), never negative."""


class Domes:
    """All domes of a foot under one load, integrated forward in chunks.

    A place may be `bare`: its chip has no dome, and senses the surroundings. In real time a long
    lag is integrated in coarse steps, for example after the machine slept.
    """

    def __init__(
        self,
        parts: Sequence[DomeProperties],
        serials: Sequence[str],
        load: DomeLoad,
        scene: EmulationSection,
        surroundings: Surroundings,
        *,
        label: str,
        bare: Sequence[bool] = (),
        in_real_time: bool = False,
    ) -> None:
        self._with_effects = partial(Domes, parts, serials, load, label=label, bare=bare)
        self._bare = np.flatnonzero(bare)
        self._parts = parts
        self._load = load
        self._scene = scene
        self._surroundings = surroundings
        self._in_real_time = in_real_time
        self._seal_k = scene.ambient_degc + _KELVIN
        drifted = [
            make_rng(f"gain drift/{label}/{serial}").uniform(-1.0, 1.0) for serial in serials
        ]
        stiffening = np.array([part.stiffening for part in parts])
        self._stiffening = stiffening * (1.0 + scene.gain_drift * np.array(drifted))
        self._knee_n = np.array([part.knee_n for part in parts])
        self._loading_rngs = [make_rng(f"loading/{label}/{serial}") for serial in serials]
        self._loading_gain = np.ones(len(parts))
        self._last_force_n = np.zeros(len(parts))
        self._rubber = _RubberModel(parts)
        self._gas = BubbleState.from_parts(parts, self._seal_k)

        self._next = 0  # grid index of the first point that is not computed
        self._latest_index = 0  # the highest requested grid index
        # Chunks by number; older ones stay for late requests, so that a driver's delay does not
        # change the physics.
        self._chunks: dict[int, Floats] = {}
        self._compute_until(0)  # compile before the first sample

    def with_effects(self, scene: EmulationSection, surroundings: Surroundings) -> Domes:
        """Create the same domes under the same load, from its first instant, with other effects."""
        return self._with_effects(scene, surroundings)

    def compute_pressure_kpa(self, dome: int, t_s: float) -> float:
        """Compute the absolute gas pressure of one dome, or around a bare chip.

        Times may go back by up to a second from the latest requested one.

        Raises:
            ValueError: `t_s` is too far back.
        """
        position = t_s / GRID_S
        index = int(position)
        if index > self._latest_index:
            self._latest_index = index
        if index + 1 >= self._next:
            self._compute_until(index + 1)
        try:
            low, high = self._get_grid_kpa(index, dome), self._get_grid_kpa(index + 1, dome)
        except KeyError:
            raise ValueError(f"dome pressure at {t_s} s was asked for too late") from None
        return low + (position - index) * (high - low)

    def _get_grid_kpa(self, index: int, dome: int) -> float:
        number, row = divmod(index, _CHUNK_POINTS)
        return float(self._chunks[number][row, dome])

    def _compute_until(self, index: int) -> None:
        """Compute chunks up to grid point `index`; delete old ones."""
        if self._in_real_time and index - self._next > _LAG_POINTS:
            self._integrate_coarsely((index - _STORED_POINTS) // _CHUNK_POINTS)
        while index >= self._next:
            self._chunks[self._next // _CHUNK_POINTS] = self._compute_chunk(_CHUNK_POINTS, 1)
            self._next += _CHUNK_POINTS
        oldest = (self._latest_index - _STORED_POINTS) // _CHUNK_POINTS
        for number in [number for number in self._chunks if number < oldest]:
            del self._chunks[number]

    def _integrate_coarsely(self, to_piece: int) -> None:
        """Integrate to a chunk in coarse steps. The chunks stored after that are fine again."""
        points, rest = divmod(to_piece * _CHUNK_POINTS - self._next, _COARSE_POINTS)
        for points_now, stride in ((points, _COARSE_POINTS), (rest, 1)):
            if points_now:
                self._compute_chunk(points_now, stride)
                self._next += points_now * stride

    def _compute_chunk(self, points: int, stride: int) -> Floats:
        """Compute the pressures of `points` grid points from the next one on, `stride` apart."""
        steps = self._next + stride * np.arange(points, dtype=np.float64)
        t_s: Floats = GRID_S * steps
        force_n = np.ascontiguousarray(self._load.forces_n(t_s))
        apparent_n = self._rubber.compute_apparent_force_n(force_n, stride * GRID_S, self._scene)
        lost = (
            self._stiffening
            * np.log1p(apparent_n / self._knee_n)
            * self._draw_loading_gains(force_n)
        )
        kpa = self._compute_gas_kpa(t_s, 1.0 - lost, stride * GRID_S)
        around_kpa = self._surroundings.compute_bare_kpa(t_s)
        kpa[:, self._bare] = np.broadcast_to(around_kpa, kpa.shape)[:, self._bare]
        self._last_force_n = force_n[-1]
        return kpa

    def _draw_loading_gains(self, force_n: Floats) -> Floats:
        """Compute gains: a separate one for every loading, drawn at the contact."""
        gains = np.ones_like(force_n)
        if self._scene.repeatability == 0.0:
            return gains
        for dome in range(force_n.shape[1]):
            f = np.concatenate([[self._last_force_n[dome]], force_n[:, dome]])
            touched = np.flatnonzero((f[:-1] <= _UNLOADED_N) & (f[1:] > _UNLOADED_N))
            start = 0
            for index in touched.tolist():
                gains[start:index, dome] = self._loading_gain[dome]
                draw = self._loading_rngs[dome].standard_normal()
                self._loading_gain[dome] = 1.0 + self._scene.repeatability * draw
                start = index
            gains[start:, dome] = self._loading_gain[dome]
        return gains

    def _compute_gas_kpa(self, t_s: Floats, volume: Floats, step_s: float) -> Floats:
        """Compute the pressure of the sealed gas at a relative volume of the unstretched bubble."""
        wall_k = np.stack(
            [
                self._surroundings.compute_gas_wall_degc(t_s, part.chip_lag_s, part.gas_lag_s)
                + _KELVIN
                for part in self._parts
            ],
            axis=1,
        )
        head_kpa = np.broadcast_to(self._surroundings.compute_head_kpa(t_s), wall_k.shape).copy()
        if not self._scene.gas:
            return np.asarray(compute_static_kpa(wall_k, volume, head_kpa, self._gas.constants))
        gas = self._gas
        decay = np.exp(-step_s * gas.rates_per_s)
        gain = gas.weights * (1 - decay) / -np.log(decay)
        return np.asarray(
            compute_gas_kpa(
                wall_k, volume, head_kpa, gas.constants, gain, decay, gas.modes_k, gas.last_ln_p
            )
        )


class _RubberModel:
    """Rubber model with its state: creep, hysteresis loop, viscous branch."""

    def __init__(self, parts: Sequence[DomeProperties]) -> None:
        terms = max(len(part.creep_s) for part in parts)
        self._creep_parts = np.zeros((len(parts), terms))
        self._creep_s = np.ones((len(parts), terms))
        for dome, part in enumerate(parts):
            self._creep_parts[dome, : len(part.creep_s)] = part.creep_parts
            self._creep_s[dome, : len(part.creep_s)] = part.creep_s
        self._crept_n = np.zeros((len(parts), terms))
        self._last_force_n = np.zeros(len(parts))
        self._play_weights = np.array([part.loop_n for part in parts]) / _PLAY_WIDTHS_N.sum()
        self._play_n = np.zeros((len(parts), len(_PLAY_WIDTHS_N)))
        self._flow = ViscousBranches.from_parts(parts, _FLOW_N_PER_S)

    def compute_apparent_force_n(
        self, force_n: Floats, step_s: float, scene: EmulationSection
    ) -> Floats:
        """Compute the force that compresses the bubble, (times, domes)."""
        if scene.rubber:
            decay = np.exp(-step_s / self._creep_s)
            mean = (1 - decay) * self._creep_s / step_s
            last_n, self._last_force_n = self._last_force_n, force_n[-1].copy()
            force_n = apply_creep(force_n, last_n, self._creep_parts, decay, mean, self._crept_n)
        if scene.hysteresis:
            force_n = apply_play_hysteresis(
                force_n, _PLAY_WIDTHS_N, self._play_weights, self._play_n
            )
            flow = self._flow
            if flow.has_any:
                force_n = apply_viscous_flow(
                    force_n, flow.constants, step_s, flow.last_n, flow.branch_n
                )
        return force_n
