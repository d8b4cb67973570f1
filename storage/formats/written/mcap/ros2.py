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
from devices.frames import NOT_READ, TileStatus
from storage.formats.export import Export
from storage.formats.written.mcap.packed import Packed
from storage.formats.written.mcap.source import (
    METRES_PER_NEWTON,
    TILE_HEIGHT_M,
    TILE_RADIUS_M,
    Channels,
    Frames,
    Message,
    colour,
    frame_id,
)
from storage.formats.written.row_place import NEEDED as POINT
from storage.formats.written.row_place import with_row_place
from storage.schema import Array

_NS = 1_000_000_000
_STAMP = {"sec": ("<i4", 4), "nanosec": ("<u4", 8)}
"""Fields of a header's stamp, after four bytes that state the encoding."""
_READINGS = ("padc", "tadc", "status", "sample_offset_us")
_FORCES = (*POINT, "force_n")
_HELD_NS = _NS
"""Longest age of a chip's last temperature that is used for frames without one."""


def needed(export: Export) -> list[str]:
    """Return the columns to read."""
    return [*_READINGS, *(_FORCES if export.has_forces else ())]


def name_of(text: str) -> str:
    """Return a valid ROS 2 name: letters, digits and underscores, beginning with a letter."""
    name = re.sub(r"_+", "_", re.sub(r"[^0-9A-Za-z]", "_", text)).strip("_")
    return name if re.match(r"[A-Za-z]", name) else f"n_{name}".rstrip("_")


class Ros2Messages:
    """Encoder of a session's ROS 2 messages; arguments as for `FoxgloveMessages`."""

    def __init__(self, channels: Channels, export: Export, prefix: str) -> None:
        self._types = get_typestore(Stores.ROS2_HUMBLE)
        self._info, self._has_forces = export.info, export.has_forces
        self._compensation = Compensation(export.info.tiles)
        self._held = _Held(len(export.info.tiles))
        self._channels = channels
        self._schemas: dict[str, int] = {}
        self._frame = frame_id(export.info)
        header = self._header(self._frame, 0)
        zero = self._make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        wrench = self._make("geometry_msgs/msg/Wrench", zero, zero)
        stamped = self._cdr(self._make("geometry_msgs/msg/WrenchStamped", header, wrench))
        names = ("fx", "fy", "fz", "tx", "ty", "tz")
        places = range(len(stamped) - 48, len(stamped), 8)
        places_of = {name: ("<f8", at) for name, at in zip(names, places, strict=True)}
        self._wrench = Packed(stamped, _STAMP | places_of)
        self._pressures = []
        for tile in export.info.tiles:
            plain = self._make(
                "sensor_msgs/msg/FluidPressure", self._header(tile.serial, 0), 0.0, 0.0
            )
            content = self._cdr(plain)
            self._pressures.append(Packed(content, _STAMP | {"pa": ("<f8", len(content) - 16)}))
        if self._has_forces:
            self._wrenches = self._topic(f"{prefix}/wrench", "geometry_msgs/msg/WrenchStamped")
        self._tiles = [
            self._topic(f"{prefix}/tile_{i}/pressure", "sensor_msgs/msg/FluidPressure")
            for i in range(len(export.info.tiles))
        ]
        self._markers = self._topic(f"{prefix}/foot", "visualization_msgs/msg/MarkerArray")
        self._marks = self._topic(f"{prefix}/marks", "std_msgs/msg/String")

    def messages(self, frames: Frames) -> Iterator[Message]:
        """Yield the encoded messages of a chunk of frames, in order."""
        t_ns = frames.t_ns.tolist()
        topics: list[tuple[int, list[bytes]]] = []
        if self._has_forces:
            frames = replace(frames, flat=with_row_place(frames.flat, self._info))
            topics.append((self._wrenches, self._wrench.messages(_wrenches(frames))))
        topics += zip(self._tiles, self._of_tiles(frames), strict=True)
        beside: dict[int, list[Message]] = {}
        for row, text in frames.marks:
            content = self._cdr(self._make("std_msgs/msg/String", text))
            beside.setdefault(row, []).append((t_ns[row], self._marks, content))
        for row, content in zip(frames.shown, self._drawn(frames), strict=True):
            beside.setdefault(row, []).append((t_ns[row], self._markers, content))
        for row, at_ns in enumerate(t_ns):
            for channel, contents in topics:
                yield at_ns, channel, contents[row]
            if row in beside:
                yield from beside[row]

    def _of_tiles(self, frames: Frames) -> Iterator[list[bytes]]:
        tiles = len(self._info.tiles)
        padc, tadc, status, offset_us = (
            np.stack([frames.flat[f"{name}_{i}"] for i in range(tiles)], axis=1)
            for name in _READINGS
        )
        held = self._held.filled(frames.t_ns, tadc)
        unknown = (padc == NOT_READ) | np.isnan(held) | ((status & TileStatus.UNUSABLE) != 0)
        pa = np.where(unknown, np.nan, self._compensation.kpa(padc, held) * 1e3)
        at_ns = frames.t_ns[:, None] + offset_us.astype(np.int64) * 1000
        for i, packed in enumerate(self._pressures):
            yield packed.messages({**_stamps(at_ns[:, i]), "pa": pa[:, i]})

    def _drawn(self, frames: Frames) -> Iterator[bytes]:
        tiles, rows = self._info.tiles, frames.shown
        unknown = np.full((len(rows), len(tiles)), np.nan)
        forces_n = frames.tiles("force_n", len(tiles))[rows] if self._has_forces else unknown
        for row, force_n in zip(rows, forces_n.tolist(), strict=True):
            at_ns = int(frames.t_ns[row])
            markers = [
                self._marker(
                    at_ns,
                    i,
                    3,  # a cylinder
                    (tile.x_m, tile.y_m, tile.z_m),
                    (2 * TILE_RADIUS_M, 2 * TILE_RADIUS_M, TILE_HEIGHT_M),
                    colour(of_tile_n),
                )
                for i, (tile, of_tile_n) in enumerate(zip(tiles, force_n, strict=True))
            ]
            if self._has_forces:
                markers.append(self._arrow(frames, row, at_ns))
            yield self._cdr(self._make("visualization_msgs/msg/MarkerArray", markers))

    def _arrow(self, frames: Frames, row: int, at_ns: int) -> Any:
        grf_n, x_m, y_m = (float(frames.flat[name][row]) for name in _FORCES[:3])
        tiles = self._info.tiles
        if np.isnan(grf_n + x_m + y_m):
            return self._marker(at_ns, len(tiles), 0, (0, 0, 0), (0, 0, 0), (0, 0, 0, 0), 2)
        lowest_m = min(tile.z_m for tile in tiles)
        top_m = lowest_m + max(grf_n, 0.0) * METRES_PER_NEWTON
        ends = [self._make("geometry_msgs/msg/Point", x_m, y_m, z_m) for z_m in (lowest_m, top_m)]
        green = (0.1, 0.7, 0.3, 1.0)
        return self._marker(
            at_ns, len(tiles), 0, (0, 0, 0), (0.004, 0.01, 0.01), green, points=ends
        )

    def _marker(
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
        make = self._make
        place_ = make("geometry_msgs/msg/Point", *map(float, place))
        turn = make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        return make(
            "visualization_msgs/msg/Marker",
            header=self._header(self._frame, at_ns),
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
                self._header("", 0),
                "",
                np.empty(0, dtype=np.uint8),
            ),
            uv_coordinates=[],
            text="",
            mesh_resource="",
            mesh_file=make("visualization_msgs/msg/MeshFile", "", np.empty(0, dtype=np.uint8)),
            mesh_use_embedded_materials=False,
        )

    def _header(self, frame: str, at_ns: int) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", at_ns // _NS, at_ns % _NS)
        return self._make("std_msgs/msg/Header", stamp, frame)

    def _make(self, kind: str, *values: Any, **named: Any) -> Any:
        return self._types.types[kind](*values, **named)

    def _cdr(self, message: Any) -> bytes:
        return bytes(self._types.serialize_cdr(message, message.__msgtype__))

    def _topic(self, topic: str, kind: str) -> int:
        if kind not in self._schemas:
            text, _ = self._types.generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._channels.register_schema(kind, "ros2msg", text.encode())
        qos = {"offered_qos_profiles": ""}
        return self._channels.register_channel(topic, "cdr", self._schemas[kind], qos)


