"""A leg that is dropped on soft ground and hops: masses, spring, push-off, and the ground's forces.

Vertical motion of two masses, what is above the leg's spring and what is below it, with fixed small
steps; the segment's angle is given as a function of time. The push-off lengthens the leg, and takes
what it needs to take: its stroke is found by trying, as who tunes a robot would.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from devices.emulation.ground.soft_ground import GRAVITY_M_S2, SoftGround
from devices.errors import SceneError

STEP_S = 0.00025
"""The stiffest thing, a foot of 0.12 kg in poppy seeds unloading, has a period of 14 ms. The bounds
of the scene's keys keep it stable."""

LEG_M = 0.30
_FOOT_SHARE = 0.13
"""Part of the mass that is below the spring (assumed)."""
_STANDING_DAMPING, _PUSHING_DAMPING = 0.4, 0.1
"""Damping of the leg's spring, relative to critical (assumed: geared servos hold or drive it)."""
_STOP = 40.0
"""How many times stiffer than the spring the leg's end stop is; it is damped critically."""
_FOLDED = 0.95  # of its length: a spring that is pressed further has no more travel
_PUSH_S = 0.10
_RETRACT_S = 0.12
_STROKE_MAX_M = 0.20
_LEFT_WITHIN_S = 0.6  # a push-off that takes longer is stuck
_HEIGHT_TOLERANCE_M = 0.001  # of the hop, good enough for a drawn height
_TRIES = 12  # of the regula falsi

Angle = Callable[[float], float]


@dataclass(frozen=True)
class Strip:
    """A strip of the sole, from side to side, at one place of its length.

    Attributes:
        x_m: forward of the ankle.
        z_m: up the segment, so negative.
        area_m2: of the strip; its normal points away from the ankle.
    """

    x_m: float
    z_m: float
    area_m2: float

    @property
    def radius_m(self) -> float:
        """Distance from the ankle."""
        return math.hypot(self.x_m, self.z_m)


