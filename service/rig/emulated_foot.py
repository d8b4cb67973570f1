"""Options of an emulated foot: load, seeds of parts and noise, plates under it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from devices.clock import Clock
from devices.emulation.ground.grounds import convert_load_for_scene
from devices.emulation.ground.load_trace import CopTransform, LoadTrace, TileLoad
from devices.errors import require_extra
from devices.scene.hardware_sections import EMULATED
from devices.scene.scene_file import Scene
from service.rig.plate_files import PlateFiles, write_plate_files

if TYPE_CHECKING:
    from devices.emulation.world import World


@dataclass(frozen=True)
class EmulatedFoot:
    """Options of an emulation beside the scene; see `foottile simulate --help`."""

    load: LoadTrace | None = None
    load_scale: float = 1.0
    cop_transform: CopTransform = CopTransform()  # noqa: RUF009  # frozen, so one for all is safe
    lead_s: float = 1.0
    seed: int = 0
    parts_seed: int = 0
    plates: PlateFiles = PlateFiles()  # noqa: RUF009  # frozen, so one for all is safe

    def compute_tile_load(self, scene: Scene) -> TileLoad | None:
        """Compute the recorded load's forces on the tiles of a scene; None without a load.

        Raises:
            LoadTraceError: the load does not fit the tiles.
        """
        if self.load is None:
            return None
        return convert_load_for_scene(
            scene,
            self.load,
            load_scale=self.load_scale,
            cop_transform=self.cop_transform,
            lead_s=self.lead_s,
        )

    def make_world(
        self,
        scene: Scene,
        clock: Clock,
        tile_load: TileLoad | None,
        *,
        is_repeated: bool = False,
        in_real_time: bool = False,
    ) -> World:
        """Create the emulated world of a scene, before its time begins.

        Raises:
            MissingExtraError: the physics needs packages that are not installed.
        """
        # Imported here, because a real node has no numba.
        with require_extra("emulation", "an emulated array"):
            from devices.emulation.world import World

        return World(
            scene,
            clock,
            seed=self.seed,
            parts_seed=self.parts_seed,
            lead_s=self.lead_s,
            tile_load=tile_load,
            is_repeated=is_repeated,
            begins_now=False,
            in_real_time=in_real_time,
        )

    def write_plate_recordings(self, world: World, end_ns: int) -> None:
        """Write the recordings of the plates under the foot, until an instant of the node's clock.

        Raises:
            StorageError: a file cannot be written.
        """
        write_plate_files(self.plates, world, end_ns, seed=self.seed, parts_seed=self.parts_seed)


@dataclass(frozen=True)
class RigOptions:
    """Options of a rig; `foot` is for emulation only."""

    scene: Scene
    node_name: str
    foot: EmulatedFoot = EmulatedFoot()  # frozen, so one for all is safe
    journals_folder: Path | None = None
    """Folder of the node's journals, for the files of frames in flight in a subfolder per stream.
    """

    @property
    def is_emulated(self) -> bool:
        """True if the tiles are emulated."""
        return self.scene.array.bus == EMULATED
