"""Encoder of Foxglove messages (Protobuf): frames with all columns, the foot, markers as log.

A frame is a `foottile.Frame`, whose fields are the columns. Its numbers have fixed widths, so that
all messages of a session have one length. The foot is a `foxglove.SceneUpdate`, a marker a
`foxglove.Log` (https://docs.foxglove.dev/docs/visualization/message-schemas).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pyarrow as pa
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.schema import build_file_descriptor_set

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
    to_floats_with_nan,
)
from storage.formats.writers.resampling import POINT_COLUMNS, fill_cop_across_tile_row
from storage.schema import COLUMNS_BY_NAME, Array, Column

_NS = 1_000_000_000
_SCENE_COLUMNS = (*POINT_COLUMNS, "force_n")

# Protobuf's types of fixed width: their number, wire type (of 32 or 64 bits), and numpy's name.
_FLOAT = FieldDescriptorProto.TYPE_FLOAT, 5, "<f4"
_DOUBLE = FieldDescriptorProto.TYPE_DOUBLE, 1, "<f8"
_FIXED32 = FieldDescriptorProto.TYPE_FIXED32, 5, "<u4"
_FIXED64 = FieldDescriptorProto.TYPE_FIXED64, 1, "<u8"
_SFIXED32 = FieldDescriptorProto.TYPE_SFIXED32, 5, "<i4"
_SFIXED64 = FieldDescriptorProto.TYPE_SFIXED64, 1, "<i8"


def list_foxglove_frame_columns(export: Export) -> list[str]:
    """Return the flat columns of a frame message: selected numbers, `time_s` only if named."""
    return [
        name
        for name, of in export.map_columns_to_quantities().items()
        if pa.types.is_integer(COLUMNS_BY_NAME[of].type)
        or pa.types.is_floating(COLUMNS_BY_NAME[of].type)
        if name != "time_s" or "time_s" in export.selection.columns
    ]


def list_columns_to_read_for_foxglove(export: Export) -> list[str]:
    """Return the flat columns to read for Foxglove messages."""
    drawn = [name for name in _SCENE_COLUMNS if export.has_forces]
    return [*list_foxglove_frame_columns(export), *drawn]


class FoxgloveEncoder:
    """Encoder of a session's Foxglove messages.

    Args:
        channels: registry of schemas and channels.
        export: export of the session.
        topic_prefix: prefix of its topics.
    """

    def __init__(self, channels: ChannelRegistry, export: Export, topic_prefix: str) -> None:
        self._info, self._has_forces = export.array_info, export.has_forces
        chosen = export.map_columns_to_quantities()
        self._columns = {
            name: COLUMNS_BY_NAME[chosen[name]] for name in list_foxglove_frame_columns(export)
        }
        self._frame_template = _make_frame_template(
            list(self._columns.values()), list(self._columns)
        )
        descriptors = _frame_descriptors(self._columns)
        frame = channels.register_schema(
            "foottile.Frame", "protobuf", descriptors.SerializeToString()
        )
        self._frames = channels.register_channel(f"{topic_prefix}/frames", "protobuf", frame, {})
        self._markers = _register_channel(channels, f"{topic_prefix}/markers", Log)
        self._scene = _register_channel(channels, f"{topic_prefix}/foot", SceneUpdate)

    def encode_messages(self, frames: FrameChunk) -> Iterator[Message]:
        """Yield the encoded messages of a chunk of frames, in order."""
        packed = self._frame_template.encode_messages(
            {name: _to_field_values(c, frames.columns[name]) for name, c in self._columns.items()}
        )
        beside: dict[int, list[Message]] = {}
        t_ns = frames.t_ns.tolist()
        for row, text in frames.markers:
            marker = Log(
                timestamp=_timestamp(t_ns[row]), level=Log.INFO, message=text, name=self._info.node
            )
            beside.setdefault(row, []).append(
                (t_ns[row], self._markers, marker.SerializeToString())
            )
        for row, content in zip(frames.drawn_rows, self._encode_scenes(frames), strict=True):
            beside.setdefault(row, []).append((t_ns[row], self._scene, content))
        channel = self._frames
        for row, (at_ns, content) in enumerate(zip(t_ns, packed, strict=True)):
            yield at_ns, channel, content
            if row in beside:
                yield from beside[row]

    def _encode_scenes(self, frames: FrameChunk) -> Iterator[bytes]:
        tiles = self._info.tiles
        rows = frames.drawn_rows
        if self._has_forces:
            frames = replace(frames, columns=fill_cop_across_tile_row(frames.columns, self._info))
        unknown = np.full((len(rows), len(tiles)), np.nan)
        forces_n = (
            frames.stack_tile_columns("force_n", len(tiles))[rows] if self._has_forces else unknown
        )
        for row, force_n in zip(rows, forces_n.tolist(), strict=True):
            update = SceneUpdate()
            entity = update.entities.add(id="foot", frame_id=get_foot_frame_id(self._info))
            entity.timestamp.CopyFrom(_timestamp(int(frames.t_ns[row])))
            for tile, of_tile_n in zip(tiles, force_n, strict=True):
                drawn = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
                place = drawn.pose.position
                place.x, place.y, place.z = tile.x_m, tile.y_m, tile.z_m
                drawn.pose.orientation.w = 1.0
                drawn.size.x = drawn.size.y = 2.0 * TILE_RADIUS_M
                drawn.size.z = TILE_HEIGHT_M
                shade = drawn.color
                shade.r, shade.g, shade.b, shade.a = compute_tile_colour(of_tile_n)
            if self._has_forces:
                self._add_arrow(entity, frames, row)
            yield update.SerializeToString()

    def _add_arrow(self, entity: object, frames: FrameChunk, row: int) -> None:
        grf_n, x_m, y_m = (float(frames.columns[name][row]) for name in _SCENE_COLUMNS[:3])
        if np.isnan(grf_n) or np.isnan(x_m) or np.isnan(y_m):
            return
        lowest_m = min(tile.z_m for tile in self._info.tiles)
        arrow = entity.arrows.add(  # type: ignore[attr-defined]  # made at run time
            shaft_length=max(grf_n, 0.0) * ARROW_METRES_PER_NEWTON,
            shaft_diameter=0.004,
            head_length=0.01,
            head_diameter=0.01,
        )
        place, turn, shade = arrow.pose.position, arrow.pose.orientation, arrow.color
        place.x, place.y, place.z = x_m, y_m, lowest_m
        # Arrows point along x: rotate by -90 degrees about y to point upwards.
        turn.y, turn.w = -np.sqrt(0.5), np.sqrt(0.5)
        shade.r, shade.g, shade.b, shade.a = 0.1, 0.7, 0.3, 1.0


def _register_channel(
    channels: ChannelRegistry, topic: str, kind: type[Log] | type[SceneUpdate]
) -> int:
    schema = channels.register_schema(
        kind.DESCRIPTOR.full_name, "protobuf", build_file_descriptor_set(kind).SerializeToString()
    )
    return channels.register_channel(topic, "protobuf", schema, {})


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


def _to_field_values(column: Column, values: Array) -> Array:
    is_real = np.dtype(_field_type(column)[2]).kind == "f"
    return to_floats_with_nan(column.name, values) if is_real else values


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


def _make_frame_template(columns: list[Column], names: list[str]) -> MessageTemplate:
    """Return the template of a message with key and value of each field.

    Encoding: protobuf.dev/programming-guides/encoding. Zeros are written too; readers accept them.
    """
    template = bytearray()
    fields: dict[str, tuple[str, int]] = {}
    for number, (name, column) in enumerate(zip(names, columns, strict=True), start=1):
        _, wire, type_ = _field_type(column)
        key = number << 3 | wire
        while key >= 0x80:
            template.append(key & 0x7F | 0x80)
            key >>= 7
        template.append(key)
        fields[name] = type_, len(template)
        template += bytes(8 if wire == 1 else 4)
    return MessageTemplate(bytes(template), fields)
