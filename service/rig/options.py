"""Options of a rig, importable by commands without the rig's dependencies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from devices.scene.hardware_sections import EMULATED
from devices.scene.scene_file import Scene
from service.rig.emulated_foot import EmulatedFoot


@dataclass(frozen=True)
class RigOptions:
    """Options of a rig; `foot` is for emulation only."""

    scene: Scene
    node_name: str
    foot: EmulatedFoot = EmulatedFoot()  # noqa: RUF009  # frozen, so one for all is safe
    journals_folder: Path | None = None
    """Folder of the node's journals, for the files of frames in flight in a subfolder per stream.
    """

    @property
    def is_emulated(self) -> bool:
        """True if the tiles are emulated."""
        return self.scene.array.bus == EMULATED
