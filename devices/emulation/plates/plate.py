"""Emulated plate under a foot: the load on it, and its own clock.

Laboratory axes: x forward, y left, z up; forces of the ground on the foot, in newtons; moments
about the middle of the plate's surface. The foot's middle is over it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.emulation.ground.ground import Ground
from devices.errors import UsageError
from devices.scene.scene_file import Scene

FORCES = (0, 1, 2)
MOMENTS = (3, 4, 5)
VERTICAL = 2

_GROUND_KINDS_BY_INSTRUMENT = {"force plate": {"none", "plate", "rolling", "trace", "poppy", "mud"}}
_GROUND_KINDS_BY_INSTRUMENT["pressure plate"] = _GROUND_KINDS_BY_INSTRUMENT["force plate"] - {
    "poppy",
    "mud",
}
"""Grounds with which an instrument can be used: no footprint passes through seeds or mud."""


class PlateLoad:
    """Load of a foot on a plate.

    An arc rolls without slipping, so each dome touches the plate at one place, whose distance from
    the middle is the dome's arc length. Load beside the domes acts in the middle.

    Args:
        ground: ground of the scene.
        positions_m: (tiles, 3), positions in the foot frame.
    """

    def __init__(self, ground: Ground, positions_m: Floats) -> None:
        self._ground = ground
        x_m, y_m, z_m = positions_m.T
        if ground.arc_rad is not None:
            x_m = np.hypot(x_m, z_m) * ground.arc_rad
        self.dome_places_m = np.stack([x_m, y_m], axis=1)
        """Position on the plate at which each dome touches it, (tiles, 2)."""

    def compute_vertical_n(self, t_s: Floats) -> Floats:
        """Compute the vertical force under each dome, (n, tiles)."""
        return np.asarray(self._ground.forces_n(t_s) * np.cos(self._ground.tilt_rad(t_s)))

    def compute_wrench(self, t_s: Floats) -> Floats:
        """Compute forces and moments of the whole foot, (n, 6): x, y, z of each."""
        forces_n, tilt_rad = self._ground.forces_n(t_s), self._ground.tilt_rad(t_s)
        up_n, back_n = forces_n * np.cos(tilt_rad), forces_n * np.sin(tilt_rad)
        x_m, y_m = self.dome_places_m.T
        columns = (
            -back_n.sum(axis=1),
            np.zeros(len(t_s)),
            up_n.sum(axis=1) + self._ground.force_beside_domes_n(t_s),
            (up_n * y_m).sum(axis=1),
            -(up_n * x_m).sum(axis=1),
            (back_n * y_m).sum(axis=1),
        )
        return np.stack(columns, axis=1)


def check_plate_usable(instrument: str, scene: Scene) -> None:
    """Check that a plate can measure the load of a scene.

    Args:
        instrument: "force plate" or "pressure plate".
        scene: the scene file.

    Raises:
        UsageError: the plate cannot be used with its ground.
    """
    kinds = _GROUND_KINDS_BY_INSTRUMENT[instrument]
    if scene.ground.kind not in kinds:
        raise UsageError(
            f"a {instrument} under a ground of kind {scene.ground.kind!r} sees nothing of the foot",
            where=f"scene {scene.name}",
            expected=" or ".join(sorted(kinds)),
        )


@dataclass(frozen=True)
class PlateClock:
    """Sample clock of an instrument.

    Attributes:
        rate_hz: nominal sample rate.
        start_s: instant of the first sample, in seconds of the scene.
        drift_ppm: excess of the real rate.
    """

    rate_hz: float
    start_s: float
    drift_ppm: float

    def compute_sample_times(self, end_s: float) -> tuple[Floats, Floats]:
        """Compute the sample times until the scene's `end_s`.

        Returns:
            Times by the instrument, from zero, and by the scene, from `start_s`, both (n,); empty
            if `end_s` is before the start.
        """
        goes = 1.0 + 1e-6 * self.drift_ppm
        n = max(0, int((end_s - self.start_s) * goes * self.rate_hz))
        time_s = np.arange(n) / self.rate_hz
        return time_s, self.start_s + time_s / goes
