"""Encoders of MCAP messages: Foxglove's (Protobuf) and ROS 2's (CDR).

Messages of equal length are copies of a template, which the format's library encodes; only numbers
are replaced in them.

Foxglove: a frame is a `foottile.Frame`, whose fields are the columns. Its numbers have fixed
widths, so that all messages of a session have one length. The foot is a `foxglove.SceneUpdate`, a
marker a `foxglove.Log` (https://docs.foxglove.dev/docs/visualization/message-schemas).

ROS 2: `geometry_msgs/WrenchStamped` has the GRF along z of the foot frame and its moment about the
origin, from which the centre of pressure follows: x = -torque.y / force.z, y = torque.x / force.z.
`sensor_msgs/FluidPressure` is absolute pressure in Pa, at the instant when the tile was sampled.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.typesys import Stores, get_typestore

from devices.chips.pressure_chips import Compensation
from devices.flags import TileFlag
from devices.frames import NOT_READ
from storage.formats.export import Export
from storage.formats.writers.format import to_floats_with_nan
from storage.formats.writers.mcap import (
    ARROW_METRES_PER_NEWTON,
    SATURATED_COLOUR_N,
    FrameChunk,
    MessageTemplate,
)
from storage.formats.writers.resampling import POINT_COLUMNS, fill_cop_across_tile_row
from storage.schema import COLUMNS_BY_NAME, Array, Column

_Colour = tuple[float, float, float, float]
Message = tuple[int, int, bytes]
"""Message: instant in ns, number of the channel, content."""
TILE_RADIUS_M, TILE_HEIGHT_M = 0.008, 0.006
SHAFT_DIAMETER_M, HEAD_DIAMETER_M = 0.004, 0.01
"""Size of the arrow of the GRF."""
_ARROW_COLOUR = (0.1, 0.7, 0.3, 1.0)
_NS = 1_000_000_000
_FORCES = (*POINT_COLUMNS, "force_n")

# Protobuf's types of fixed width: their number, wire type (of 32 or 64 bits), and numpy's name.
_FLOAT = FieldDescriptorProto.TYPE_FLOAT, 5, "<f4"
_DOUBLE = FieldDescriptorProto.TYPE_DOUBLE, 1, "<f8"
_FIXED32 = FieldDescriptorProto.TYPE_FIXED32, 5, "<u4"
_FIXED64 = FieldDescriptorProto.TYPE_FIXED64, 1, "<u8"
_SFIXED32 = FieldDescriptorProto.TYPE_SFIXED32, 5, "<i4"
_SFIXED64 = FieldDescriptorProto.TYPE_SFIXED64, 1, "<i8"

_STAMP = {"sec": ("<i4", 4), "nanosec": ("<u4", 8)}
"""Fields of a ROS header's stamp, after four bytes that state the encoding."""
_READINGS = ("pressure_raw", "temperature_raw", "tile_flags", "sample_offset_us")
_TEMPERATURE_HOLD_NS = _NS
"""Longest age of a chip's last temperature that is used for frames without one."""


class Arrow(NamedTuple):
    """GRF as an arrow: its lower end in the foot frame, and its length, all in m."""

    x_m: float
    y_m: float
    z_m: float
    length_m: float


