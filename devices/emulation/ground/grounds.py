"""Grounds of scenes: a foot in the air, standing, rolling, or under a recorded load.

Every load begins after `lead_s` seconds without load.
"""

from __future__ import annotations

import numpy as np

from devices.arrays import Bools, Floats
from devices.emulation.ground.ground import Ground, map_to_first_round
from devices.emulation.ground.hopping import Hopping
from devices.emulation.ground.indenter import IndentationProgramme
from devices.emulation.ground.load_trace import (
    CopTransform,
    LoadTrace,
    TileLoad,
    convert_to_tile_load,
)
from devices.emulation.parts import make_rng
from devices.errors import SceneError, UsageError
from devices.scene.emulation_sections import (
    IndentationGround,
    MudGround,
    NoGround,
    PlateGround,
    PoppyGround,
    RollingGround,
    TraceGround,
)
from devices.scene.hardware_sections import TileSection
from devices.scene.scene_file import Scene


class NoLoad(Ground):
    """Foot in the air."""

    def __init__(self, tiles: int) -> None:
        self._tiles = tiles

    def forces_n(self, t_s: Floats) -> Floats:
        """Return zeros."""
        return np.zeros((len(t_s), self._tiles))


class Standing(Ground):
    """Constant load with a slow sway of the centre of pressure, as in quiet standing."""

    _LOWERING_S = 0.3
    _SWAY_HZ = (0.23, 0.61)  # incommensurate, for a long period

    def __init__(
        self,
        ground: PlateGround,
        positions_m: Floats,
        bears: Bools,
        seed: int,
        lead_s: float,
    ) -> None:
        self._load_n = ground.load_n
        self._lead_s = lead_s
        self._phases = make_rng(f"sway/{seed}").uniform(0, 2 * np.pi, len(self._SWAY_HZ))
        x_m = positions_m[bears, 0] - positions_m[bears, 0].mean()
        spread = (x_m**2).sum()
        per_m = x_m / spread if spread > 0 else np.zeros(len(x_m))
        even = 1.0 / len(x_m)
        if ground.sway_m * np.abs(per_m).max() > even:
            raise SceneError(
                f"ground.sway_m = {ground.sway_m} would lift a tile off the plate",
                expected=f"at most {even / np.abs(per_m).max():.4f} for this array",
            )
        self._even = np.where(bears, even, 0.0)
        self._per_m = np.zeros(len(positions_m))
        self._per_m[bears] = per_m
        self._sway_m = ground.sway_m

    def forces_n(self, t_s: Floats) -> Floats:
        """Compute the tile forces with the least squares for the load and centre of pressure."""
        since = np.asarray(t_s) - self._lead_s
        load_n = self._load_n * np.clip(since / self._LOWERING_S, 0.0, 1.0)
        sway_m = sum(
            self._sway_m / len(self._SWAY_HZ) * np.sin(2 * np.pi * hz * since + phase)
            for hz, phase in zip(self._SWAY_HZ, self._phases, strict=True)
        )
        return np.asarray(load_n[:, None] * (self._even + np.outer(sway_m, self._per_m)))


class Rolling(Ground):
    """Rolling of the foot's arc over a rigid plate at constant speed, lifted and repeated.

    Rolling forward turns the segment by a positive angle, and the contact moves forward on the foot
    to the place whose arc angle equals the segment's.
    """

    arc_rad: Floats

    _LOWERING_S = 0.2
    _BACK_S = 1.0

    def __init__(
        self,
        ground: RollingGround,
        positions_m: Floats,
        bears: Bools,
        lead_s: float,
    ) -> None:
        self._ground = ground
        self._lead_s = lead_s
        self._bears = bears
        self.arc_rad = np.arctan2(positions_m[:, 0], -positions_m[:, 2])
        reach_rad = 0.5 * ground.patch_m / ground.radius_m
        self._from_rad = self.arc_rad[bears].min() - reach_rad
        self._to_rad = self.arc_rad[bears].max() + reach_rad
        self._roll_s = (self._to_rad - self._from_rad) * ground.radius_m / ground.speed_m_s
        self._cycle_s = 2 * self._LOWERING_S + self._roll_s + self._BACK_S

    def forces_n(self, t_s: Floats) -> Floats:
        """Compute the forces of an elastic foundation under the contact patch.

        The load is their vertical sum.
        """
        since = np.asarray(t_s) - self._lead_s
        phase_s = np.mod(since, self._cycle_s)
        lifting_s = phase_s - self._LOWERING_S - self._roll_s
        load_n = self._ground.load_n * np.clip(
            np.minimum(phase_s, -(lifting_s - self._LOWERING_S)) / self._LOWERING_S, 0.0, 1.0
        )
        load_n[since < 0] = 0.0
        off_rad = self.arc_rad - self._angle(since)[:, None]
        reach = self._ground.patch_m / self._ground.radius_m
        pressed = np.where(self._bears, np.maximum(0.0, 1.0 - (off_rad / reach) ** 2), 0.0)
        vertical = (pressed * np.cos(off_rad)).sum(axis=1)
        vertical[vertical == 0.0] = np.inf  # no contact
        return np.asarray(pressed * (load_n / vertical)[:, None])

    def angle_rad(self, t_s: Floats) -> Floats:
        """Compute the angle of the segment."""
        return self._angle(np.asarray(t_s) - self._lead_s)

    def _angle(self, since_s: Floats) -> Floats:
        phase_s = np.mod(np.maximum(since_s, 0.0), self._cycle_s) - self._LOWERING_S
        rolled = np.clip(phase_s / self._roll_s, 0.0, 1.0)
        back = np.clip((phase_s - self._roll_s - self._LOWERING_S) / self._BACK_S, 0.0, 1.0)
        return np.asarray(self._from_rad + (self._to_rad - self._from_rad) * (rolled - back))


