"""Options of an emulated foot: load, seeds of parts and noise, plates under it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from devices.clock import Clock
from devices.emulation.ground.grounds import press_on
from devices.emulation.ground.load_trace import CopTransform, LoadTrace, PressedTrace
from devices.errors import needs_extra
from devices.scene.file import Scene
from service.rig.plates import PlateFiles, write_plates

if TYPE_CHECKING:
    from devices.emulation.world import World


@dataclass(frozen=True)
class EmulatedFoot:
    """Options of an emulation beside the scene; see `foottile simulate --help`."""

    load: LoadTrace | None = None
    load_scale: float = 1.0
    cop: CopTransform = CopTransform()  # noqa: RUF009  # frozen, so one for all is safe
    lead_s: float = 1.0
    seed: int = 0
    parts_seed: int = 0
    plates: PlateFiles = PlateFiles()  # noqa: RUF009  # frozen, so one for all is safe

    def pressed_on(self, scene: Scene) -> PressedTrace | None:
        """Compute the recorded load's forces on the tiles of a scene; None without a load.

        Raises:
            LoadTraceError: the load does not fit the tiles.
        """
        if self.load is None:
            return None
        return press_on(
            scene, self.load, load_scale=self.load_scale, cop=self.cop, lead_s=self.lead_s
        )

    def world(
        self,
        scene: Scene,
        clock: Clock,
        pressed: PressedTrace | None,
        *,
        looped: bool = False,
        in_real_time: bool = False,
    ) -> World:
        """Create the emulated world of a scene, before its time begins.

        Raises:
            MissingExtraError: the physics needs packages that are not installed.
        """
        # Imported here, because a real node has no numba.
        with needs_extra("emulation", "an emulated array"):
            from devices.emulation.world import World

        return World(
            scene,
            clock,
            seed=self.seed,
            parts_seed=self.parts_seed,
            lead_s=self.lead_s,
            pressed=pressed,
            looped=looped,
            begun=False,
            in_real_time=in_real_time,
        )

    def write_plates(self, world: World, end_ns: int) -> None:
        """Write the recordings of the plates under the foot, until an instant of the node's clock.

        Raises:
            StorageError: a file cannot be written.
        """
        write_plates(self.plates, world, end_ns, seed=self.seed, parts_seed=self.parts_seed)