class MessageEncoder(ABC):
    """Encoder of a session's messages.

    Args:
        channels: writer that registers schemas and channels.
        export: export of the session.
        topic_prefix: prefix of its topics.
    """

    _drawing_channel: int
    _marker_channel: int

    def __init__(self, channels: Writer, export: Export, topic_prefix: str) -> None:
        self._channels, self._topic_prefix = channels, topic_prefix
        self._info, self._has_forces = export.array_info, export.has_forces
        self._frame_id = f"{export.array_info.node}_foot"

    @staticmethod
    @abstractmethod
    def list_columns_to_read(export: Export) -> list[str]:
        """Return the flat columns or quantities to read."""

    def encode_messages(self, frames: FrameChunk) -> Iterator[Message]:
        """Yield the encoded messages of a chunk of frames, in order."""
        placed = frames
        if self._has_forces:
            placed = replace(frames, columns=fill_cop_across_tile_row(frames.columns, self._info))
        t_ns = frames.t_ns.tolist()
        topics = list(self._encode_frames(frames, placed))
        beside: dict[int, list[Message]] = {}
        for row, text in frames.markers:
            beside.setdefault(row, []).append(self.encode_marker(t_ns[row], text))
        forces_n = np.full((len(t_ns), len(self._info.tiles)), np.nan)
        if self._has_forces:
            forces_n = frames.stack_tile_columns("force_n", len(self._info.tiles))
        for row in frames.drawn_rows:
            colours = [_compute_tile_colour(force_n) for force_n in forces_n[row].tolist()]
            content = self._encode_drawing(t_ns[row], colours, self._make_arrow(placed, row))
            beside.setdefault(row, []).append((t_ns[row], self._drawing_channel, content))
        for row, at_ns in enumerate(t_ns):
            for channel, contents in topics:
                yield at_ns, channel, contents[row]
            if row in beside:
                yield from beside[row]

    def encode_marker(self, at_ns: int, text: str) -> Message:
        """Return the encoded message of a marker."""
        return at_ns, self._marker_channel, self._encode_marker(at_ns, text)

    @abstractmethod
    def _encode_frames(
        self, frames: FrameChunk, placed: FrameChunk
    ) -> Iterator[tuple[int, list[bytes]]]:
        """Yield each channel with a message for every frame; `placed` has the COP across a row."""

    @abstractmethod
    def _encode_marker(self, at_ns: int, text: str) -> bytes: ...

    @abstractmethod
    def _encode_drawing(
        self, at_ns: int, colours: Sequence[_Colour], arrow: Arrow | None
    ) -> bytes: ...

    def _make_arrow(self, frames: FrameChunk, row: int) -> Arrow | None:
        """Return the arrow of the GRF; None if force or place are unknown."""
        if not self._has_forces:
            return None
        grf_n, x_m, y_m = (float(frames.columns[name][row]) for name in _FORCES[:3])
        if np.isnan(grf_n + x_m + y_m):
            return None
        lowest_m = min(tile.z_m for tile in self._info.tiles)
        return Arrow(x_m, y_m, lowest_m, max(grf_n, 0.0) * ARROW_METRES_PER_NEWTON)


def _compute_tile_colour(force_n: float) -> _Colour:
    """Return the colour of a tile: red, green, blue, opacity; grey for an unknown force."""
    if np.isnan(force_n):
        return 0.5, 0.5, 0.5, 0.5
    share = min(max(force_n / SATURATED_COLOUR_N, 0.0), 1.0)
    return 0.2 + 0.8 * share, 0.4 + 0.3 * share, 0.9 - 0.8 * share, 1.0


class FoxgloveEncoder(MessageEncoder):
    """Encoder of Foxglove messages: frames with all columns, the foot, markers as log."""

    def __init__(self, channels: Writer, export: Export, topic_prefix: str) -> None:
        super().__init__(channels, export, topic_prefix)
        chosen = export.map_columns_to_quantities()
        self._columns = {
            name: COLUMNS_BY_NAME[chosen[name]] for name in _list_foxglove_columns(export)
        }
        self._real_columns = {
            name
            for name, column in self._columns.items()
            if np.dtype(_field_type(column)[2]).kind == "f"
        }
        self._frame_template = _make_frame_template(self._columns)
        descriptors = _frame_descriptors(self._columns)
        self._frames = self._register_topic("frames", "foottile.Frame", descriptors)
        self._marker_channel = self._register_topic(
            "markers", Log.DESCRIPTOR.full_name, build_file_descriptor_set(Log)
        )
        self._drawing_channel = self._register_topic(
            "foot", SceneUpdate.DESCRIPTOR.full_name, build_file_descriptor_set(SceneUpdate)
        )

    @staticmethod
    def list_columns_to_read(export: Export) -> list[str]:
        """Return the flat columns to read."""
        return [*_list_foxglove_columns(export), *(_FORCES if export.has_forces else ())]

    def _encode_frames(
        self, frames: FrameChunk, placed: FrameChunk
    ) -> Iterator[tuple[int, list[bytes]]]:
        columns = {
            name: to_floats_with_nan(of.name, frames.columns[name])
            if name in self._real_columns
            else frames.columns[name]
            for name, of in self._columns.items()
        }
        yield self._frames, self._frame_template.encode_messages(columns)

    def _encode_marker(self, at_ns: int, text: str) -> bytes:
        log = Log(timestamp=_timestamp(at_ns), level=Log.INFO, message=text, name=self._info.node)
        return bytes(log.SerializeToString())

    def _encode_drawing(self, at_ns: int, colours: Sequence[_Colour], arrow: Arrow | None) -> bytes:
        update = SceneUpdate()
        entity = update.entities.add(id="foot", frame_id=self._frame_id)
        entity.timestamp.CopyFrom(_timestamp(at_ns))
        for tile, colour in zip(self._info.tiles, colours, strict=True):
            drawn = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
            place, shade = drawn.pose.position, drawn.color
            place.x, place.y, place.z = tile.x_m, tile.y_m, tile.z_m
            drawn.pose.orientation.w = 1.0
            drawn.size.x = drawn.size.y = 2.0 * TILE_RADIUS_M
            drawn.size.z = TILE_HEIGHT_M
            shade.r, shade.g, shade.b, shade.a = colour
        if arrow is not None:
            shaft = entity.arrows.add(
                shaft_length=arrow.length_m,
                shaft_diameter=SHAFT_DIAMETER_M,
                head_length=HEAD_DIAMETER_M,
                head_diameter=HEAD_DIAMETER_M,
            )
            place, turn, shade = shaft.pose.position, shaft.pose.orientation, shaft.color
            place.x, place.y, place.z = arrow.x_m, arrow.y_m, arrow.z_m
            # Arrows point along x: rotate by -90 degrees about y to point upwards.
            turn.y, turn.w = -np.sqrt(0.5), np.sqrt(0.5)
            shade.r, shade.g, shade.b, shade.a = _ARROW_COLOUR
        return bytes(update.SerializeToString())

    def _register_topic(self, topic: str, kind: str, descriptors: FileDescriptorSet) -> int:
        schema = self._channels.register_schema(kind, "protobuf", descriptors.SerializeToString())
        return self._channels.register_channel(
            f"{self._topic_prefix}/{topic}", "protobuf", schema, {}
        )


