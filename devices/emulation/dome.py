"""The dome: contact force in, gas pressure on the chip out.

Order of the chain (hardware.md 9): contact force -> creep of the rubber -> hysteresis -> volume of
the bubble -> gas temperature -> absolute pressure. The gas is heat conduction in a sphere with an
isothermal wall, eight modes; the rubber Prony terms, as many as the part has, and four play
operators, and where the part has it a branch that flows (Bergstrom and Boyce 1998: filled rubbers
lose energy in chains that creep past one another, at a rate that is a high power of their stress,
so that the loop grows slowly with speed; there about the fourth). None of these equations is the
estimator's but that one, whose part, power and width are each dome's own; and no number is.

Everything is computed ahead of the bus in blocks of time on a fine grid, for all domes at once, and
interpolated where a chip samples: the physics does not know who asks, or when.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import partial
from typing import Protocol

import numpy as np
from scipy.signal import lfilter

from devices.arrays import Floats
from devices.emulation.parts import DomePart, random_of
from devices.emulation.surroundings import Surroundings
from devices.scene.emulated import EmulationScene

GRID_S = 0.0005
"""Between grid points pressure is taken as linear: in a tap of 20 ms that is off by 0.01 kPa."""
_BLOCK = 2000  # a second of the grid, computed at once
_MOMENT = 40  # grid points, 20 ms: longer than a transfer and the wait for its sample
_LATE_BLOCKS = 3  # so far behind it is quicker to go on coarsely
_COARSE = 40  # grid points, 20 ms
_AHEAD_BLOCKS = 30  # for a driver that asks nothing for so long; bounds memory, 30 MB for 64 domes

_KELVIN = 273.15
_MODES = np.arange(1, 9)
_MODE_WEIGHTS = 6.0 / (np.pi * _MODES) ** 2  # of the mean temperature of a heated sphere
_PLAY_WIDTHS_N = np.array([0.5, 1.0, 2.0, 4.0])
_FLOW_N_PER_S = 7.5  # where the loop is as wide as the part says: 30 N within 4 s
_UNLOADED_N = 0.05  # a dome that bears less is not touched: the next touch is a new loading
_MANY_LAGS = 128
_PICARD_LIMIT = 40  # a bound; the iteration contracts by kappa
_PICARD_TOLERANCE_K = 1e-6  # 3e-7 kPa


class Load(Protocol):
    """What presses on the domes."""

    def forces_n(self, t_s: Floats) -> Floats:
        """Force on each dome along its axis, shape (len(t_s), domes), never negative."""


class Domes:
    """All domes of a foot under one load, integrated forward in blocks.

    A place may be `bare`: its chip has no dome, and senses what is around it.
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
    ) -> None:
        self._again = partial(Domes, parts, serials, load, label=label, bare=bare)
        self._bare = np.flatnonzero(bare)
        self._parts = parts
        self._load = load
        self._scene = scene
        self._surroundings = surroundings
        n = len(parts)
        self._seal_kpa = np.array([part.seal_kpa for part in parts])
        self._wall = np.array([part.wall_per_kpa for part in parts])
        self._knee_n = np.array([part.knee_n for part in parts])
        self._stiffening = np.array([part.stiffening for part in parts])
        self._seal_k = scene.ambient_degc + _KELVIN
        drifted = [
            random_of(f"gain drift/{label}/{serial}").uniform(-1.0, 1.0) for serial in serials
        ]
        self._stiffening *= 1.0 + scene.gain_drift * np.array(drifted)
        self._loading_rngs = [random_of(f"loading/{label}/{serial}") for serial in serials]

        self._kappa = np.array([part.kappa for part in parts])
        self._creep = [np.zeros(len(part.creep_s)) for part in parts]
        self._play_n = np.zeros((n, len(_PLAY_WIDTHS_N)))
        viscous_n = np.array([part.viscous_n for part in parts])
        self._flowing = np.flatnonzero(viscous_n > 0.0)
        self._viscous_n = viscous_n[self._flowing]
        self._flow_part = np.array([part.flow_part for part in parts])[self._flowing]
        self._flow_power = np.array([part.flow_power for part in parts])[self._flowing]
        self._branch_n = np.zeros(len(self._flowing))
        self._last_flow_n = np.zeros(len(self._flowing))
        self._loading_gain = np.ones(n)
        self._last_force_n = np.zeros(n)
        self._mode_k = np.zeros((n, len(_MODES)))
        self._last_ln_p = np.log(self._seal_kpa)

        self._next = 0  # grid index of the first point that is not computed
        self._asked = 0  # the highest grid index that was asked for
        # By number. What may still be asked for stays, however far another thread is ahead: how
        # late a driver is decides when it asks, not what the dome was like then.
        self._blocks: dict[int, Floats] = {}
        self._extending = threading.Lock()
        self._step_s = GRID_S
        self._extend(0)

    def again(self, scene: EmulationScene, surroundings: Surroundings) -> Domes:
        """The same domes under the same load from its first instant on, with other effects."""
        return self._again(scene, surroundings)

    def pressure_kpa(self, dome: int, t_s: float) -> float:
        """Absolute gas pressure of one dome, or around a bare chip.

        Times may go back, but not by more than a block from the latest that was asked for.

        Raises:
            ValueError: `t_s` lies before what is still kept.
        """
        position = t_s / GRID_S
        index = int(position)
        self._asked = max(self._asked, index)
        if index + 1 >= self._next:
            self._extend(index + 1)
        try:
            low, high = self._at(index, dome), self._at(index + 1, dome)
        except KeyError:
            raise ValueError(f"dome pressure at {t_s} s was asked for too late") from None
        return low + (position - index) * (high - low)

    def be_ready(self, t_s: float) -> bool:
        """Compute the pressures until a moment after `t_s`; samples from there on are next.

        Returns:
            Whether anything was lacking: then time has passed meanwhile.
        """
        self._asked = max(self._asked, int(t_s / GRID_S))
        needed = self._asked + _MOMENT
        # Before the lock is asked for, which another thread holds while it computes a block ahead.
        if needed < self._next:
            return False
        self._leap(self._asked // _BLOCK - 1)
        self._extend(needed)
        return True

    def foresee(self, t_s: float) -> bool:
        """Compute a block ahead, so that no sample up to `t_s` has to wait for it.

        Returns:
            Whether that is done; else call it again, with a pause for those who wait.
        """
        index = min(int(t_s / GRID_S) + 1, self._asked + _AHEAD_BLOCKS * _BLOCK)
        if index >= self._next:
            self._extend(self._next)
        return index < self._next

    def _at(self, index: int, dome: int) -> float:
        return float(self._blocks[index // _BLOCK][index % _BLOCK, dome])

    def _extend(self, index: int) -> None:
        """Compute blocks until grid point `index` is there."""
        with self._extending:
            while index >= self._next:
                self._compute_block()

    def _leap(self, to_block: int) -> None:
        """Go on to a block in coarse steps, if nobody can ask any more for much of what is between.

        Else a machine that needs more than a second for the physics of a second would fall behind
        ever further. The last block before a sample is computed finely: it has settled then.
        """
        with self._extending:
            while to_block * _BLOCK - self._next > _LATE_BLOCKS * _BLOCK:
                blocks = min(to_block - self._next // _BLOCK, _COARSE)
                self._compute(blocks * _BLOCK // _COARSE, _COARSE)
                self._next += blocks * _BLOCK

    def _compute_block(self) -> None:
        """Compute one more block; keep it, and those from a block before what was asked last."""
        self._blocks[self._next // _BLOCK] = self._compute(_BLOCK, 1)
        self._next += _BLOCK
        oldest = min(self._asked, self._next) // _BLOCK - 1
        for number in [number for number in self._blocks if number < oldest]:
            del self._blocks[number]

    def _compute(self, points: int, stride: int) -> Floats:
        """The pressures of so many points from the next grid point on, each `stride` further."""
        steps = self._next + stride * np.arange(points, dtype=np.float64)
        self._step_s = stride * GRID_S
        t_s: Floats = GRID_S * steps
        force_n = self._load.forces_n(t_s)
        apparent_n = self._viscous(self._hysteresis(self._creeping(force_n)))
        lost = self._stiffening * np.log1p(apparent_n / self._knee_n) * self._loading_gains(force_n)
        kpa = self._gas(t_s, 1.0 - lost)
        around_kpa = self._surroundings.bare_kpa(t_s)
        kpa[:, self._bare] = np.broadcast_to(around_kpa, kpa.shape)[:, self._bare]
        self._last_force_n = force_n[-1]
        return kpa

    def _creeping(self, force_n: Floats) -> Floats:
        """Creep: part of the force appears only after each term's time, statically all of it."""
        if not self._scene.rubber:
            return force_n
        apparent = force_n.copy()
        for dome, part in enumerate(self._parts):
            f = np.concatenate([[self._last_force_n[dome]], force_n[:, dome]])
            for term, (share, tau_s) in enumerate(zip(part.creep_parts, part.creep_s, strict=True)):
                decay = np.exp(-self._step_s / tau_s)
                mean = (1 - decay) * tau_s / self._step_s
                # Exact for a force that is linear between grid points.
                drive = (mean - decay) * f[:-1] + (1 - mean) * f[1:]
                slow, _ = lfilter([1], [1, -decay], drive, zi=[decay * self._creep[dome][term]])
                self._creep[dome][term] = slow[-1]
                apparent[:, dome] += share * (slow - f[1:])
        return np.maximum(apparent, 0.0)

    def _hysteresis(self, force_n: Floats) -> Floats:
        """Generalised play: each operator lags between two branches that meet at zero load."""
        if not self._scene.hysteresis:
            return force_n
        f = force_n[:, :, None]
        half_n = _PLAY_WIDTHS_N * -np.expm1(-f / (3 * _PLAY_WIDTHS_N))
        low, high = f - half_n, f + half_n
        played = np.empty_like(low)
        y = self._play_n
        for k in range(len(f)):
            y = np.minimum(np.maximum(y, low[k]), high[k])
            played[k] = y
        self._play_n = y
        loop_n = np.array([part.loop_n for part in self._parts])
        weight = loop_n / _PLAY_WIDTHS_N.sum()
        return np.asarray(force_n + weight * (played - f).sum(axis=2))

    def _viscous(self, force_n: Floats) -> Floats:
        """A branch beside the spring bears part of a change, and flows: the bubble gets the rest.

        Branch stress s: ds/dt = part dF/dt - rate |s|^power sign(s). The flow by itself has a
        closed form, which stands between two halves of the step in force; where F changes at
        `_FLOW_N_PER_S` it ends at s = `viscous_n`.
        """
        if not self._scene.hysteresis or not len(self._flowing):
            return force_n
        f = force_n[:, self._flowing]
        half_n = 0.5 * self._flow_part * np.diff(f, axis=0, prepend=self._last_flow_n[None])
        self._last_flow_n = f[-1]
        apparent_n = force_n.copy()
        for i, dome in enumerate(self._flowing.tolist()):
            part, power = float(self._flow_part[i]), float(self._flow_power[i])
            more = power - 1.0
            per_s = more * part * _FLOW_N_PER_S / float(self._viscous_n[i]) ** power
            flow, root = per_s * self._step_s, -1.0 / more
            s, borne_n = float(self._branch_n[i]), []
            for half in half_n[:, i].tolist():  # a call of numpy for each step would be dear
                s += half
                s = s * (1.0 + flow * abs(s) ** more) ** root + half
                borne_n.append(s)
            self._branch_n[i] = s
            apparent_n[:, dome] = np.maximum(f[:, i] - borne_n, 0.0)
        return apparent_n

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

    def _gas(self, t_s: Floats, volume: Floats) -> Floats:
        """Pressure of the sealed gas at a given relative volume of the unstretched bubble.

        Mean gas temperature T = wall + sum of modes; mode n is driven by kappa T d(ln p) times its
        weight and decays with conduction_s / n^2. The wall yields to the pressure difference over
        it. Pressure and temperature depend on each other: Picard iteration over the block, which
        contracts by less than kappa.
        """
        wall_k = np.stack(
            [
                self._surroundings.gas_wall_degc(t_s, part.chip_lag_s, part.gas_lag_s) + _KELVIN
                for part in self._parts
            ],
            axis=1,
        )
        head_kpa = self._surroundings.head_kpa(t_s)
        excess_k = np.zeros_like(wall_k)
        kpa = self._pressure(wall_k, volume, head_kpa)
        if not self._scene.gas:
            return kpa
        decay = np.exp(
            -self._step_s
            * _MODES**2
            / np.array([part.conduction_s for part in self._parts])[:, None]
        )
        gain = _MODE_WEIGHTS * (1 - decay) / -np.log(decay)
        for _ in range(_PICARD_LIMIT):
            ln_p = np.concatenate([self._last_ln_p[None], np.log(kpa)])
            drive = self._kappa * (wall_k + excess_k) * np.diff(ln_p, axis=0)
            modes_k = decaying(drive, gain, decay, self._mode_k)
            new_k = modes_k.sum(axis=2)
            change_k = np.abs(new_k - excess_k).max()
            excess_k = new_k
            kpa = self._pressure(wall_k + excess_k, volume, head_kpa)
            if change_k < _PICARD_TOLERANCE_K:
                break
        self._mode_k = modes_k[-1]
        self._last_ln_p = np.log(kpa[-1])
        return kpa

    def _pressure(self, gas_k: Floats, volume: Floats, head_kpa: Floats) -> Floats:
        """Solve p volume (1 + c (p - seal - head)) = seal T / T_seal for p."""
        c = self._wall
        linear = 1.0 - c * (self._seal_kpa + head_kpa)
        right = self._seal_kpa * gas_k / (self._seal_k * volume)
        return np.asarray(2 * right / (linear + np.sqrt(linear**2 + 4 * c * right)))


def decaying(drive: Floats, gain: Floats, decay: Floats, before: Floats) -> Floats:
    """First-order lags y[k] = decay y[k - 1] + gain drive[k], several of each column's drive.

    Few are filtered one by one along time, many step by step all at once: whichever is quicker, to
    the same bits.

    Args:
        drive: (times, columns).
        gain: (columns, lags).
        decay: (columns, lags).
        before: (columns, lags), y before the first time.

    Returns:
        (times, columns, lags).
    """
    lagged = drive[:, :, None] * gain
    if gain.size < _MANY_LAGS:
        for column in range(gain.shape[0]):
            for lag in range(gain.shape[1]):
                keep = float(decay[column, lag])
                lagged[:, column, lag], _ = lfilter(
                    [1], [1, -keep], lagged[:, column, lag], zi=[keep * before[column, lag]]
                )
        return lagged
    y = before.copy()
    for driven in lagged:
        np.multiply(y, decay, out=y)
        y += driven
        driven[:] = y
    return lagged
