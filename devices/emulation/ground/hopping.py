"""Three hops of a leg on poppy seeds or in mud, as forces on domes over time.

The motion is integrated once and interpolated: the truth does not depend on the times of queries.
Every hop lands on a fresh place, a little firmer or softer than the scene's value; the leg hops a
little higher or lower, and is caught at the top of the last hop. The seed draws these variations.

The sole consists of strips, one under each position of tiles, with equal areas per tile. The tile's
dome bears the stated share of its area's load, along its axis; the rim of the sole bears the rest.
"""

from __future__ import annotations

import math
from bisect import bisect_right

import numpy as np

from devices.arrays import Bools, Floats
from devices.emulation.ground.ground import Ground, map_to_first_round
from devices.emulation.ground.hopping_leg import STEP_S, LegProperties, LegSimulation, Strip
from devices.emulation.ground.soft_ground import SoftGround
from devices.emulation.parts import make_rng
from devices.errors import SceneError
from devices.scene.emulation_sections import MudGround, PoppyGround

HOPS = 3

_AIR_S = 2.0
"""Time in the air after the last hop, and before the first again: long enough for a tare."""
_STANCE_S = 0.25
"""Approximate duration of landing and push-off; the segment turns during these and the stand."""
_SWING_S = 0.12  # time in which the segment turns back for the next touch-down
_FIRMNESS = 0.05  # relative variation of the ground's strength between places
_HEIGHT = 0.03  # relative variation of the hops' height
_PITCH = 0.1  # relative variation of the pitch
_STEEPEST_RAD = 0.7  # largest arc angle of a dome that still presses on the ground


