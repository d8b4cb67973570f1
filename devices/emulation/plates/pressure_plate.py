"""Emulated pressure plate: a matrix of cells with individual gains, a threshold and a limit.

The domes touch it. Each makes a round patch with the pressure of an elastic sphere on a plane
(Hertz), whose middle is the dome's place on the plate and whose radius is at most the dome's.
Sources and confidence of the numbers are in hardware.md 11.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.emulation.plates.plate import PlateClock, PlateLoad

RATE_HZ = 100.0
PITCH_M = 0.005
THRESHOLD_KPA, END_KPA, STEP_KPA = 10.0, 1270.0, 2.5
"""Threshold below which a cell shows zero, largest value, and resolution."""
NOISE_KPA = 1.0
CELL_GAIN, GAIN = 0.03, 0.01
"""Standard deviations of a cell's gain, and of the whole plate's, relative."""
PLACED_M, TURNED_RAD = 0.0005, math.radians(1.0)
"""Standard deviations of the foot's placement on its mark, by axis, and of its rotation."""
STATED_SIGMA_N = 0.25
"""Standard uncertainty of a sum of some 9 N: noise and steps of 30 cells, thresholds, gains."""
STATED_COP_SIGMA_M = 0.001
"""Standard uncertainty of a COP coordinate: placement, rotation, cells and their gains."""
DRIFT_PPM = 50.0
LATEST_S = 0.4

_MARGIN_M = 0.02
_DOME_RADIUS_M = 0.0055
_MODULUS_PA = 2.17e6 / (
    1.0 - 0.5**2
)  # modulus of the paper's Vytaflex 60, incompressible, on a rigid plate
_POINTS = 61
_GOLDEN_RAD = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True)
class PressurePlate:
    """Pressure plate in one trial.

    Attributes:
        clock: clock of the plate.
        origin_m: (2,), middle of the first cell, relative to the mark for the foot.
        gains: (cells along x, cells along y), gains of force.
        placed_m: (2,), position of the foot relative to the mark.
        turned_rad: rotation of the foot, to the left.
    """

    clock: PlateClock
    origin_m: Floats
    gains: Floats
    placed_m: Floats
    turned_rad: float

    @classmethod
    def draw(
        cls, places_m: Floats, plate: np.random.Generator, trial: np.random.Generator
    ) -> PressurePlate:
        """Draw a plate around places (tiles, 2), and the placement of the foot in a trial."""
        cells = np.ceil((np.abs(places_m).max(axis=0) + _MARGIN_M) / PITCH_M).astype(int)
        whole = 1.0 + GAIN * plate.standard_normal()
        return cls(
            clock=PlateClock(
                RATE_HZ,
                start_s=trial.uniform(0.05, LATEST_S),
                drift_ppm=plate.uniform(-DRIFT_PPM, DRIFT_PPM),
            ),
            origin_m=-PITCH_M * (cells - 0.5),
            gains=whole * (1.0 + CELL_GAIN * plate.standard_normal(2 * cells)),
            placed_m=PLACED_M * trial.standard_normal(2),
            turned_rad=TURNED_RAD * trial.standard_normal(),
        )

    def simulate_recording(
        self, plate_load: PlateLoad, end_s: float, noise: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """Simulate a recording of a foot until `end_s` of the scene.

        Returns:
            Times by the plate's clock (n,), and forces (n, cells along x, cells along y).
        """
        time_s, t_s = self.clock.compute_sample_times(end_s)
        cosine, sine = math.cos(self.turned_rad), math.sin(self.turned_rad)
        turn = np.array([[cosine, sine], [-sine, cosine]])
        places_m = plate_load.dome_places_m @ turn + self.placed_m
        bears = self._compute_cell_forces_n(plate_load.compute_vertical_n(t_s), places_m)
        n_per_kpa = 1e3 * PITCH_M**2
        kpa = bears * self.gains / n_per_kpa
        kpa += NOISE_KPA * noise.standard_normal(kpa.shape)
        kpa = np.rint(np.minimum(kpa, END_KPA) / STEP_KPA) * STEP_KPA
        return time_s, np.where(kpa < THRESHOLD_KPA, 0.0, kpa) * n_per_kpa

    def _compute_cell_forces_n(self, vertical_n: Floats, places_m: Floats) -> Floats:
        """Compute the load of each cell, (n, cells along x, cells along y); none off the plate."""
        shape = (len(vertical_n), *self.gains.shape)
        total = np.zeros(math.prod(shape))
        radius_m = compute_patch_radius_m(vertical_n)
        frame = np.arange(len(vertical_n))[:, None]
        for dome, place_m in enumerate(places_m):
            at_m = place_m + radius_m[:, dome, None, None] * _SPREAD
            cell = np.rint((at_m - self.origin_m) / PITCH_M).astype(int)
            inside = ((cell >= 0) & (cell < self.gains.shape)).all(axis=2)
            flat = (frame * shape[1] + cell[..., 0]) * shape[2] + cell[..., 1]
            each_n = np.broadcast_to(vertical_n[:, dome, None] / _POINTS, flat.shape)
            total += np.bincount(flat[inside], each_n[inside], len(total))
        return total.reshape(shape)


def compute_patch_radius_m(force_n: Floats) -> Floats:
    """Compute the radius of a dome's contact patch on a plane under a force."""
    cubed = 0.75 * np.maximum(force_n, 0.0) * _DOME_RADIUS_M / _MODULUS_PA
    return np.asarray(np.minimum(np.cbrt(cubed), _DOME_RADIUS_M))


def _compute_patch_points() -> Floats:
    """Compute points of a patch of radius 1 with equal forces, (points, 2).

    The part 1 - (1 - r^2)^(3/2) of the force is within a radius r (Hertz).
    """
    part = (np.arange(_POINTS) + 0.5) / _POINTS
    radius = np.sqrt(1.0 - (1.0 - part) ** (2.0 / 3.0))
    turn_rad = _GOLDEN_RAD * np.arange(_POINTS)
    points = np.stack([radius * np.cos(turn_rad), radius * np.sin(turn_rad)], axis=1)
    return np.asarray(points - points.mean(axis=0))


_SPREAD = _compute_patch_points()
