"""True force on the plate beside the domes' load: rim, drag, suction and buoyancy.

It is known in emulation only. The report states it to show how much of the difference between foot
and plate is not the foot's error; no comparison uses it.
"""

from __future__ import annotations

import numpy as np

from devices.emulation.ground.grounds import make_ground
from devices.scene.scene_file import Scene

_STEP_S = 1e-3
_LOADED_N = 0.5


def compute_not_borne_n(scene: Scene, seed: int, seconds: float) -> float:
    """Compute its mean magnitude in N while the plate is loaded, over one trial without lead-in."""
    ground = make_ground(scene, seed=seed, lead_s=0.0, tile_load=None)
    t_s = np.arange(0.0, seconds, _STEP_S)
    borne_n = (ground.forces_n(t_s) * np.cos(ground.tilt_rad(t_s))).sum(axis=1)
    rest_n = ground.force_beside_domes_n(t_s)
    loaded = borne_n + rest_n > _LOADED_N
    return float(np.abs(rest_n[loaded]).mean())
