"""Options of a rig, importable by commands without the rig's dependencies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from devices.scene.file import Scene
from devices.scene.hardware import EMULATED
from service.rig.emulated import EmulatedFoot


@dataclass(frozen=True)
class RigOptions:
    """Options of a rig; `foot` is for emulation only."""

    scene: Scene
    node: str
    foot: EmulatedFoot = EmulatedFoot()  # noqa: RUF009  # frozen, so one for all is safe
    streams: Path | None = None
    """Folder of the node's journals, for the files of frames in flight in a subfolder per stream.
    """

    @property
    def emulated(self) -> bool:
        """True if the tiles are emulated."""
        return self.scene.array.bus == EMULATED
