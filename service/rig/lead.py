"""The lead of an emulated load: the foot hangs in the air until there is enough to tare from.

As an operator would, who looks at the screen before the robot is let go: a machine that is busy
reads few frames in a second, and a load that comes by the clock alone would come too early.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from devices.frames import FrameBatch, TileStatus

if TYPE_CHECKING:
    from devices.emulation.world import World

READABLE_MIN = 25
"""Readings of each tile before the scene's time begins: a tare needs some fewer."""
PATIENCE_NS = 10_000_000_000
"""A tile that gives no readings for so long will not give any: the load comes all the same."""
_NOT_YET_NS = 2**62


class Lead:
    """When an emulated load begins; until `end_ns` frames are its lead.

    Args:
        world: is begun by this; until then it is as at its first instant.
        lead_s: seconds without load after that; 0: there is no lead, and no waiting.
    """

    def __init__(self, world: World, lead_s: float) -> None:
        self._world = world
        self._lead_ns = round(lead_s * 1e9)
        self._readable = 0
        self._since_ns: int | None = None
        self.end_ns = _NOT_YET_NS
        """Instant of the node's clock; far off while it is not known."""
        if not self._lead_ns:
            self._begin()

    def see(self, batch: FrameBatch) -> None:
        """Frames that were taken, in order."""
        if self.end_ns != _NOT_YET_NS:
            return
        if self._since_ns is None:
            self._since_ns = int(batch.t_mono_ns[0])
        # Of all tiles at once: readings that alternate would be no rest to tare from.
        self._readable += int(((batch.status & TileStatus.UNUSABLE) == 0).all(axis=1).sum())
        waited_ns = int(batch.t_mono_ns[-1]) - self._since_ns
        if self._readable >= READABLE_MIN or waited_ns > PATIENCE_NS:
            self._begin()

    def _begin(self) -> None:
        self._world.begin()
        self.end_ns = self._world.epoch_ns + self._lead_ns
