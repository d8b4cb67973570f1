"""What a plate sees of an emulated foot and no dome bears: rim, drag, suction and buoyancy.

A real laboratory cannot know it. It tells a reader how much of a difference between foot and plate
is not the foot's error; no figure of a comparison is made with it.
"""

from __future__ import annotations

import numpy as np

from devices.emulation.ground.grounds import make_ground
from devices.scene.file import Scene

_STEP_S = 1e-3
_LOADED_N = 0.5


def not_borne_n(scene: Scene, seed: int, seconds: float) -> float:
    """Mean magnitude of it while the plate is loaded, over one trial behind the lead."""
    ground = make_ground(scene, seed=seed, lead_s=0.0, pressed=None)
    t_s = np.arange(0.0, seconds, _STEP_S)
    borne_n = (ground.forces_n(t_s) * np.cos(ground.tilt_rad(t_s))).sum(axis=1)
    rest_n = ground.rest_n(t_s)
    loaded = borne_n + rest_n > _LOADED_N
    return float(np.abs(rest_n[loaded]).mean())
