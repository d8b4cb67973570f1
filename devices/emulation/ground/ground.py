"""Grounds under an emulated foot: rigid, and soft ones that give way.

Forces are along each dome's axis, times in seconds since power-up.

Vertical motion only. The stress on a strip, in Pa, normal to it, consists of:

* **Strength**, proportional to depth, as in resistive force theory for a flat plate: Li, Zhang and
  Goldman, "A terradynamics of legged locomotion on granular media", Science 339, 1408 (2013); poppy
  seeds are of the order of 0.3 N/cm^3. It is plastic: a strip that rises a little is unloaded, and
  on sinking again meets the strength at its former depth.
* **Inertia** of the displaced matter, proportional to the square of the speed, added to the
  strength: Katsuragi and Durian, "Unified force law for granular impact cratering", Nature Physics
  3, 420 (2007).
* In mud also **viscosity** under the sole, and forces on the whole foot beside the strips: viscous
  drag on its sides, suction while it is pulled out, buoyancy. Source for all of these: Chen et al.,
  "A foot resistive force model for legged locomotion on muddy terrains", arXiv:2604.12006 (2026);
  their size differs by orders of magnitude with the mud's water.

Assumed, without a source of their own: the unloading stiffness, the depth over which a touching
strip is wetted, and every number of the mud but its density (hardware.md 9: 1.5 to 1.8 kPa per
0.1 m). Left out: friction along the sole, the dependence of strength on the strip's slope, grains
that fall on the foot, and the mass of the grains that move with it (Aguilar and Goldman, Nature
Physics 12, 278 (2016), find that it matters for fast push-offs).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.scene.emulation_sections import MudGround, PoppyGround


class Ground(ABC):
    """Load on all domes of a foot; by default endless, and with a fixed segment."""

    arc_rad: Floats | None = None
    """Angle of each dome's axis in the foot; None: all stay upright at any segment angle."""

    @property
    def duration_s(self) -> float | None:
        """End of the load; None for an endless one."""
        return None

    @abstractmethod
    def forces_n(self, t_s: Floats) -> Floats:
        """Compute the force on each dome along its axis, (len(t_s), tiles)."""

    def force_beside_domes_n(self, t_s: Floats) -> Floats:
        """Compute the vertical force on the foot beside the domes."""
        return np.zeros(len(t_s))

    def angle_rad(self, t_s: Floats) -> Floats | None:
        """Compute the angle of the foot segment; None for a foot without a moving segment."""
        return None

    def tilt_rad(self, t_s: Floats) -> Floats:
        """Compute the angle of each dome's axis ahead of the vertical, (n, tiles) or (n, 1)."""
        angle_rad = self.angle_rad(t_s)
        if self.arc_rad is None or angle_rad is None:
            return np.zeros((len(t_s), 1))
        return np.asarray(self.arc_rad - angle_rad[:, None])


def map_to_first_round(t_s: Floats, lead_s: float, round_s: float) -> Floats:
    """Map times to the first round after the lead; `round_s` infinite: a single round."""
    t_s = np.asarray(t_s)
    if not math.isfinite(round_s):
        return t_s
    since_s = t_s - lead_s
    return np.where(since_s < 0.0, t_s, np.mod(since_s, round_s) + lead_s)


GRAVITY_M_S2 = 9.81
_PA_M_PER_N_CM3 = 1e6
_WETTED_M = 0.002
"""Depth of full contact: neither the strip nor the grains, a millimetre large, are flat. It takes
1.4 ms at 1.4 m/s."""
_FOOT_M = 0.02
"""Thickness of the foot, the depth of full buoyancy."""
_SUCTION_GAP_M = 0.004
_SUCTION_SPEED_M_S = 0.05
"""Speed of pulling below which mud mostly fills the gap as it opens."""


