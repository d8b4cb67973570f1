"""Composition of the `ArrayInfo` of a stream from identified tiles and scene."""

from __future__ import annotations

from devices.chips.dynamixel.models import COUNTS_PER_TURN
from devices.clock import UtcAnchor
from devices.frames import ArrayInfo, ServoInfo, TileInfo
from devices.scene.file import Scene
from devices.scene.hardware import ScheduleName
from service.version import SOFTWARE


def describe(
    scene: Scene,
    tiles: tuple[TileInfo, ...],
    anchor: UtcAnchor,
    *,
    node: str,
    boot_id: str,
    schedule: ScheduleName,
    rate_hz: float,
) -> ArrayInfo:
    """Compose the array description of a stream.

    Args:
        scene: the scene file.
        tiles: tiles as identified on the bus.
        anchor: UTC anchor of the stream.
        node: name of the node.
        boot_id: id of the stream.
        schedule: schedule of the bus.
        rate_hz: expected frame rate.
    """
    servo = None
    if scene.servo is not None:
        servo = ServoInfo(
            model=scene.servo.model,
            counts_per_turn=COUNTS_PER_TURN,
            zero_counts=scene.servo.zero_counts,
            sign=scene.servo.sign,
            ratio=scene.servo.ratio,
            ankle_travel_m_per_rad=scene.servo.ankle_travel_m_per_rad,
        )
    return ArrayInfo(
        node=node,
        boot_id=boot_id,
        tiles=tiles,
        servo=servo,
        schedule=schedule,
        nominal_rate_hz=rate_hz,
        utc_offset_ns=anchor.offset_ns,
        clock_set=anchor.clock_set,
        software=SOFTWARE,
        scene=scene.name,
        models=scene.models,
    )