@dataclass(frozen=True)
class Leg:
    """What hops.

    Attributes:
        mass_kg: of all of it.
        stiffness_n_m: of its spring.
        strips: of its sole.
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
        """Mass above it."""
        return self.mass_kg - self.foot_kg

    @property
    def sole_m(self) -> float:
        """From the ankle to the lowest of the sole, upright."""
        return max(-strip.z_m for strip in self.strips)


@dataclass
class Motion:
    """State of a leg in motion.

    Attributes:
        t_s: time.
        ankle_m: height of the ankle above the ground's surface.
        body_m: height of the body.
        stroke_m: by how much the leg is longer than at rest.
        set_m: of each strip, see `SoftGround.stress_pa`.
    """

    t_s: float
    ankle_m: float
    body_m: float
    ankle_m_s: float = 0.0
    body_m_s: float = 0.0
    stroke_m: float = 0.0
    set_m: list[float] = field(default_factory=list)

    def copy(self) -> Motion:
        """Another one, to try things with."""
        return Motion(**(vars(self) | {"set_m": list(self.set_m)}))


class Step(NamedTuple):
    """What happened in one step.

    Attributes:
        t_s: time.
        ankle_m: height of the ankle.
        body_m: height of the body.
        ankle_m_s: speed of the ankle upwards.
        body_m_s: speed of the body upwards.
        stress_pa: stress on each strip.
        rest_n: vertical force of the ground that presses no strip.
    """

    t_s: float
    ankle_m: float
    body_m: float
    ankle_m_s: float
    body_m_s: float
    stress_pa: list[float]
    rest_n: float


class HoppingLeg:
    """A leg on its way.

    Args:
        leg: what hops.
        drop_m: height of the sole above the ground when it is let go.
        t_s: when that is.
    """

    def __init__(self, leg: Leg, drop_m: float, t_s: float) -> None:
        self.leg = leg
        ankle_m = drop_m + leg.sole_m
        self.motion = Motion(t_s, ankle_m, ankle_m + LEG_M, set_m=[0.0] * len(leg.strips))
        self.recorded: list[Step] = []
        self._strips = [(p.x_m, p.z_m, p.area_m2, p.area_m2 / p.radius_m) for p in leg.strips]
        self._sole_m2 = sum(p.area_m2 for p in leg.strips)
        self._reach_m = max(p.radius_m for p in leg.strips)
        self._angle = (-1.0, 0.0)
        self._touches = False
        self._damping = _STANDING_DAMPING
        self.release_m = self.centre_m(self.motion)
        """Height of the centre of mass when it was let go."""

    def centre_m(self, motion: Motion) -> float:
        """Height of the centre of mass."""
        leg = self.leg
        return (leg.foot_kg * motion.ankle_m + leg.body_kg * motion.body_m) / leg.mass_kg

    def rising_m_s(self, motion: Motion) -> float:
        """Speed of the centre of mass, upwards."""
        leg = self.leg
        return (leg.foot_kg * motion.ankle_m_s + leg.body_kg * motion.body_m_s) / leg.mass_kg

    def fall(self, ground: SoftGround, angle: Angle) -> None:
        """Fall until the sole touches the ground, which is untouched here."""
        self.motion.set_m = [0.0] * len(self.leg.strips)
        self._touches = False
        while not self._touches:
            self._retract()
            self._step(self.motion, ground, angle, self.recorded)

    def stand(self, ground: SoftGround, angle: Angle, until_s: float) -> None:
        """Land and stand."""
        self._damping = _STANDING_DAMPING
        while self.motion.t_s < until_s:
            self._step(self.motion, ground, angle, self.recorded)

    def push_off(self, ground: SoftGround, angle: Angle, height_m: float) -> float:
        """Leave the ground so that the centre of mass rises to `height_m`.

        Returns:
            The stroke that this takes.

        Raises:
            SceneError: there is none.
        """
        begin = self.motion
        self._damping = _PUSHING_DAMPING
        stuck_m = height_m - self.centre_m(begin)

        def missing_m(stroke_m: float) -> float:
            self.motion = begin.copy()
            self._push(ground, angle, stroke_m, None)
            if self._touches:  # it stands stretched in the ground, which has not let go
                return stuck_m
            v = max(self.rising_m_s(self.motion), 0.0)
            return height_m - self.centre_m(self.motion) - v * v / (2 * GRAVITY_M_S2)

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
            # Regula falsi with Illinois' halving. Sticky ground lets go at some stroke or not at
            # all, so there may be none that fits; then it is the least that gets high enough.
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
        self._push(ground, angle, stroke_m, self.recorded)
        return stroke_m

    def rise(self, ground: SoftGround, angle: Angle) -> None:
        """Fly until the highest point."""
        while self.rising_m_s(self.motion) > 0.0:
            self._retract()
            self._step(self.motion, ground, angle, self.recorded)

    def _push(
        self, ground: SoftGround, angle: Angle, stroke_m: float, record: list[Step] | None
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
        self, motion: Motion, ground: SoftGround, angle: Angle, record: list[Step] | None
    ) -> None:
        """One step: forces of the present, then speeds, then places (semi-implicit Euler)."""
        known_s, angle_rad = self._angle
        if known_s != motion.t_s:
            angle_rad = angle(motion.t_s)
        ahead_rad = angle(motion.t_s + STEP_S)
        self._angle = (motion.t_s + STEP_S, ahead_rad)
        turn_rad = (ahead_rad - angle_rad) / STEP_S
        stress_pa, press_n, rest_n = self._ground_n(motion, ground, angle_rad, turn_rad)
        if record is not None:
            m = motion
            step = Step(m.t_s, m.ankle_m, m.body_m, m.ankle_m_s, m.body_m_s, stress_pa, rest_n)
            record.append(step)
        leg = self.leg
        leg_n = self._leg_n(motion)
        motion.ankle_m_s += ((press_n + rest_n - leg_n) / leg.foot_kg - GRAVITY_M_S2) * STEP_S
        motion.body_m_s += (leg_n / leg.body_kg - GRAVITY_M_S2) * STEP_S
        motion.ankle_m += motion.ankle_m_s * STEP_S
        motion.body_m += motion.body_m_s * STEP_S
        motion.t_s += STEP_S

    def _ground_n(
        self, motion: Motion, ground: SoftGround, angle_rad: float, turn_rad: float
    ) -> tuple[list[float], float, float]:
        """Stress on each strip, their vertical force, and that on the rest of the foot."""
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
            pa, set_m[i] = ground.stress_pa(depth_m, sinking, set_m[i])
            stress_pa.append(pa)
            # The vertical part of its normal, cos(arc - angle), is below_m over its radius.
            press_n += pa * area_per_radius_m * below_m
            mean_depth_m += depth_m * area_m2
            gap_m = min(gap_m, set_m[i] - depth_m)
            deepest_m = max(deepest_m, depth_m)
        self._touches = deepest_m > 0.0
        rest_n = ground.on_the_foot_n(
            mean_depth_m / self._sole_m2, -ankle_m_s, max(gap_m, 0.0), self._sole_m2
        )
        return stress_pa, press_n, rest_n

    def _leg_n(self, motion: Motion) -> float:
        """Push of the leg: a damped spring, and an end stop that pulls.

        Raises:
            SceneError: it is pressed together all the way.
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
