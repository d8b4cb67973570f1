"""Indenter: a spindle presses one tile after another against a reference force sensor.

`IndentationProgramme` is its programme, a ground like any other; `Indenter` is the reference
sensor, with the operator's notes.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Ints, Times
from devices.clock import Clock
from devices.emulation.chips.mcp3208 import EmulatedMcp3208, make_amplifier
from devices.emulation.ground.ground import Ground
from devices.scene.emulation_sections import IndentationGround
from devices.scene.hardware_sections import ReferenceSection, TileSection

_AMPLIFIER_NOISE_N = 0.02


class IndentationProgramme(Ground):
    """Programme of the indenter: slow strokes, holds with quick release, taps, and a thermal soak.

    The spindle presses one tile after another; `PHASES` names the actions. The soak is at two
    temperatures.
    """

    _HOLDS = 5
    _TAPS = 15
    _SOAK_S = 15.0
    PHASES = ("rest", "load", "unload", "hold", "release", "tap", "soak")

    def __init__(
        self, ground: IndentationGround, tiles: tuple[TileSection, ...], lead_s: float
    ) -> None:
        self.serials = tuple(tile.serial for tile in tiles)
        self.soak_k = ground.soak_k
        self._time_s: list[float] = [0.0]
        self._force_n: list[float] = [0.0]
        self._tile: list[int] = []
        self._phase: list[int] = []
        self._add_move(lead_s, 0.0, -1, "rest")
        for index, tile in enumerate(tiles):
            if not tile.reference:
                self._add_tile(ground, index)
        self._add_move(self._SOAK_S, 0.0, -1, "soak")
        self.temperature_step_s = self._time_s[-1]
        self._add_move(self._SOAK_S + 10.0, 0.0, -1, "soak")  # the gas follows within seconds
        self._ends = np.array(self._time_s[1:])
        self._tiles_of = np.array(self._tile)
        self._phases_of = np.array(self._phase)

    @property
    def duration_s(self) -> float:
        """End of the soak."""
        return self._time_s[-1]

    def _add_tile(self, ground: IndentationGround, tile: int) -> None:
        full_n = ground.load_n
        for _ in range(ground.repeats):
            self._add_move(0.3, 0.0, tile, "rest")
            self._add_move(ground.stroke_s, full_n, tile, "load")
            self._add_move(ground.stroke_s, 0.0, tile, "unload")
        for _ in range(self._HOLDS):
            self._add_move(0.4, 0.0, tile, "rest")
            self._add_move(0.4, 0.7 * full_n, tile, "load")
            self._add_move(0.5, 0.7 * full_n, tile, "hold")
            self._add_move(0.005, 0.0, tile, "release")
        self._add_move(0.4, 0.0, tile, "rest")
        for _ in range(self._TAPS):
            for quarter in (0.5, 1.0, 0.5, 0.0):
                self._add_move(0.005, quarter * 0.5 * full_n, tile, "tap")
            self._add_move(0.1, 0.0, tile, "rest")

    def _add_move(self, duration_s: float, force_n: float, tile: int, phase: str) -> None:
        """Move the spindle to a force, linearly."""
        self._time_s.append(self._time_s[-1] + duration_s)
        self._force_n.append(force_n)
        self._tile.append(tile)
        self._phase.append(self.PHASES.index(phase))

    def _find_segment(self, t_s: Floats) -> npt.NDArray[np.intp]:
        return np.minimum(np.searchsorted(self._ends, t_s, side="right"), len(self._ends) - 1)

    def forces_n(self, t_s: Floats) -> Floats:
        """Compute the spindle's force on the tile under it, zero on all others."""
        forces_n = np.zeros((len(t_s), len(self.serials)))
        tile = self.find_indented_tile(t_s)
        rows = np.flatnonzero(tile >= 0)
        forces_n[rows, tile[rows]] = np.interp(t_s, self._time_s, self._force_n, right=0.0)[rows]
        return forces_n

    def compute_spindle_force_n(self, t_s: float) -> float | None:
        """Compute the force of the spindle; None between tiles."""
        segment = bisect_right(self._time_s, t_s) - 1
        if segment >= len(self._tile) or self._tile[segment] < 0:
            return None
        begin_s, end_s = self._time_s[segment : segment + 2]
        begin_n, end_n = self._force_n[segment : segment + 2]
        return begin_n + (t_s - begin_s) / (end_s - begin_s) * (end_n - begin_n)

    def find_indented_tile(self, t_s: Floats) -> npt.NDArray[np.intp]:
        """Return the index of the tile under the spindle; -1 for none."""
        return np.asarray(self._tiles_of[self._find_segment(t_s)])

    def find_phase_index(self, t_s: Floats) -> npt.NDArray[np.intp]:
        """Return the index into `PHASES`."""
        return np.asarray(self._phases_of[self._find_segment(t_s)])


class Indenter:
    """Reference force sensor of the indenter, with its noise, and the operator's notes.

    Args:
        programme: programme of the indenter.
        to_scene_s: converts instants of the clock in ns to seconds of the scene.
        rng: random generator of the amplifier's noise.
    """

    def __init__(
        self,
        programme: IndentationProgramme,
        to_scene_s: Callable[[Ints], Floats],
        rng: np.random.Generator,
    ) -> None:
        self._programme = programme
        self._to_scene_s = to_scene_s
        self._rng = rng

    def make_adc(self, reference: ReferenceSection, clock: Clock) -> EmulatedMcp3208:
        """Create a converter with the sensor's amplifier at the input that `reference` names.

        Between tiles the sensor is unloaded, and reads about zero.
        """
        volts = make_amplifier(self._compute_sensor_force_n, reference, noise_n=self._draw_noise_n)
        return EmulatedMcp3208(volts, clock, vref_v=reference.vref_v)

    def _compute_sensor_force_n(self, t_mono_ns: int) -> float:
        return (
            self._programme.compute_spindle_force_n(
                float(self._to_scene_s(np.array([t_mono_ns]))[0])
            )
            or 0.0
        )

    def _draw_noise_n(self) -> float:
        return _AMPLIFIER_NOISE_N * float(self._rng.standard_normal())

    def get_operator_notes(self, t_mono_ns: Times) -> dict[str, npt.NDArray[np.object_]]:
        """Return the operator's notes at each instant.

        Returns:
            `pressed_tile`, serial of the tile under the spindle or None, and `phase`.
        """
        t_s = self._to_scene_s(t_mono_ns)
        serials = np.array([*self._programme.serials, None], dtype=object)
        phases = np.array(self._programme.PHASES, dtype=object)
        return {
            "pressed_tile": serials[self._programme.find_indented_tile(t_s)],
            "phase": phases[self._programme.find_phase_index(t_s)],
        }