class _Held:
    """Zero-order hold of each tile's temperature counts, for frames that did not read any."""

    def __init__(self, tiles: int) -> None:
        self._counts = np.full(tiles, np.nan)
        self._at_ns = np.full(tiles, np.iinfo(np.int64).min // 2)

    def filled(self, t_ns: Array, tadc: Array) -> Array:
        """Return the counts with gaps held, (n, tiles); NaN if none was read for a second."""
        n = len(t_ns)
        if not n:
            return np.empty(tadc.shape)
        counts = np.vstack([self._counts, np.where(tadc == NOT_READ, np.nan, tadc)])
        at_ns = np.vstack([self._at_ns, np.repeat(t_ns[:, None], tadc.shape[1], axis=1)])
        rows = np.where(np.isnan(counts), 0, np.arange(n + 1)[:, None])
        latest = np.maximum.accumulate(rows, axis=0)
        held = np.take_along_axis(counts, latest, axis=0)
        since_ns = np.take_along_axis(at_ns, latest, axis=0)
        self._counts, self._at_ns = held[-1], since_ns[-1]
        apart_ns = t_ns[:, None] - since_ns[1:]
        found: Array = np.where((apart_ns >= 0) & (apart_ns <= _HELD_NS), held[1:], np.nan)
        return found


def _stamps(t_ns: Array) -> dict[str, Array]:
    return {"sec": t_ns // _NS, "nanosec": t_ns % _NS}


def _wrenches(frames: Frames) -> dict[str, Array]:
    grf_n, x_m, y_m = (frames.flat[name].astype(np.float64) for name in _FORCES[:3])
    none = np.zeros(len(grf_n))
    return {
        **_stamps(frames.t_ns),
        **{"fx": none, "fy": none, "fz": grf_n, "tx": y_m * grf_n, "ty": -x_m * grf_n, "tz": none},
    }