@dataclass(frozen=True)
class SoftGround:
    """Properties of the ground at one place. Derived from a scene.

    Attributes:
        strength_pa_m: strength per metre of depth.
        unloading_stiffness_ratio: ratio of the stiffness in unloading to that in penetration.
        inertia_kg_m3: density of the displaced matter, times its drag coefficient.
        viscous_pa_s_m: stress under the sole per speed of sinking.
        side_n_s_m2: viscous drag on the sides of foot and leg per speed and depth.
        suction_pa: largest suction at the sole while it is pulled out.
        head_pa_m: hydrostatic pressure per metre of depth; 0: no liquid.
    """

    strength_pa_m: float
    unloading_stiffness_ratio: float
    inertia_kg_m3: float
    viscous_pa_s_m: float = 0.0
    side_n_s_m2: float = 0.0
    suction_pa: float = 0.0
    head_pa_m: float = 0.0

    @classmethod
    def from_scene(cls, ground: PoppyGround | MudGround, firmness: float = 1.0) -> SoftGround:
        """Derive a place of a scene's ground, `firmness` times as strong as in the scene."""
        strength_pa_m = firmness * ground.strength_n_per_cm3 * _PA_M_PER_N_CM3
        if isinstance(ground, PoppyGround):
            # Grains of 1.0 g/cm^3, 58 % of the volume when loosely packed; drag coefficient 1.5.
            return cls(strength_pa_m, unloading_stiffness_ratio=20.0, inertia_kg_m3=1.5 * 580.0)
        head_pa_m = ground.head_kpa_per_m * 1e3
        half_width_m = 0.5 * math.sqrt(ground.sole_m2)
        return cls(
            strength_pa_m,
            unloading_stiffness_ratio=10.0,
            inertia_kg_m3=1.0 * head_pa_m / GRAVITY_M_S2,
            # Drag of a disc in creeping flow: 16 eta r v over pi r^2, half of it in front.
            viscous_pa_s_m=8.0 / math.pi * ground.viscosity_pa_s / half_width_m,
            # Shear in a gap of 2 cm along the sole's four edges.
            side_n_s_m2=ground.viscosity_pa_s * 8.0 * half_width_m / 0.02,
            suction_pa=ground.suction_kpa * 1e3,
            head_pa_m=head_pa_m,
        )

    def compute_stress_pa(
        self, depth_m: float, sinking_m_s: float, set_m: float
    ) -> tuple[float, float]:
        """Compute the stress on a strip, never negative, and its new plastic set.

        Args:
            depth_m: depth of the strip below the surface.
            sinking_m_s: its speed of sinking.
            set_m: plastic set: depth at which the strip is unloaded, from its earlier motion; 0 in
                untouched ground.
        """
        if depth_m <= 0.0:
            return 0.0, set_m
        strength_pa = self.strength_pa_m * depth_m
        stiffness_pa_m = self.unloading_stiffness_ratio * self.strength_pa_m
        stress_pa = stiffness_pa_m * (depth_m - set_m)
        if stress_pa < strength_pa:  # elastic: unloading or reloading
            return max(stress_pa, 0.0), set_m
        if sinking_m_s > 0.0:
            wetted = min(depth_m / _WETTED_M, 1.0)
            stress_pa = strength_pa + wetted * sinking_m_s * (
                self.inertia_kg_m3 * sinking_m_s + self.viscous_pa_s_m
            )
        else:
            stress_pa = strength_pa
        return stress_pa, depth_m - strength_pa / stiffness_pa_m

    def compute_foot_force_n(
        self, depth_m: float, sinking_m_s: float, gap_m: float, sole_m2: float
    ) -> float:
        """Compute the vertical force on the whole foot beside the strips; negative: downwards.

        Args:
            depth_m: depth of the middle of the sole.
            sinking_m_s: its speed of sinking; negative while it is pulled out.
            gap_m: gap between the sole and its bed; 0 while any strip bears load.
            sole_m2: area of the sole.
        """
        if depth_m <= 0.0 or self.head_pa_m == 0.0:
            return 0.0
        force_n = self.side_n_s_m2 * depth_m * sinking_m_s
        force_n += self.head_pa_m * sole_m2 * min(depth_m, _FOOT_M)
        if sinking_m_s < 0.0 < gap_m:
            force_n -= sole_m2 * self.compute_suction_pa(gap_m, -sinking_m_s)
        return force_n

    def compute_suction_pa(self, gap_m: float, rising_m_s: float) -> float:
        """Compute suction on a rising sole: largest at `_SUCTION_GAP_M`, zero in a filled gap."""
        part = gap_m / _SUCTION_GAP_M
        flow = rising_m_s / (rising_m_s + _SUCTION_SPEED_M_S)
        return self.suction_pa * part * math.exp(1.0 - part) * flow
