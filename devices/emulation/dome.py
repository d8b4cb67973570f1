"""The dome: contact force in, gas pressure on the chip out.

Order of the chain (hardware.md 9): contact force -> creep of the rubber -> hysteresis -> volume of
the bubble -> gas temperature -> absolute pressure; the equations are `dome_steps`.

Everything is computed in pieces of time on a fine grid, for all domes at once, and interpolated
where a chip samples: the physics does not know who asks, or when, and no piece shows where it ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Protocol

import numpy as np

from devices.arrays import Floats
from devices.emulation.dome_steps import (
    FlowParts,
    GasParts,
    crept_n,
    flowed_n,
    gas_kpa,
    played_n,
    static_kpa,
)
from devices.emulation.parts import DomePart, random_of
from devices.emulation.surroundings import Surroundings
from devices.scene.emulated import EmulationScene

GRID_S = 0.0005
"""Between grid points pressure is taken as linear: in a tap of 20 ms that is off by 0.01 kPa."""
_PIECE = 100  # grid points, 50 ms: so little is computed at once that no transfer waits for long
_KEPT = 2000  # grid points behind the latest that was asked for
_LATE = 20_000  # grid points, 10 s: so far behind it is quicker to go on coarsely
_COARSE = 40  # grid points, 20 ms

_KELVIN = 273.15
_PLAY_WIDTHS_N = np.array([0.5, 1.0, 2.0, 4.0])
_FLOW_N_PER_S = 7.5  # where the loop is as wide as the part says: 30 N within 4 s
_UNLOADED_N = 0.05  # a dome that bears less is not touched: the next touch is a new loading


class Load(Protocol):
    """What presses on the domes."""

    def forces_n(self, t_s: Floats) -> Floats:
        """Force on each dome along its axis, shape (len(t_s), domes), never negative."""


class Domes:
    """All domes of a foot under one load, integrated forward in pieces.

    A place may be `bare`: its chip has no dome, and senses what is around it. In real time those
    who are far behind go on coarsely: a machine that slept would else have all of it to compute.
    """

    def __init__(
        self,
        parts: Sequence[DomePart],
        serials: Sequence[str],
        load: Load,
        scene: EmulationScene,
        surroundings: Surroundings,
        *,
        label: str,
        bare: Sequence[bool] = (),
        in_real_time: bool = False,
    ) -> None:
        self._again = partial(Domes, parts, serials, load, label=label, bare=bare)
        self._bare = np.flatnonzero(bare)
        self._parts = parts
        self._load = load
        self._scene = scene
        self._surroundings = surroundings
        self._in_real_time = in_real_time
        self._seal_k = scene.ambient_degc + _KELVIN
        drifted = [
            random_of(f"gain drift/{label}/{serial}").uniform(-1.0, 1.0) for serial in serials
        ]
        stiffening = np.array([part.stiffening for part in parts])
        self._stiffening = stiffening * (1.0 + scene.gain_drift * np.array(drifted))
        self._knee_n = np.array([part.knee_n for part in parts])
        self._loading_rngs = [random_of(f"loading/{label}/{serial}") for serial in serials]
        self._loading_gain = np.ones(len(parts))
        self._last_force_n = np.zeros(len(parts))
        self._rubber = _Rubber(parts)
        self._gas = GasParts.of(parts, self._seal_k)

        self._next = 0  # grid index of the first point that is not computed
        self._asked = 0  # the highest grid index that was asked for
        # By number. What may still be asked for stays, however far the newest was: how late a
        # driver is decides when it asks, not what the dome was like then.
        self._pieces: dict[int, Floats] = {}
        self._extend(0)  # what is compiled is ready before a chip asks

    def again(self, scene: EmulationScene, surroundings: Surroundings) -> Domes:
        """The same domes under the same load from its first instant on, with other effects."""
        return self._again(scene, surroundings)

    def pressure_kpa(self, dome: int, t_s: float) -> float:
        """Absolute gas pressure of one dome, or around a bare chip.

        Times may go back, but not by more than a second from the latest that was asked for.

        Raises:
            ValueError: `t_s` lies before what is still kept.
        """
        position = t_s / GRID_S
        index = int(position)
        if index > self._asked:
            self._asked = index
        if index + 1 >= self._next:
            self._extend(index + 1)
        try:
            low, high = self._at(index, dome), self._at(index + 1, dome)
        except KeyError:
            raise ValueError(f"dome pressure at {t_s} s was asked for too late") from None
        return low + (position - index) * (high - low)

    def _at(self, index: int, dome: int) -> float:
        number, row = divmod(index, _PIECE)
        return float(self._pieces[number][row, dome])

    def _extend(self, index: int) -> None:
        """Compute pieces until grid point `index` is there."""
        if self._in_real_time and index - self._next > _LATE:
            self._leap((index - _KEPT) // _PIECE)
        while index >= self._next:
            self._pieces[self._next // _PIECE] = self._compute(_PIECE, 1)
            self._next += _PIECE
        oldest = (self._asked - _KEPT) // _PIECE
        for number in [number for number in self._pieces if number < oldest]:
            del self._pieces[number]

    def _leap(self, to_piece: int) -> None:
        """Go on to a piece in coarse steps. What is kept before a sample is computed finely."""
        points, rest = divmod(to_piece * _PIECE - self._next, _COARSE)
        for points_now, stride in ((points, _COARSE), (rest, 1)):
            if points_now:
                self._compute(points_now, stride)
                self._next += points_now * stride

    def _compute(self, points: int, stride: int) -> Floats:
        """The pressures of so many points from the next grid point on, each `stride` further."""
        steps = self._next + stride * np.arange(points, dtype=np.float64)
        t_s: Floats = GRID_S * steps
        force_n = np.ascontiguousarray(self._load.forces_n(t_s))
        apparent_n = self._rubber.apparent_n(force_n, stride * GRID_S, self._scene)
        lost = self._stiffening * np.log1p(apparent_n / self._knee_n) * self._loading_gains(force_n)
        kpa = self._gas_kpa(t_s, 1.0 - lost, stride * GRID_S)
        around_kpa = self._surroundings.bare_kpa(t_s)
        kpa[:, self._bare] = np.broadcast_to(around_kpa, kpa.shape)[:, self._bare]
        self._last_force_n = force_n[-1]
        return kpa

    def _loading_gains(self, force_n: Floats) -> Floats:
        """A separate gain for every loading, drawn when the dome is touched."""
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

    def _gas_kpa(self, t_s: Floats, volume: Floats, step_s: float) -> Floats:
        """Pressure of the sealed gas at a given relative volume of the unstretched bubble."""
        wall_k = np.stack(
            [
                self._surroundings.gas_wall_degc(t_s, part.chip_lag_s, part.gas_lag_s) + _KELVIN
                for part in self._parts
            ],
            axis=1,
        )
        head_kpa = np.broadcast_to(self._surroundings.head_kpa(t_s), wall_k.shape).copy()
        if not self._scene.gas:
            return np.asarray(static_kpa(wall_k, volume, head_kpa, self._gas.constants))
        gas = self._gas
        decay = np.exp(-step_s * gas.rates_per_s)
        gain = gas.weights * (1 - decay) / -np.log(decay)
        return np.asarray(
            gas_kpa(
                wall_k, volume, head_kpa, gas.constants, gain, decay, gas.modes_k, gas.last_ln_p
            )
        )


class _Rubber:
    """What the rubber makes of a force: creep, loop, and a branch that flows; with their state."""

    def __init__(self, parts: Sequence[DomePart]) -> None:
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
        self._flow = FlowParts.of(parts, _FLOW_N_PER_S)

    def apparent_n(self, force_n: Floats, step_s: float, scene: EmulationScene) -> Floats:
        """The force that squeezes the bubble, (times, domes)."""
        if scene.rubber:
            decay = np.exp(-step_s / self._creep_s)
            mean = (1 - decay) * self._creep_s / step_s
            last_n, self._last_force_n = self._last_force_n, force_n[-1].copy()
            force_n = crept_n(force_n, last_n, self._creep_parts, decay, mean, self._crept_n)
        if scene.hysteresis:
            force_n = played_n(force_n, _PLAY_WIDTHS_N, self._play_weights, self._play_n)
            flow = self._flow
            if flow.is_there:
                force_n = flowed_n(force_n, flow.constants, step_s, flow.last_n, flow.branch_n)
        return force_n