class TraceLoad(Ground):
    """Recorded load, linear between its samples, repeated endlessly if `is_repeated`."""

    _PAUSE_S = 1.0
    """Pause in the air between two rounds, long enough for a tare."""

    def __init__(
        self, tile_load: TileLoad, lead_s: float = 0.0, *, is_repeated: bool = False
    ) -> None:
        self._tile_load = tile_load
        self._lead_s = lead_s
        self._round_s = (
            float(tile_load.time_s[-1]) - lead_s + self._PAUSE_S if is_repeated else np.inf
        )

    @property
    def duration_s(self) -> float | None:
        """End of the trace, after lifting the foot; None if looped."""
        return None if np.isfinite(self._round_s) else float(self._tile_load.time_s[-1])

    def forces_n(self, t_s: Floats) -> Floats:
        """Interpolate the trace's forces; zero before and after it."""
        time_s, forces_n = self._tile_load.time_s, self._tile_load.forces_n
        at_s = map_to_first_round(t_s, self._lead_s, self._round_s)
        return np.stack(
            [np.interp(at_s, time_s, f, left=0.0, right=0.0) for f in forces_n.T], axis=1
        )

    def angle_rad(self, t_s: Floats) -> Floats | None:
        """Interpolate the trace's angle; None without one."""
        if self._tile_load.angle_rad is None:
            return None
        at_s = map_to_first_round(t_s, self._lead_s, self._round_s)
        return np.interp(at_s, self._tile_load.time_s, self._tile_load.angle_rad)


def make_ground(
    scene: Scene,
    *,
    seed: int,
    lead_s: float,
    tile_load: TileLoad | None,
    is_repeated: bool = False,
) -> Ground:
    """Create the ground of a scene, or of a recorded load in its place.

    With `is_repeated` a finite load (a recorded one, or three hops) repeats endlessly.

    Raises:
        UsageError: the scene needs a load trace and none was given.
        SceneError: the ground's keys are physically impossible.
    """
    positions_m = get_tile_positions_m(scene.tile)
    bears = np.array([not tile.reference for tile in scene.tile])
    if tile_load is not None:
        return TraceLoad(tile_load, lead_s, is_repeated=is_repeated)
    match scene.ground:
        case NoGround():
            return NoLoad(len(bears))
        case PlateGround() as ground:
            return Standing(ground, positions_m, bears, seed, lead_s)
        case RollingGround() as ground:
            return Rolling(ground, positions_m, bears, lead_s)
        case PoppyGround() | MudGround() as ground:
            return Hopping(ground, positions_m, bears, seed, lead_s, is_repeated=is_repeated)
        case IndentationGround() as ground:
            return IndentationProgramme(ground, scene.tile, lead_s)
        case TraceGround():
            raise UsageError(
                f"scene {scene.name!r} presses a recorded load, and none was given",
                remedy="Add --load FILE",
            )


def convert_load_for_scene(
    scene: Scene, load: LoadTrace, *, load_scale: float, cop_transform: CopTransform, lead_s: float
) -> TileLoad:
    """Convert a recorded load to forces on the scene's tiles (`load_trace.press`).

    Raises:
        LoadTraceError: the load does not fit the tiles.
    """
    return convert_to_tile_load(
        load,
        get_tile_positions_m(scene.tile)[:, :2],
        np.array([not tile.reference for tile in scene.tile]),
        load_scale=load_scale,
        cop_transform=cop_transform,
        lead_s=lead_s,
    )


def get_tile_positions_m(tiles: tuple[TileSection, ...]) -> Floats:
    """Return the positions of tiles in the foot frame, (tiles, 3)."""
    return np.array([(tile.x_m, tile.y_m, tile.z_m) for tile in tiles])
