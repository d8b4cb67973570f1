"""Reader of ROS bags and MCAP: `geometry_msgs/WrenchStamped` of force sensors, ROS 1 and ROS 2.

ROS uses N, N m and m (REP 103). Each topic is a sensor: `/left/wrench` becomes `left_wrench_fx`,
`_fy`, `_fz`, along the axes of its frame, and `_cop_x`, `_cop_y`, in the plane z = 0 of its frame:
x = -torque.y / force.z, y = torque.x / force.z. A bag does not state the distance of the ground
from this plane, so a centre of pressure is read only if the user maps it. Times are the headers'
stamps, sorted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError, FootTileError, require_extra
from devices.input_files import check_regular_file
from storage.formats.readers.force_plate import compute_cop_from_moments
from storage.formats.readers.table import (
    ColumnFilter,
    ForceTable,
    PlateSignals,
    check_table_size,
    make_repeated_name_error,
    make_table_of_separate_plates,
)

FORM = "a ROS bag or an MCAP file with topics of geometry_msgs/WrenchStamped"
WRENCH = "geometry_msgs/msg/WrenchStamped"
WRENCHES = (WRENCH, "geometry_msgs/WrenchStamped")
YEAR_2000_NS = 946_684_800_000_000_000
"""Year 2000; earlier stamps are from a simulation or from a clock that was never set."""
_COLUMNS = ("fz", "fx", "fy", "cop_x", "cop_y")
_METADATA_NAME = "metadata.yaml"
_MCAP_MAGIC = b"\x89MCAP0\r\n"
"""Begin and end of an MCAP file."""
_Message = tuple[str, int, Any]
"""Topic, time of recording in ns, and the decoded message."""


@dataclass(frozen=True)
class _Bag:
    """Topics of wrenches in a bag, and a function that reads the messages of given topics."""

    topics: list[str]
    read_messages: Callable[[list[str]], Iterator[_Message]]


def is_bag_folder(path: Path) -> bool:
    """Return whether a path is the folder of a ROS 2 bag; a cut-off one lacks `metadata.yaml`."""
    try:
        return any(
            file.name == _METADATA_NAME or file.suffix in (".mcap", ".db3")
            for file in path.iterdir()
        )
    except OSError:  # no folder, or its name is too long
        return False


def is_cut_off_bag1(path: Path) -> bool:
    """Return whether a path is the file in which ROS 1 records, left behind without an index."""
    return path.name.lower().endswith(".bag.active")


@require_extra("mcap", "To read ROS bags and MCAP")
def read_bag_wrenches(path: Path, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Read all columns of each topic with a needed column, or of a bag's only topic of wrenches.

    Raises:
        FileFormatError: unreadable, no wrenches, or two needed topics differ in their times.
    """
    try:
        for file in path.iterdir() if path.is_dir() else (path,):
            if not file.is_dir():
                check_regular_file(file)  # the libraries would block on a pipe or a device
        _check_end(path)
        bag = _open_mcap(path) if path.suffix.lower() == ".mcap" else _open_rosbag(path)
        return _make_table(bag, is_needed, values_max)
    except (FootTileError, ModuleNotFoundError, MemoryError):
        raise
    except Exception as error:  # libraries raise whatever damaged bytes lead to
        kind = type(error).__name__
        raise FileFormatError(f"cannot be read: {str(error)[:200] or kind}") from error


def _check_end(path: Path) -> None:
    """Refuse a recording that was cut off, before the libraries complain of its content.

    Raises:
        FileFormatError: it was cut off; with the tool that repairs it.
        OSError: it cannot be read.
    """
    tool = ""
    if path.is_dir():
        if not (path / _METADATA_NAME).exists():
            tool = f"ros2 bag reindex {path}"
    elif path.suffix.lower() == ".mcap":
        with path.open("rb") as file:
            is_mcap = file.read(len(_MCAP_MAGIC)) == _MCAP_MAGIC
            file.seek(max(0, path.stat().st_size - len(_MCAP_MAGIC)))
            if is_mcap and file.read() != _MCAP_MAGIC:
                tool = f"mcap recover {path} -o repaired.mcap"
    elif is_cut_off_bag1(path) or (path.suffix.lower() == ".bag" and _lacks_index(path)):
        tool = f"rosbag reindex {path}"
    if tool:
        raise FileFormatError(
            "its recording was cut off: its end is missing", remedy=f"Repair it: `{tool}`"
        )


def _lacks_index(path: Path) -> bool:
    """Return whether a bag of ROS 1 has no index, or ends before it."""
    with path.open("rb") as file:
        head = file.read(4096)
    _, found, rest = head.partition(b"index_pos=")
    position = int.from_bytes(rest[:8], "little")
    return bool(found) and not 0 < position < path.stat().st_size