def _list_foxglove_columns(export: Export) -> list[str]:
    """Return the flat columns of a frame message: selected numbers, `time_s` only if named."""
    return [
        name
        for name, of in export.map_columns_to_quantities().items()
        if pa.types.is_integer(COLUMNS_BY_NAME[of].type)
        or pa.types.is_floating(COLUMNS_BY_NAME[of].type)
        if name != "time_s" or "time_s" in export.selection.columns
    ]


def _timestamp(t_ns: int) -> Timestamp:
    return Timestamp(seconds=t_ns // _NS, nanos=t_ns % _NS)


def _field_type(column: Column) -> tuple[int, int, str]:
    """Return the type of a column's field; a float if unknown values need NaN."""
    kind = column.type
    if pa.types.is_floating(kind):
        return _DOUBLE if kind.bit_width == 64 else _FLOAT
    if column.missing_value is not None and kind.bit_width < 64:
        return _FLOAT if kind.bit_width <= 16 else _DOUBLE
    if pa.types.is_signed_integer(kind):
        return _SFIXED64 if kind.bit_width == 64 else _SFIXED32
    return _FIXED64 if kind.bit_width == 64 else _FIXED32


def _frame_descriptors(columns: dict[str, Column]) -> FileDescriptorSet:
    found = FileDescriptorSet()
    file = found.file.add(name="foottile/Frame.proto", package="foottile", syntax="proto3")
    message = file.message_type.add(name="Frame")
    for number, (name, column) in enumerate(columns.items(), start=1):
        message.field.add(
            name=name,
            number=number,
            type=_field_type(column)[0],
            label=FieldDescriptorProto.LABEL_OPTIONAL,
        )
    return found


def _make_frame_template(columns: dict[str, Column]) -> MessageTemplate:
    """Return the template of a message with key and value of each field.

    Encoding: protobuf.dev/programming-guides/encoding. Zeros are written too; readers accept them.
    """
    template = bytearray()
    fields: dict[str, tuple[str, int]] = {}
    for number, (name, column) in enumerate(columns.items(), start=1):
        _, wire, type_ = _field_type(column)
        key = number << 3 | wire
        while key >= 0x80:
            template.append(key & 0x7F | 0x80)
            key >>= 7
        template.append(key)
        fields[name] = type_, len(template)
        template += bytes(8 if wire == 1 else 4)
    return MessageTemplate(bytes(template), fields)


def make_ros2_name(text: str) -> str:
    """Return a valid ROS 2 name: letters, digits and underscores, beginning with a letter."""
    name = re.sub(r"_+", "_", re.sub(r"[^0-9A-Za-z]", "_", text)).strip("_")
    return name if re.match(r"[A-Za-z]", name) else f"n_{name}".rstrip("_")


class Ros2Encoder(MessageEncoder):
    """Encoder of ROS 2 messages: wrench of a foot, pressure of each tile, drawing, markers."""

    def __init__(self, channels: Writer, export: Export, topic_prefix: str) -> None:
        super().__init__(channels, export, topic_prefix)
        tiles = export.array_info.tiles
        self._types = get_typestore(Stores.ROS2_HUMBLE)
        self._compensation = Compensation(tiles)
        self._temperature_hold = _TemperatureHold(len(tiles))
        self._schemas: dict[str, int] = {}
        zero = self._make_message("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        wrench = self._encode_message(
            "geometry_msgs/msg/WrenchStamped",
            self._make_header(self._frame_id, 0),
            self._make_message("geometry_msgs/msg/Wrench", zero, zero),
        )
        names = ("fx", "fy", "fz", "tx", "ty", "tz")
        places = range(len(wrench) - 48, len(wrench), 8)
        fields = {name: ("<f8", at) for name, at in zip(names, places, strict=True)}
        self._wrench = MessageTemplate(wrench, _STAMP | fields)
        self._pressures = []
        for tile in tiles:
            header = self._make_header(tile.serial, 0)
            content = self._encode_message("sensor_msgs/msg/FluidPressure", header, 0.0, 0.0)
            place = {"pa": ("<f8", len(content) - 16)}
            self._pressures.append(MessageTemplate(content, _STAMP | place))
        if self._has_forces:
            self._wrench_channel = self._register_topic("wrench", "geometry_msgs/msg/WrenchStamped")
        self._pressure_channels = [
            self._register_topic(f"tile_{i}/pressure", "sensor_msgs/msg/FluidPressure")
            for i in range(len(tiles))
        ]
        self._drawing_channel = self._register_topic("foot", "visualization_msgs/msg/MarkerArray")
        self._marker_channel = self._register_topic("markers", "std_msgs/msg/String")

    @staticmethod
    def list_columns_to_read(export: Export) -> list[str]:
        """Return the quantities to read."""
        return [*_READINGS, *(_FORCES if export.has_forces else ())]

    def _encode_frames(
        self, frames: FrameChunk, placed: FrameChunk
    ) -> Iterator[tuple[int, list[bytes]]]:
        if self._has_forces:
            yield self._wrench_channel, self._wrench.encode_messages(_wrench_columns(placed))
        tiles = len(self._info.tiles)
        pressure_raw, temperature_raw, status, offset_us = (
            np.stack([frames.columns[f"{name}_{i}"] for i in range(tiles)], axis=1)
            for name in _READINGS
        )
        held = self._temperature_hold.hold_temperature(frames.t_ns, temperature_raw)
        unknown = (pressure_raw == NOT_READ) | np.isnan(held) | ((status & TileFlag.UNUSABLE) != 0)
        pa = np.where(unknown, np.nan, self._compensation.law.compute_kpa(pressure_raw, held) * 1e3)
        at_ns = frames.t_ns[:, None] + offset_us.astype(np.int64) * 1000
        for i, (channel, packed) in enumerate(
            zip(self._pressure_channels, self._pressures, strict=True)
        ):
            columns = {**_split_stamps(at_ns[:, i]), "pa": pa[:, i]}
            yield channel, packed.encode_messages(columns)

    def _encode_marker(self, at_ns: int, text: str) -> bytes:
        return self._encode_message("std_msgs/msg/String", text)

    def _encode_drawing(self, at_ns: int, colours: Sequence[_Colour], arrow: Arrow | None) -> bytes:
        size = (2 * TILE_RADIUS_M, 2 * TILE_RADIUS_M, TILE_HEIGHT_M)
        cylinder, arrow_kind, remove = 3, 0, 2
        markers = [
            self._make_marker(at_ns, i, cylinder, (tile.x_m, tile.y_m, tile.z_m), size, colour)
            for i, (tile, colour) in enumerate(zip(self._info.tiles, colours, strict=True))
        ]
        number, origin = len(markers), (0, 0, 0)
        if arrow is not None:
            ends = [
                self._make_message("geometry_msgs/msg/Point", arrow.x_m, arrow.y_m, z_m)
                for z_m in (arrow.z_m, arrow.z_m + arrow.length_m)
            ]
            size = (SHAFT_DIAMETER_M, HEAD_DIAMETER_M, HEAD_DIAMETER_M)
            markers.append(
                self._make_marker(
                    at_ns, number, arrow_kind, origin, size, _ARROW_COLOUR, points=ends
                )
            )
        elif self._has_forces:
            gone = self._make_marker(
                at_ns, number, arrow_kind, origin, (0, 0, 0), (0, 0, 0, 0), remove
            )
            markers.append(gone)
        return self._encode_message("visualization_msgs/msg/MarkerArray", markers)

    def _make_marker(
        self,
        at_ns: int,
        number: int,
        kind: int,
        place: tuple[float, float, float],
        scale: tuple[float, float, float],
        shade: _Colour,
        action: int = 0,
        points: list[Any] | None = None,
    ) -> Any:
        make = self._make_message
        place_ = make("geometry_msgs/msg/Point", *map(float, place))
        turn = make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        return make(
            "visualization_msgs/msg/Marker",
            header=self._make_header(self._frame_id, at_ns),
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

    def _encode_message(self, kind: str, *values: Any) -> bytes:
        return bytes(self._types.serialize_cdr(self._make_message(kind, *values), kind))

    def _register_topic(self, topic: str, kind: str) -> int:
        if kind not in self._schemas:
            text, _ = self._types.generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._channels.register_schema(kind, "ros2msg", text.encode())
        qos = {"offered_qos_profiles": ""}
        return self._channels.register_channel(
            f"{self._topic_prefix}/{topic}", "cdr", self._schemas[kind], qos
        )


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
