"""What rig to open. Commands say it, who need not import what opens it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from devices.scene.file import Scene
from devices.scene.hardware import EMULATED
from service.rig.emulated import EmulatedFoot


@dataclass(frozen=True)
class RigOptions:
    """What to open; `foot` is for emulation only."""

    scene: Scene
    node: str
    foot: EmulatedFoot = EmulatedFoot()  # noqa: RUF009  # frozen, so one for all is safe
    streams: Path | None = None
    """Folder of the node's journals: frames in flight are kept there, each stream's in its own."""

    @property
    def emulated(self) -> bool:
        """Are the tiles emulated?"""
        return self.scene.array.bus == EMULATED
