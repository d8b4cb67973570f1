"""Lead of an emulated load: the foot hangs in the air until a tare has enough readings.

A busy machine reads few frames in a second, so a load that begins after a fixed time alone could
begin too early.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from devices.flags import TileFlag
from devices.frames import FrameBatch

if TYPE_CHECKING:
    from devices.emulation.world import World

USABLE_FRAMES_MIN = 25
"""Usable readings of each tile before the scene's time begins: more than a tare needs."""
LEAD_TIMEOUT_NS = 10_000_000_000
"""Timeout after which the load begins without usable readings of all tiles."""
_NOT_YET_NS = 2**62


class LoadTrigger:
    """Trigger of an emulated load; frames before `end_t_mono_ns` are its lead.

    Args:
        world: world whose time this begins; until then it stays at its first instant.
        lead_s: seconds without load after that; 0: no lead, and no waiting.
    """

    def __init__(self, world: World, lead_s: float) -> None:
        self._world = world
        self._lead_ns = round(lead_s * 1e9)
        self._usable_frames = 0
        self._since_ns: int | None = None
        self.end_ns = _NOT_YET_NS
        """End of the lead on the node's clock; far in the future while unknown."""
        if not self._lead_ns:
            self._begin_world()

    def add_batch(self, batch: FrameBatch) -> None:
        """Count usable readings of the next batch; begin the world's time if there are enough."""
        if self.end_ns != _NOT_YET_NS:
            return
        if self._since_ns is None:
            self._since_ns = int(batch.t_mono_ns[0])
        # Of all tiles at once: a tare needs frames in which all tiles are usable.
        self._usable_frames += int(((batch.tile_flags & TileFlag.UNUSABLE) == 0).all(axis=1).sum())
        waited_ns = int(batch.t_mono_ns[-1]) - self._since_ns
        if self._usable_frames >= USABLE_FRAMES_MIN or waited_ns > LEAD_TIMEOUT_NS:
            self._begin_world()

    def _begin_world(self) -> None:
        self._world.begin_scene_time()
        self.end_ns = self._world.epoch_ns + self._lead_ns
