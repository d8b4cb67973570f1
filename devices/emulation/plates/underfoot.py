"""What a foot does to a plate under it, as a function of time.

Axes are the laboratory's: x forward, y left, z up; forces are those of the ground on the foot, in
newtons, moments about the plate's middle, in its surface. The foot's middle stands over it.
"""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats
from devices.emulation.ground.ground import Ground
from devices.errors import UsageError
from devices.scene.file import Scene

FORCES = (0, 1, 2)
MOMENTS = (3, 4, 5)
VERTICAL = 2

_SEEN_AS = {"force plate": {"none", "plate", "rolling", "trace", "poppy", "mud"}}
_SEEN_AS["pressure plate"] = _SEEN_AS["force plate"] - {"poppy", "mud"}
"""Grounds under which an instrument can lie: no footprint comes through seeds or mud."""


class Underfoot:
    """A foot on a plate.

    An arc rolls without slipping, so each dome comes down on one place of the plate: as far from
    the middle as its arc is long. What no dome bears comes down in the middle.

    Args:
        ground: of the scene.
        positions_m: (tiles, 3), in the foot frame.
    """

    def __init__(self, ground: Ground, positions_m: Floats) -> None:
        self._ground = ground
        x_m, y_m, z_m = positions_m.T
        if ground.arc_rad is not None:
            x_m = np.hypot(x_m, z_m) * ground.arc_rad
        self.places_m = np.stack([x_m, y_m], axis=1)
        """(tiles, 2), where on the plate each dome comes down."""

    def vertical_n(self, t_s: Floats) -> Floats:
        """Vertical force under each dome, (n, tiles)."""
        return np.asarray(self._ground.forces_n(t_s) * np.cos(self._ground.tilt_rad(t_s)))

    def wrench(self, t_s: Floats) -> Floats:
        """Forces and moments of the whole foot, (n, 6): x, y, z of each."""
        forces_n, tilt_rad = self._ground.forces_n(t_s), self._ground.tilt_rad(t_s)
        up_n, back_n = forces_n * np.cos(tilt_rad), forces_n * np.sin(tilt_rad)
        x_m, y_m = self.places_m.T
        columns = (
            -back_n.sum(axis=1),
            np.zeros(len(t_s)),
            up_n.sum(axis=1) + self._ground.rest_n(t_s),
            (up_n * y_m).sum(axis=1),
            -(up_n * x_m).sum(axis=1),
            (back_n * y_m).sum(axis=1),
        )
        return np.stack(columns, axis=1)


def check_seen(instrument: str, scene: Scene) -> None:
    """Refuse a plate that would see nothing of a scene.

    Args:
        instrument: "force plate" or "pressure plate".
        scene: which.

    Raises:
        UsageError: its ground lies on no such plate.
    """
    kinds = _SEEN_AS[instrument]
    if scene.ground.kind not in kinds:
        raise UsageError(
            f"a {instrument} under a ground of kind {scene.ground.kind!r} sees nothing of the foot",
            where=f"scene {scene.name}",
            expected=" or ".join(sorted(kinds)),
        )