class Hopping(Ground):
    """Three hops of a leg on soft ground.

    Args:
        ground: section of the scene.
        positions_m: (tiles, 3), positions in the foot frame.
        bears: (tiles,), False for bare reference tiles, which are in no strip.
        seed: seed of the variation between hops.
        lead_s: time of the drop.
        is_repeated: repeat endlessly.

    Raises:
        SceneError: the tiles are not on an arc below the ankle, or the leg gets stuck.
    """

    arc_rad: Floats

    def __init__(
        self,
        ground: PoppyGround | MudGround,
        positions_m: Floats,
        bears: Bools,
        seed: int,
        lead_s: float,
        *,
        is_repeated: bool = False,
    ) -> None:
        self._positions_m = positions_m
        self._lead_s = lead_s
        self.arc_rad = np.arctan2(positions_m[:, 0], -positions_m[:, 2])
        if np.abs(self.arc_rad[bears]).max() > _STEEPEST_RAD:
            raise SceneError(
                f"a foot that hops on {ground.kind} has its tiles on an arc below the ankle",
                expected="z_m negative, and x_m no larger than it",
            )
        places_m, strips_of = np.unique(positions_m[bears][:, [0, 2]], axis=0, return_inverse=True)
        tile_m2 = ground.sole_m2 / bears.sum()
        tiles_of = np.bincount(strips_of.ravel())
        self._strip_of = np.zeros(len(bears), dtype=np.intp)
        self._strip_of[bears] = strips_of.ravel()
        self._dome_m2 = np.where(bears, ground.dome_share * tile_m2, 0.0)
        self._rim_m2 = np.where(bears, (1.0 - ground.dome_share) * tile_m2, 0.0)
        strips = tuple(
            Strip(float(x_m), float(z_m), float(tile_m2 * n))
            for (x_m, z_m), n in zip(places_m, tiles_of, strict=True)
        )
        leg = LegProperties(ground.mass_kg, ground.leg_n_per_m, strips)
        self._head_kpa_m = ground.head_kpa_per_m if isinstance(ground, MudGround) else 0.0
        # Turns of the segment: begin; duration, first and last angle.
        self._begins_s: list[float] = [0.0]
        self._turns: list[tuple[float, float, float]] = []
        self.touch_down_s: list[float] = []
        """Touch-down time of each hop."""
        self.lift_off_s: list[float] = []
        """Lift-off time of each hop."""
        self.push_off_strokes_m: list[float] = []
        """Stroke of each push-off."""
        self._simulate_hops(ground, leg, make_rng(f"hop/{seed}"))
        self._round_s = self._end_s - lead_s if is_repeated else math.inf

    def _simulate_hops(
        self, ground: PoppyGround | MudGround, leg: LegProperties, rng: np.random.Generator
    ) -> None:
        firmness = 1.0 + _FIRMNESS * rng.uniform(-1.0, 1.0, HOPS)
        heights_m = ground.drop_m * _HEIGHT * rng.uniform(-1.0, 1.0, HOPS)
        pitches_rad = ground.pitch_rad * (1.0 + _PITCH * rng.uniform(-1.0, 1.0, HOPS))
        self._turns.append((1.0, -pitches_rad[0], -pitches_rad[0]))
        hopping = LegSimulation(leg, ground.drop_m, self._lead_s)
        for hop in range(HOPS):
            place = SoftGround.from_scene(ground, float(firmness[hop]))
            hopping.simulate_fall(place, self._angle)
            # The force has acted for a step, and rises from zero during the previous one.
            self.touch_down_s.append(hopping.motion.t_s - 2.0 * STEP_S)
            self._add_turn(hopping.motion.t_s, ground.stand_s + _STANCE_S, pitches_rad[hop])
            hopping.simulate_stance(place, self._angle, hopping.motion.t_s + ground.stand_s)
            height_m = hopping.drop_centre_m + heights_m[hop]
            self.push_off_strokes_m.append(hopping.simulate_push_off(place, self._angle, height_m))
            self.lift_off_s.append(hopping.motion.t_s)
            # After the last hop it turns as before the first, in case it is dropped again.
            self._add_turn(hopping.motion.t_s, _SWING_S, -pitches_rad[(hop + 1) % HOPS])
            hopping.simulate_flight_up(place, self._angle)
        self._end_s = hopping.motion.t_s + _AIR_S
        self.recorded_steps = hopping.recorded_steps
        self._time_s = np.array([step.t_s for step in self.recorded_steps])
        self._ankle_m = np.array([step.ankle_m for step in self.recorded_steps])
        self._stress_pa = np.array([step.stress_pa for step in self.recorded_steps])
        self._rest_n = np.array([step.force_beside_strips_n for step in self.recorded_steps])

    def _add_turn(self, begin_s: float, duration_s: float, to_rad: float) -> None:
        from_rad = self._angle(begin_s)
        self._begins_s.append(begin_s)
        self._turns.append((duration_s, from_rad, float(to_rad)))

    def _angle(self, t_s: float) -> float:
        turn = bisect_right(self._begins_s, t_s) - 1
        duration_s, from_rad, to_rad = self._turns[turn]
        done = min((t_s - self._begins_s[turn]) / duration_s, 1.0)
        return from_rad + (to_rad - from_rad) * done * done * (3.0 - 2.0 * done)

    @property
    def duration_s(self) -> float | None:
        """End of the time in the air after the last hop; None if looped."""
        return None if math.isfinite(self._round_s) else self._end_s

    def forces_n(self, t_s: Floats) -> Floats:
        """Compute the force on each dome along its axis, (len(t_s), tiles)."""
        return self._interpolate_stress_pa(self._map_to_first_round(t_s)) * self._dome_m2

    def angle_rad(self, t_s: Floats) -> Floats:
        """Compute the angle of the segment."""
        at_s = self._map_to_first_round(t_s)
        turn = np.maximum(np.searchsorted(self._begins_s, at_s, side="right") - 1, 0)
        duration_s, from_rad, to_rad = np.array(self._turns)[turn].T
        done = np.minimum((at_s - np.array(self._begins_s)[turn]) / duration_s, 1.0)
        return np.asarray(from_rad + (to_rad - from_rad) * done * done * (3.0 - 2.0 * done))

    def force_beside_domes_n(self, t_s: Floats) -> Floats:
        """Compute the vertical force on the foot beside the domes: rim, drag, suction, buoyancy."""
        at_s = self._map_to_first_round(t_s)
        upright = np.cos(self.arc_rad - self.angle_rad(t_s)[:, None])
        rim_n = (self._interpolate_stress_pa(at_s) * self._rim_m2 * upright).sum(axis=1)
        return np.asarray(rim_n + np.interp(at_s, self._time_s, self._rest_n, left=0.0, right=0.0))

    def compute_depth_m(self, t_s: Floats) -> Floats:
        """Compute the depth of each tile below the surface, (len(t_s), tiles); negative above."""
        ankle_m = np.interp(self._map_to_first_round(t_s), self._time_s, self._ankle_m)[:, None]
        angle_rad = self.angle_rad(t_s)[:, None]
        x_m, z_m = self._positions_m[:, 0], self._positions_m[:, 2]
        return np.asarray(np.sin(angle_rad) * x_m - np.cos(angle_rad) * z_m - ankle_m)

    def compute_head_kpa(self, t_s: Floats) -> Floats:
        """Compute the hydrostatic pressure on each tile, (len(t_s), tiles)."""
        return self._head_kpa_m * np.maximum(self.compute_depth_m(t_s), 0.0)

    def _interpolate_stress_pa(self, at_s: Floats) -> Floats:
        """Interpolate the stress under each tile."""
        pa = [
            np.interp(at_s, self._time_s, strip, left=0.0, right=0.0) for strip in self._stress_pa.T
        ]
        return np.stack(pa, axis=1)[:, self._strip_of]

    def _map_to_first_round(self, t_s: Floats) -> Floats:
        return map_to_first_round(t_s, self._lead_s, self._round_s)
