"""Encoder of ROS 2 messages (CDR): wrench of a foot, pressure of each tile, drawing, markers.

`geometry_msgs/WrenchStamped` has the GRF along z of the foot frame and its moment about the origin,
from which the centre of pressure follows: x = -torque.y / force.z, y = torque.x / force.z.
`sensor_msgs/FluidPressure` is absolute pressure in Pa, at the instant when the tile was sampled.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from devices.chips.compensation import Compensation
from devices.flags import TileFlag
from devices.frames import NOT_READ
from storage.formats.export import Export
from storage.formats.writers.mcap.file import (
    ARROW_METRES_PER_NEWTON,
    TILE_HEIGHT_M,
    TILE_RADIUS_M,
    ChannelRegistry,
    FrameChunk,
    Message,
    MessageTemplate,
    compute_tile_colour,
    get_foot_frame_id,
)
from storage.formats.writers.resampling import POINT_COLUMNS, fill_cop_across_tile_row
from storage.schema import Array

_NS = 1_000_000_000
_STAMP = {"sec": ("<i4", 4), "nanosec": ("<u4", 8)}
"""Fields of a header's stamp, after four bytes that state the encoding."""
_READINGS = ("pressure_raw", "temperature_raw", "tile_flags", "sample_offset_us")
_FORCES = (*POINT_COLUMNS, "force_n")
_TEMPERATURE_HOLD_NS = _NS
"""Longest age of a chip's last temperature that is used for frames without one."""


def list_columns_to_read_for_ros2(export: Export) -> list[str]:
    """Return the quantities to read for ROS 2 messages."""
    return [*_READINGS, *(_FORCES if export.has_forces else ())]


def make_ros2_name(text: str) -> str:
    """Return a valid ROS 2 name: letters, digits and underscores, beginning with a letter."""
    name = re.sub(r"_+", "_", re.sub(r"[^0-9A-Za-z]", "_", text)).strip("_")
    return name if re.match(r"[A-Za-z]", name) else f"n_{name}".rstrip("_")


