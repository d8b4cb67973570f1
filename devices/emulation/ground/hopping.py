"""Three hops of a leg on poppy seeds or in mud, as forces on domes over time.

The motion is integrated once and interpolated: the truth does not depend on the times of queries.
Every hop lands on a fresh place, a little firmer or softer than the scene's value; the leg hops a
little higher or lower, and is caught at the top of the last hop. The seed draws these variations.

The sole consists of strips, one under each position of tiles, with equal areas per tile. The tile's
dome bears the stated share of its area's load, along its axis; the rim of the sole bears the rest.

Vertical motion of two masses, above and below the leg's spring, with fixed small steps; the
segment's angle is a given function of time. The push-off lengthens the leg by a stroke that root
finding adjusts to the height of the hop.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from devices.arrays import Bools, Floats
from devices.emulation.ground.ground import GRAVITY_M_S2, Ground, SoftGround, map_to_first_round
from devices.emulation.parts import make_rng
from devices.errors import SceneError
from devices.scene.emulation_sections import MudGround, PoppyGround

STEP_S = 0.00025
"""Time step. The shortest period, of a foot of 0.12 kg in poppy seeds on unloading, is 14 ms. The
bounds of the scene's keys keep the integration stable."""

LEG_M = 0.30
_FOOT_SHARE = 0.13
"""Part of the mass that is below the spring (assumed)."""
_STANDING_DAMPING, _PUSHING_DAMPING = 0.4, 0.1
"""Damping of the leg's spring, relative to critical (assumed: geared servos hold or drive it)."""
_STOP = 40.0
"""Ratio of the stiffness of the leg's end stop, critically damped, to that of the spring."""
_FOLDED = 0.95  # limit of the spring's compression, as a part of the leg's length
_PUSH_S = 0.10
_RETRACT_S = 0.12
_STROKE_MAX_M = 0.20
_LEFT_WITHIN_S = 0.6  # timeout of a push-off, after which the foot counts as stuck
_HEIGHT_TOLERANCE_M = 0.001  # tolerance of the hop's height
_TRIES = 12  # iterations of the regula falsi

AngleFunction = Callable[[float], float]


@dataclass(frozen=True)
class Strip:
    """Transverse strip of the sole.

    Attributes:
        x_m: position forward of the ankle.
        z_m: position up the segment from the ankle, so negative.
        area_m2: area of the strip; its normal points away from the ankle.
    """

    x_m: float
    z_m: float
    area_m2: float

    @property
    def radius_m(self) -> float:
        """Distance from the ankle."""
        return math.hypot(self.x_m, self.z_m)


@dataclass(frozen=True)
class LegProperties:
    """Properties of a leg.

    Attributes:
        mass_kg: total mass.
        stiffness_n_m: stiffness of the spring.
        strips: strips of the sole.
    """

    mass_kg: float
    stiffness_n_m: float
    strips: tuple[Strip, ...]

    @property
    def foot_kg(self) -> float:
        """Mass below the spring."""
        return _FOOT_SHARE * self.mass_kg

    @property
    def body_kg(self) -> float:
        """Mass above the spring."""
        return self.mass_kg - self.foot_kg

    @property
    def sole_distance_m(self) -> float:
        """Distance from the ankle to the lowest point of the upright sole."""
        return max(-strip.z_m for strip in self.strips)


@dataclass
class LegMotion:
    """State of a leg in motion.

    Attributes:
        t_s: time.
        ankle_m: height of the ankle above the ground's surface.
        body_m: height of the body.
        stroke_m: extension of the leg beyond its rest length.
        set_m: plastic set under each strip, see `SoftGround.compute_stress_pa`.
    """

    t_s: float
    ankle_m: float
    body_m: float
    ankle_m_s: float = 0.0
    body_m_s: float = 0.0
    stroke_m: float = 0.0
    set_m: list[float] = field(default_factory=list)

    def copy(self) -> LegMotion:
        """Return a deep copy, for trial motions."""
        return LegMotion(**(vars(self) | {"set_m": list(self.set_m)}))


class RecordedStep(NamedTuple):
    """Recorded state and forces of one time step.

    Attributes:
        t_s: time.
        ankle_m: height of the ankle.
        body_m: height of the body.
        ankle_m_s: speed of the ankle upwards.
        body_m_s: speed of the body upwards.
        stress_pa: stress on each strip.
        force_beside_strips_n: vertical force of the ground beside the strips.
    """

    t_s: float
    ankle_m: float
    body_m: float
    ankle_m_s: float
    body_m_s: float
    stress_pa: list[float]
    force_beside_strips_n: float