def _make_table(bag: _Bag, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    names = {topic: topic.strip("/").replace("/", "_") for topic in bag.topics}
    if not names:
        raise FileFormatError("there is no wrench in it")
    if twice := sorted({name for name in names.values() if list(names.values()).count(name) > 1}):
        raise make_repeated_name_error(twice)
    needed = [
        topic
        for topic, name in names.items()
        if len(names) == 1 or any(is_needed(f"{name}_{column}") for column in _COLUMNS)
    ]
    found = _read_wrenches(bag, needed, values_max)
    plates: list[PlateSignals] = []
    time_s, begin_ns = np.empty(0), 0
    forces: dict[str, Floats] = {}
    notes = []
    for topic, sensor in found.items():
        name = names[topic]
        if plates and not np.array_equal(sensor.t_ns, found[needed[0]].t_ns):
            raise FileFormatError(
                f"topics {needed[0]} and {topic} have stamps of their own",
                expected="the same stamps, to add sensors up",
                remedy="Compare each sensor alone",
            )
        begin_ns = int(sensor.t_ns[0])
        time_s = (sensor.t_ns - begin_ns) * 1e-9
        force, torque = sensor.wrench[:3], sensor.wrench[3:]
        cop = compute_cop_from_moments(force[2], torque[0], torque[1])
        plates.append(PlateSignals(name, force[2], cop, "N", "m", notes=sensor.notes))
        forces |= {f"{name}_fx": force[0], f"{name}_fy": force[1]}
    if len(names) > 1:
        notes.append(f"topics of wrenches are {', '.join(names)}: --map says which one")
    table = make_table_of_separate_plates(time_s, plates, notes)
    columns = {
        name: column
        for name, column in {**table.columns, **forces}.items()
        if name not in ("cop_x_m", "cop_y_m") and (plates or name != "time_s")
    }
    return replace(
        table,
        names=tuple(f"{name}_{column}" for name in names.values() for column in _COLUMNS),
        columns=columns,
        units={**table.units, **dict.fromkeys(forces, "N")},
        plate_forces=table.plate_forces | set(forces),
        epoch_ns=begin_ns if begin_ns > YEAR_2000_NS else None,
    )


@dataclass(frozen=True)
class _WrenchSeries:
    """Stamps (n,) in ns and wrenches (6, n) of a topic, in the order of their stamps."""

    t_ns: Any
    wrench: Floats
    notes: tuple[str, ...]


def _read_wrenches(bag: _Bag, topics: list[str], values_max: int) -> dict[str, _WrenchSeries]:
    """Return stamps and wrenches by topic.

    Raises:
        FileFormatError: a topic has no messages, too many messages, or messages in two frames.
    """
    rows: dict[str, list[tuple[float, ...]]] = {topic: [] for topic in topics}
    stamps: dict[str, list[tuple[int, int]]] = {topic: [] for topic in topics}
    frames: dict[str, set[str]] = {topic: set() for topic in topics}
    for topic, logged_ns, message in bag.read_messages(topics) if topics else ():
        check_table_size(len(rows[topic]), len(_COLUMNS) + 3, values_max)
        force, torque = message.wrench.force, message.wrench.torque
        rows[topic].append((force.x, force.y, force.z, torque.x, torque.y, torque.z))
        stamp = message.header.stamp
        stamps[topic].append((1_000_000_000 * int(stamp.sec) + int(stamp.nanosec), logged_ns))
        frames[topic].add(message.header.frame_id)
    found = {}
    for topic in topics:
        if not rows[topic]:
            raise FileFormatError(f"topic {topic} has no messages")
        if len(frames[topic]) > 1:
            raise FileFormatError(
                f"topic {topic} is in the frames {', '.join(sorted(frames[topic]))[:200]}",
                expected="wrenches in one frame",
            )
        (frame,) = frames[topic]
        notes = [f"forces are along the axes of its frame {frame!r}, COP in the plane z = 0 of it"]
        stamp_ns, logged_ns = np.array(stamps[topic], dtype=np.int64).T
        if not stamp_ns.any():
            notes.append("its headers have no stamps: recording times are used")
            stamp_ns = logged_ns
        order = np.argsort(stamp_ns, kind="stable")
        wrench = np.array(rows[topic], dtype=np.float64).T[:, order]
        found[topic] = _WrenchSeries(stamp_ns[order], wrench, tuple(notes))
    return found


def _open_rosbag(path: Path) -> _Bag:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys import Stores, get_typestore

    is_first = path.suffix.lower() == ".bag"
    types = get_typestore(Stores.ROS1_NOETIC if is_first else Stores.ROS2_HUMBLE)
    decode = types.deserialize_ros1 if is_first else types.deserialize_cdr

    def messages(topics: list[str]) -> Iterator[_Message]:
        with Reader1(path) if is_first else Reader2(path) as reader:
            own = [c for c in reader.connections if c.msgtype == WRENCH and c.topic in topics]
            for connection, logged_ns, raw in reader.messages(own):
                yield connection.topic, logged_ns, decode(raw, WRENCH)

    with Reader1(path) if is_first else Reader2(path) as reader:
        found = [c.topic for c in reader.connections if c.msgtype == WRENCH]
    return _Bag(list(dict.fromkeys(found)), messages)


def _open_mcap(path: Path) -> _Bag:
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_typestore

    decoders = {
        "ros1": get_typestore(Stores.ROS1_NOETIC).deserialize_ros1,
        "cdr": get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr,
    }

    def messages(topics: list[str]) -> Iterator[_Message]:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            for schema, channel, message in reader.iter_messages(topics):
                if schema is not None and schema.name in WRENCHES:
                    decode = decoders[channel.message_encoding]
                    yield channel.topic, message.log_time, decode(message.data, WRENCH)

    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    if summary is None:
        raise FileFormatError("it has no summary", remedy=f"Add one: `mcap recover {path}`")
    found = [
        channel.topic
        for channel in summary.channels.values()
        if (schema := summary.schemas.get(channel.schema_id)) and schema.name in WRENCHES
    ]
    return _Bag(list(dict.fromkeys(found)), messages)