class Ros2Encoder:
    """Encoder of a session's ROS 2 messages; arguments as for `FoxgloveEncoder`."""

    def __init__(self, channels: ChannelRegistry, export: Export, topic_prefix: str) -> None:
        self._types = get_typestore(Stores.ROS2_HUMBLE)
        self._info, self._has_forces = export.array_info, export.has_forces
        self._compensation = Compensation(export.array_info.tiles)
        self._temperature_hold = _TemperatureHold(len(export.array_info.tiles))
        self._channels = channels
        self._schemas: dict[str, int] = {}
        self._frame = get_foot_frame_id(export.array_info)
        header = self._make_header(self._frame, 0)
        zero = self._make_message("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        wrench = self._make_message("geometry_msgs/msg/Wrench", zero, zero)
        stamped = self._encode_cdr(
            self._make_message("geometry_msgs/msg/WrenchStamped", header, wrench)
        )
        names = ("fx", "fy", "fz", "tx", "ty", "tz")
        places = range(len(stamped) - 48, len(stamped), 8)
        places_of = {name: ("<f8", at) for name, at in zip(names, places, strict=True)}
        self._wrench = MessageTemplate(stamped, _STAMP | places_of)
        self._pressures = []
        for tile in export.array_info.tiles:
            plain = self._make_message(
                "sensor_msgs/msg/FluidPressure", self._make_header(tile.serial, 0), 0.0, 0.0
            )
            content = self._encode_cdr(plain)
            self._pressures.append(
                MessageTemplate(content, _STAMP | {"pa": ("<f8", len(content) - 16)})
            )
        if self._has_forces:
            self._wrenches = self._register_topic(
                f"{topic_prefix}/wrench", "geometry_msgs/msg/WrenchStamped"
            )
        self._tiles = [
            self._register_topic(
                f"{topic_prefix}/tile_{i}/pressure", "sensor_msgs/msg/FluidPressure"
            )
            for i in range(len(export.array_info.tiles))
        ]
        self._drawings = self._register_topic(
            f"{topic_prefix}/foot", "visualization_msgs/msg/MarkerArray"
        )
        self._markers = self._register_topic(f"{topic_prefix}/markers", "std_msgs/msg/String")

    def encode_messages(self, frames: FrameChunk) -> Iterator[Message]:
        """Yield the encoded messages of a chunk of frames, in order."""
        t_ns = frames.t_ns.tolist()
        topics: list[tuple[int, list[bytes]]] = []
        if self._has_forces:
            frames = replace(frames, columns=fill_cop_across_tile_row(frames.columns, self._info))
            topics.append((self._wrenches, self._wrench.encode_messages(_wrench_columns(frames))))
        topics += zip(self._tiles, self._encode_pressures(frames), strict=True)
        beside: dict[int, list[Message]] = {}
        for row, text in frames.markers:
            content = self._encode_cdr(self._make_message("std_msgs/msg/String", text))
            beside.setdefault(row, []).append((t_ns[row], self._markers, content))
        for row, content in zip(frames.drawn_rows, self._encode_drawings(frames), strict=True):
            beside.setdefault(row, []).append((t_ns[row], self._drawings, content))
        for row, at_ns in enumerate(t_ns):
            for channel, contents in topics:
                yield at_ns, channel, contents[row]
            if row in beside:
                yield from beside[row]

    def _encode_pressures(self, frames: FrameChunk) -> Iterator[list[bytes]]:
        tiles = len(self._info.tiles)
        pressure_raw, temperature_raw, status, offset_us = (
            np.stack([frames.columns[f"{name}_{i}"] for i in range(tiles)], axis=1)
            for name in _READINGS
        )
        held = self._temperature_hold.hold_temperature(frames.t_ns, temperature_raw)
        unknown = (pressure_raw == NOT_READ) | np.isnan(held) | ((status & TileFlag.UNUSABLE) != 0)
        pa = np.where(unknown, np.nan, self._compensation.compute_kpa(pressure_raw, held) * 1e3)
        at_ns = frames.t_ns[:, None] + offset_us.astype(np.int64) * 1000
        for i, packed in enumerate(self._pressures):
            yield packed.encode_messages({**_split_stamps(at_ns[:, i]), "pa": pa[:, i]})

    def _encode_drawings(self, frames: FrameChunk) -> Iterator[bytes]:
        tiles, rows = self._info.tiles, frames.drawn_rows
        unknown = np.full((len(rows), len(tiles)), np.nan)
        forces_n = (
            frames.stack_tile_columns("force_n", len(tiles))[rows] if self._has_forces else unknown
        )
        for row, force_n in zip(rows, forces_n.tolist(), strict=True):
            at_ns = int(frames.t_ns[row])
            markers = [
                self._make_marker(
                    at_ns,
                    i,
                    3,  # a cylinder
                    (tile.x_m, tile.y_m, tile.z_m),
                    (2 * TILE_RADIUS_M, 2 * TILE_RADIUS_M, TILE_HEIGHT_M),
                    compute_tile_colour(of_tile_n),
                )
                for i, (tile, of_tile_n) in enumerate(zip(tiles, force_n, strict=True))
            ]
            if self._has_forces:
                markers.append(self._make_arrow(frames, row, at_ns))
            yield self._encode_cdr(
                self._make_message("visualization_msgs/msg/MarkerArray", markers)
            )

    def _make_arrow(self, frames: FrameChunk, row: int, at_ns: int) -> Any:
        grf_n, x_m, y_m = (float(frames.columns[name][row]) for name in _FORCES[:3])
        tiles = self._info.tiles
        if np.isnan(grf_n + x_m + y_m):
            return self._make_marker(at_ns, len(tiles), 0, (0, 0, 0), (0, 0, 0), (0, 0, 0, 0), 2)
        lowest_m = min(tile.z_m for tile in tiles)
        top_m = lowest_m + max(grf_n, 0.0) * ARROW_METRES_PER_NEWTON
        ends = [
            self._make_message("geometry_msgs/msg/Point", x_m, y_m, z_m)
            for z_m in (lowest_m, top_m)
        ]
        green = (0.1, 0.7, 0.3, 1.0)
        return self._make_marker(
            at_ns, len(tiles), 0, (0, 0, 0), (0.004, 0.01, 0.01), green, points=ends
        )

    def _make_marker(
        self,
        at_ns: int,
        number: int,
        kind: int,
        place: tuple[float, float, float],
        scale: tuple[float, float, float],
        shade: tuple[float, float, float, float],
        action: int = 0,
        points: list[Any] | None = None,
    ) -> Any:
        make = self._make_message
        place_ = make("geometry_msgs/msg/Point", *map(float, place))
        turn = make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        return make(
            "visualization_msgs/msg/Marker",
            header=self._make_header(self._frame, at_ns),
            ns="foot",
            id=number,
            type=kind,
            action=action,
            pose=make("geometry_msgs/msg/Pose", place_, turn),
            scale=make("geometry_msgs/msg/Vector3", *map(float, scale)),
            color=make("std_msgs/msg/ColorRGBA", *map(float, shade)),
            lifetime=make("builtin_interfaces/msg/Duration", 0, 0),
            frame_locked=False,
            points=points or [],
            colors=[],
            texture_resource="",
            texture=make(
                "sensor_msgs/msg/CompressedImage",
                self._make_header("", 0),
                "",
                np.empty(0, dtype=np.uint8),
            ),
            uv_coordinates=[],
            text="",
            mesh_resource="",
            mesh_file=make("visualization_msgs/msg/MeshFile", "", np.empty(0, dtype=np.uint8)),
            mesh_use_embedded_materials=False,
        )

    def _make_header(self, frame: str, at_ns: int) -> Any:
        stamp = self._make_message("builtin_interfaces/msg/Time", at_ns // _NS, at_ns % _NS)
        return self._make_message("std_msgs/msg/Header", stamp, frame)

    def _make_message(self, kind: str, *values: Any, **named: Any) -> Any:
        return self._types.types[kind](*values, **named)

    def _encode_cdr(self, message: Any) -> bytes:
        return bytes(self._types.serialize_cdr(message, message.__msgtype__))

    def _register_topic(self, topic: str, kind: str) -> int:
        if kind not in self._schemas:
            text, _ = self._types.generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._channels.register_schema(kind, "ros2msg", text.encode())
        qos = {"offered_qos_profiles": ""}
        return self._channels.register_channel(topic, "cdr", self._schemas[kind], qos)


class _TemperatureHold:
    """Zero-order hold of each tile's temperature counts, for frames that did not read any."""

    def __init__(self, tiles: int) -> None:
        self._counts = np.full(tiles, np.nan)
        self._at_ns = np.full(tiles, np.iinfo(np.int64).min // 2)

    def hold_temperature(self, t_ns: Array, temperature_raw: Array) -> Array:
        """Return the counts with gaps held, (n, tiles); NaN if none was read for a second."""
        n = len(t_ns)
        if not n:
            return np.empty(temperature_raw.shape)
        counts = np.vstack(
            [self._counts, np.where(temperature_raw == NOT_READ, np.nan, temperature_raw)]
        )
        at_ns = np.vstack([self._at_ns, np.repeat(t_ns[:, None], temperature_raw.shape[1], axis=1)])
        rows = np.where(np.isnan(counts), 0, np.arange(n + 1)[:, None])
        latest = np.maximum.accumulate(rows, axis=0)
        held = np.take_along_axis(counts, latest, axis=0)
        since_ns = np.take_along_axis(at_ns, latest, axis=0)
        self._counts, self._at_ns = held[-1], since_ns[-1]
        apart_ns = t_ns[:, None] - since_ns[1:]
        found: Array = np.where(
            (apart_ns >= 0) & (apart_ns <= _TEMPERATURE_HOLD_NS), held[1:], np.nan
        )
        return found


def _split_stamps(t_ns: Array) -> dict[str, Array]:
    return {"sec": t_ns // _NS, "nanosec": t_ns % _NS}


def _wrench_columns(frames: FrameChunk) -> dict[str, Array]:
    grf_n, x_m, y_m = (frames.columns[name].astype(np.float64) for name in _FORCES[:3])
    none = np.zeros(len(grf_n))
    return {
        **_split_stamps(frames.t_ns),
        **{"fx": none, "fy": none, "fz": grf_n, "tx": y_m * grf_n, "ty": -x_m * grf_n, "tz": none},
    }