class LegSimulation:
    """Simulation of a hopping leg.

    Args:
        leg: properties of the leg.
        drop_m: drop height of the sole above the ground.
        t_s: time of the drop.
    """

    def __init__(self, leg: LegProperties, drop_m: float, t_s: float) -> None:
        self.leg = leg
        ankle_m = drop_m + leg.sole_distance_m
        self.motion = LegMotion(t_s, ankle_m, ankle_m + LEG_M, set_m=[0.0] * len(leg.strips))
        self.recorded_steps: list[RecordedStep] = []
        self._strips = [(p.x_m, p.z_m, p.area_m2, p.area_m2 / p.radius_m) for p in leg.strips]
        self._sole_m2 = sum(p.area_m2 for p in leg.strips)
        self._reach_m = max(p.radius_m for p in leg.strips)
        self._angle = (-1.0, 0.0)
        self._touches = False
        self._damping = _STANDING_DAMPING
        self.drop_centre_m = self.compute_centre_m(self.motion)
        """Height of the centre of mass at the drop."""

    def compute_centre_m(self, motion: LegMotion) -> float:
        """Compute the height of the centre of mass."""
        leg = self.leg
        return (leg.foot_kg * motion.ankle_m + leg.body_kg * motion.body_m) / leg.mass_kg

    def compute_rise_m_s(self, motion: LegMotion) -> float:
        """Compute the speed of the centre of mass, upwards."""
        leg = self.leg
        return (leg.foot_kg * motion.ankle_m_s + leg.body_kg * motion.body_m_s) / leg.mass_kg

    def simulate_fall(self, ground: SoftGround, angle: AngleFunction) -> None:
        """Simulate the fall until the sole touches fresh ground."""
        self.motion.set_m = [0.0] * len(self.leg.strips)
        self._touches = False
        while not self._touches:
            self._retract()
            self._step(self.motion, ground, angle, self.recorded_steps)

    def simulate_stance(self, ground: SoftGround, angle: AngleFunction, until_s: float) -> None:
        """Simulate landing and standing until `until_s`."""
        self._damping = _STANDING_DAMPING
        while self.motion.t_s < until_s:
            self._step(self.motion, ground, angle, self.recorded_steps)

    def simulate_push_off(self, ground: SoftGround, angle: AngleFunction, height_m: float) -> float:
        """Simulate a push-off whose stroke lets the centre of mass rise to `height_m`.

        Returns:
            The stroke.

        Raises:
            SceneError: no stroke is sufficient.
        """
        begin = self.motion
        self._damping = _PUSHING_DAMPING
        stuck_m = height_m - self.compute_centre_m(begin)

        def missing_m(stroke_m: float) -> float:
            self.motion = begin.copy()
            self._push(ground, angle, stroke_m, None)
            if self._touches:  # the leg is fully extended and still in the ground
                return stuck_m
            v = max(self.compute_rise_m_s(self.motion), 0.0)
            return height_m - self.compute_centre_m(self.motion) - v * v / (2 * GRAVITY_M_S2)

        low_m, high_m = 0.0, _STROKE_MAX_M
        low, high = stuck_m, missing_m(high_m)
        if high > 0.0:
            raise SceneError(
                f"the leg does not get out of this ground: with a stroke of {high_m:g} m it lacks "
                f"{high:.3f} m of the hop",
                expected="a firmer ground, less suction, a larger sole, or a stiffer leg",
            )
        stroke_m = high_m
        for _ in range(_TRIES):
            # Regula falsi, Illinois algorithm. In sticky ground the height jumps at some stroke, so
            # there may be no root; then use the smallest stroke that is high enough.
            stroke_m = (low_m * high - high_m * low) / (high - low)
            miss = missing_m(stroke_m)
            if abs(miss) < _HEIGHT_TOLERANCE_M:
                break
            if miss > 0.0:
                low_m, low, high = stroke_m, miss, 0.5 * high
            else:
                high_m, high, low = stroke_m, miss, 0.5 * low
        else:
            stroke_m = high_m
        self.motion = begin
        self._push(ground, angle, stroke_m, self.recorded_steps)
        return stroke_m

    def simulate_flight_up(self, ground: SoftGround, angle: AngleFunction) -> None:
        """Simulate the flight to its highest point."""
        while self.compute_rise_m_s(self.motion) > 0.0:
            self._retract()
            self._step(self.motion, ground, angle, self.recorded_steps)

    def _push(
        self,
        ground: SoftGround,
        angle: AngleFunction,
        stroke_m: float,
        record: list[RecordedStep] | None,
    ) -> None:
        motion = self.motion
        begin_s = motion.t_s
        while motion.t_s < begin_s + _LEFT_WITHIN_S:
            done = min((motion.t_s - begin_s) / _PUSH_S, 1.0)
            motion.stroke_m = stroke_m * 0.5 * (1.0 - math.cos(math.pi * done))
            self._step(motion, ground, angle, record)
            if not self._touches and done > 0.5:
                break

    def _retract(self) -> None:
        motion = self.motion
        motion.stroke_m = max(motion.stroke_m - _STROKE_MAX_M * STEP_S / _RETRACT_S, 0.0)

    def _step(
        self,
        motion: LegMotion,
        ground: SoftGround,
        angle: AngleFunction,
        record: list[RecordedStep] | None,
    ) -> None:
        """Integrate one step: forces, then speeds, then positions (semi-implicit Euler)."""
        known_s, angle_rad = self._angle
        if known_s != motion.t_s:
            angle_rad = angle(motion.t_s)
        ahead_rad = angle(motion.t_s + STEP_S)
        self._angle = (motion.t_s + STEP_S, ahead_rad)
        turn_rad = (ahead_rad - angle_rad) / STEP_S
        stress_pa, press_n, rest_n = self._compute_ground_forces(
            motion, ground, angle_rad, turn_rad
        )
        if record is not None:
            m = motion
            step = RecordedStep(
                m.t_s, m.ankle_m, m.body_m, m.ankle_m_s, m.body_m_s, stress_pa, rest_n
            )
            record.append(step)
        leg = self.leg
        leg_n = self._compute_leg_force_n(motion)
        motion.ankle_m_s += ((press_n + rest_n - leg_n) / leg.foot_kg - GRAVITY_M_S2) * STEP_S
        motion.body_m_s += (leg_n / leg.body_kg - GRAVITY_M_S2) * STEP_S
        motion.ankle_m += motion.ankle_m_s * STEP_S
        motion.body_m += motion.body_m_s * STEP_S
        motion.t_s += STEP_S

    def _compute_ground_forces(
        self, motion: LegMotion, ground: SoftGround, angle_rad: float, turn_rad: float
    ) -> tuple[list[float], float, float]:
        """Compute the stress on each strip, their vertical force, and the rest of the foot's."""
        if motion.ankle_m >= self._reach_m:
            self._touches = False
            return [0.0] * len(self._strips), 0.0, 0.0
        c, s = math.cos(angle_rad), math.sin(angle_rad)
        ankle_m, ankle_m_s, set_m = motion.ankle_m, motion.ankle_m_s, motion.set_m
        stress_pa = []
        press_n = mean_depth_m = 0.0
        gap_m, deepest_m = math.inf, 0.0
        for i, (x_m, z_m, area_m2, area_per_radius_m) in enumerate(self._strips):
            below_m = s * x_m - c * z_m
            depth_m = below_m - ankle_m
            sinking = turn_rad * (c * x_m + s * z_m) - ankle_m_s
            pa, set_m[i] = ground.compute_stress_pa(depth_m, sinking, set_m[i])
            stress_pa.append(pa)
            # The vertical component of the normal, cos(arc - angle), is below_m over the radius.
            press_n += pa * area_per_radius_m * below_m
            mean_depth_m += depth_m * area_m2
            gap_m = min(gap_m, set_m[i] - depth_m)
            deepest_m = max(deepest_m, depth_m)
        self._touches = deepest_m > 0.0
        rest_n = ground.compute_foot_force_n(
            mean_depth_m / self._sole_m2, -ankle_m_s, max(gap_m, 0.0), self._sole_m2
        )
        return stress_pa, press_n, rest_n

    def _compute_leg_force_n(self, motion: LegMotion) -> float:
        """Compute the leg's force: a damped spring, and in extension an end stop that pulls.

        Raises:
            SceneError: the spring is compressed beyond its limit.
        """
        leg = self.leg
        k = leg.stiffness_n_m
        pressed_m = LEG_M + motion.stroke_m - (motion.body_m - motion.ankle_m)
        pressing = motion.ankle_m_s - motion.body_m_s
        if pressed_m > _FOLDED * LEG_M:
            raise SceneError(
                "the leg folds up: its spring is too soft for its mass and its fall",
                expected="a greater ground.leg_n_per_m, less ground.mass_kg or ground.drop_m",
            )
        if pressed_m >= 0.0:
            return k * pressed_m + 2.0 * self._damping * math.sqrt(k * leg.body_kg) * pressing
        k *= _STOP
        return k * pressed_m + 2.0 * math.sqrt(k * leg.foot_kg) * pressing


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
