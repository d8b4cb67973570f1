"""Composition of the `ArrayInfo` of a stream from identified tiles and scene."""

from __future__ import annotations

from devices.chips.dynamixel.firmwares import COUNTS_PER_TURN
from devices.clock import UtcAnchor
from devices.frames import ArrayInfo, ServoInfo, TileInfo
from devices.scene.hardware_sections import ScheduleName
from devices.scene.scene_file import Scene
from service.version import SOFTWARE_VERSION


def make_array_info(
    scene: Scene,
    tiles: tuple[TileInfo, ...],
    anchor: UtcAnchor,
    *,
    node: str,
    stream_id: str,
    schedule: ScheduleName,
    rate_hz: float,
) -> ArrayInfo:
    """Compose the array description of a stream.

    Args:
        scene: the scene file.
        tiles: tiles as identified on the bus.
        anchor: UTC anchor of the stream.
        node: name of the node.
        stream_id: id of the stream.
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
        stream_id=stream_id,
        tiles=tiles,
        servo=servo,
        schedule=schedule,
        nominal_rate_hz=rate_hz,
        utc_offset_ns=anchor.offset_ns,
        clock_set=anchor.clock_set,
        software=SOFTWARE_VERSION,
        scene=scene.name,
        models=scene.models,
    )
