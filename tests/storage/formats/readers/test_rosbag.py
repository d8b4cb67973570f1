"""Wrenches of ROS 1 and ROS 2: bags of both, MCAP, and our own export."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from devices.errors import FileFormatError, FootTileError, UsageError
from storage.formats.reference import ReferenceOptions, read_reference
from storage.formats.slice import FormatOptions
from tests.storage.formats.exports import frames
from tests.storage.formats.readers.reading import check
from tests.storage.formats.writers.test_mcap import estimates, written

BEGIN_NS = 1_750_000_000_123_456_789
STEP_NS = 5_000_000
COUNT = 40
LEFT = ReferenceOptions({"grf_n": "left_foot_fz"})
LEFT_COP = ReferenceOptions(
    {"grf_n": "left_foot_fz", "cop_x_m": "left_foot_cop_x", "cop_y_m": "left_foot_cop_y"}
)


@dataclass(frozen=True)
class Sample:
    """A wrench of a topic at an instant."""

    topic: str
    t_ns: int
    wrench: tuple[float, ...]
    frame: str = "sole"
    logged_ns: int | None = None


def walk(topic: str = "/left/foot", begin_ns: int = BEGIN_NS, turned: float = 1.0) -> list[Sample]:
    """Stances of up to 19 N, with the centre of pressure at (0.02, -0.01)."""
    force_n = [turned * float(i % 20) for i in range(COUNT)]
    return [
        Sample(topic, begin_ns + STEP_NS * i, (0.5, 0.25, fz, -0.01 * fz, -0.02 * fz, 0.0))
        for i, fz in enumerate(force_n)
    ]


def message(types: Any, sample: Sample, *, is_first: bool) -> Any:
    make = types.types
    sec, nanosec = divmod(sample.t_ns, 1_000_000_000)
    stamp = make["builtin_interfaces/msg/Time"](sec, nanosec)
    sequence = (0,) if is_first else ()
    header = make["std_msgs/msg/Header"](*sequence, stamp, sample.frame)
    vector = make["geometry_msgs/msg/Vector3"]
    force, torque = vector(*sample.wrench[:3]), vector(*sample.wrench[3:])
    wrench = make["geometry_msgs/msg/Wrench"](force, torque)
    return make["geometry_msgs/msg/WrenchStamped"](header, wrench)


WRENCH = "geometry_msgs/msg/WrenchStamped"


def write_bag1(folder: Path, samples: Sequence[Sample]) -> Path:
    types, path = get_typestore(Stores.ROS1_NOETIC), folder / "walk.bag"
    with Writer1(path) as writer:
        connections = {
            topic: writer.add_connection(topic, WRENCH, typestore=types)
            for topic in dict.fromkeys(sample.topic for sample in samples)
        }
        writer.add_connection("/other", "std_msgs/msg/String", typestore=types)
        for one in samples:
            raw = types.serialize_ros1(message(types, one, is_first=True), WRENCH)
            writer.write(connections[one.topic], one.logged_ns or one.t_ns, raw)
    return path


def write_bag2(
    folder: Path, samples: Sequence[Sample], plugin: StoragePlugin = StoragePlugin.SQLITE3
) -> Path:
    types, path = get_typestore(Stores.ROS2_HUMBLE), folder / "walk"
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections = {
            topic: writer.add_connection(topic, WRENCH, typestore=types)
            for topic in dict.fromkeys(sample.topic for sample in samples)
        }
        for one in samples:
            raw = types.serialize_cdr(message(types, one, is_first=False), WRENCH)
            writer.write(connections[one.topic], one.logged_ns or one.t_ns, bytes(raw))
    return path


def write_mcap_folder(folder: Path, samples: Sequence[Sample]) -> Path:
    return write_bag2(folder, samples, StoragePlugin.MCAP)


def write_db3(folder: Path, samples: Sequence[Sample]) -> Path:
    return next(write_bag2(folder, samples).glob("*.db3"))


def write_mcap2(folder: Path, samples: Sequence[Sample]) -> Path:
    return next(write_mcap_folder(folder, samples).glob("*.mcap"))


def write_mcap1(folder: Path, samples: Sequence[Sample]) -> Path:
    types, path = get_typestore(Stores.ROS1_NOETIC), folder / "walk.mcap"
    definition, _ = types.generate_msgdef(WRENCH)
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros1")
        schema = writer.register_schema(
            "geometry_msgs/WrenchStamped", "ros1msg", definition.encode()
        )
        channels = {
            topic: writer.register_channel(topic, "ros1", schema)
            for topic in dict.fromkeys(sample.topic for sample in samples)
        }
        for one in samples:
            raw = types.serialize_ros1(message(types, one, is_first=True), WRENCH)
            at_ns = one.logged_ns or one.t_ns
            writer.add_message(channels[one.topic], at_ns, bytes(raw), at_ns)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap's is not annotated
    return path


Write = Callable[[Path, Sequence[Sample]], Path]
WRITERS: tuple[Write, ...] = (
    *(write_bag1, write_bag2, write_mcap_folder, write_db3, write_mcap2, write_mcap1),
)
every_format = pytest.mark.parametrize("write", WRITERS)


@every_format
def test_a_wrench_has_force_and_centre_of_pressure(tmp_path: Path, write: Write) -> None:
    found = read_reference(write(tmp_path, [*walk(), *walk("/right", turned=2.0)]), LEFT_COP)
    force_n = np.array([float(i % 20) for i in range(COUNT)])
    check(found, grf_n=force_n)
    check(found, rtol=1e-7, atol=1e-12, time_s=np.arange(COUNT) * 5e-3)
    assert found.epoch_ns == BEGIN_NS
    cop_m = np.where(force_n[:, None] > 0.0, [[0.02, -0.01]], np.nan)
    check(found, rtol=1e-7, cop_m=cop_m)


@every_format
def test_the_only_topic_is_taken_with_its_sign_and_several_have_to_be_named(
    tmp_path: Path, write: Write
) -> None:
    folders = [tmp_path / name for name in ("one", "several", "none")]
    for folder in folders:
        folder.mkdir()
    one, several, none = folders
    found = read_reference(write(one, walk(turned=-1.0)), ReferenceOptions())
    check(found, grf_n=[float(i % 20) for i in range(COUNT)])
    assert found.cop_m is None
    assert any("--sign -" in note for note in found.notes)
    for folder, samples, says in (
        (several, [*walk(), *walk("/right")], r"it has left_foot_fz, .*right_fz"),
        (none, [], "there is no wrench in it"),
    ):
        with pytest.raises(FileFormatError, match=says):
            read_reference(write(folder, samples), ReferenceOptions())


@every_format
def test_a_cut_or_damaged_bag_is_refused_by_our_own_errors(tmp_path: Path, write: Write) -> None:
    path = write(tmp_path, walk())
    if path.is_dir():
        path = next(one for one in path.iterdir() if one.suffix in (".db3", ".mcap"))
    content = path.read_bytes()
    for keep in (0, 3, 40, 200, len(content) // 2, len(content) - 9):
        path.write_bytes(content[:keep])
        with pytest.raises(FootTileError):
            read_reference(path, ReferenceOptions())
    rng = np.random.default_rng(3)
    for _ in range(30):
        damaged = bytearray(content)
        at = rng.integers(0, len(content), 20)
        for i in at:
            damaged[i] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        with suppress(FootTileError):
            read_reference(path, ReferenceOptions())


@pytest.mark.parametrize("write", [write_mcap2, write_mcap1, write_bag1])
def test_a_recording_that_was_cut_off_says_so_and_names_its_tool(
    tmp_path: Path, write: Write
) -> None:
    path = write(tmp_path, walk())
    content = path.read_bytes()
    tool = "rosbag reindex" if path.suffix == ".bag" else "mcap recover"
    for missing_bytes in (len(content) // 2, len(content) - 100) + (40,) * (tool[0] == "m"):
        path.write_bytes(content[:-missing_bytes])
        with pytest.raises(FileFormatError, match=rf"cut off.*{tool}"):
            read_reference(path, ReferenceOptions())


def test_a_bag_of_ros_1_that_is_still_recorded_names_its_tool(tmp_path: Path) -> None:
    path = tmp_path / "walk.bag.active"
    write_bag1(tmp_path, walk()).rename(path)
    with pytest.raises(FileFormatError, match=r"cut off.*rosbag reindex"):
        read_reference(path, ReferenceOptions())


@pytest.mark.parametrize("write", [write_bag2, write_mcap_folder])
def test_a_folder_without_metadata_names_its_tool(tmp_path: Path, write: Write) -> None:
    path = write(tmp_path, walk())
    (path / "metadata.yaml").unlink()
    with pytest.raises(FileFormatError, match=r"cut off.*ros2 bag reindex"):
        read_reference(path, ReferenceOptions())


def test_soles_are_added_up_where_their_stamps_are_the_same(tmp_path: Path) -> None:
    both = ReferenceOptions({"grf_n": "left_foot_fz+right_fz"})
    path = write_bag1(tmp_path, [*walk(), *walk("/right", turned=2.0)])
    assert read_reference(path, both).grf_n.max() == 57.0
    path.unlink()
    late = write_bag1(tmp_path, [*walk(), *walk("/right", begin_ns=BEGIN_NS + 1)])
    with pytest.raises(FileFormatError, match="have stamps of their own"):
        read_reference(late, both)


def test_another_axis_of_the_frame_can_be_the_vertical(tmp_path: Path) -> None:
    samples = [Sample("/ft", one.t_ns, (-one.wrench[2], 0.0, 0.1, 0, 0, 0)) for one in walk()]
    path = write_bag1(tmp_path, samples)
    assert read_reference(path, ReferenceOptions({"grf_n": "-ft_fx"})).grf_n.max() == 19.0
    assert read_reference(path, ReferenceOptions({"grf_n": "ft_fx"})).grf_n.max() == 19.0


def test_messages_are_in_the_order_of_their_stamps(tmp_path: Path) -> None:
    samples = walk()
    late = [
        replace(one, logged_ns=BEGIN_NS + i) for i, one in enumerate([*samples[10:], *samples[:10]])
    ]
    found = read_reference(write_bag1(tmp_path, late), ReferenceOptions())
    check(found, grf_n=[float(i % 20) for i in range(COUNT)])


def test_without_stamps_the_times_of_recording_count(tmp_path: Path) -> None:
    samples = [replace(one, t_ns=0, logged_ns=one.t_ns) for one in walk()]
    found = read_reference(write_bag1(tmp_path, samples), ReferenceOptions())
    check(found, rtol=1e-7, atol=1e-12, time_s=np.arange(COUNT) * 5e-3)
    assert any("no stamps" in note for note in found.notes)


def test_stamps_of_a_simulation_have_no_date(tmp_path: Path) -> None:
    found = read_reference(write_bag1(tmp_path, walk(begin_ns=STEP_NS)), ReferenceOptions())
    assert found.epoch_ns is None


def test_a_topic_in_two_frames_is_refused(tmp_path: Path) -> None:
    samples = [*walk(), Sample("/left/foot", BEGIN_NS + 10**9, (0.0,) * 6, frame="other")]
    with pytest.raises(FileFormatError, match="in the frames other, sole"):
        read_reference(write_bag1(tmp_path, samples), ReferenceOptions())


def test_our_own_export_to_ros_2_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    path.write_bytes(written(FormatOptions(messages="ros2")))
    stated = ReferenceOptions(
        {"grf_n": "left_wrench_fz", "cop_x_m": "left_wrench_cop_x", "cop_y_m": "left_wrench_cop_y"}
    )
    found, columns, batch = read_reference(path, stated), estimates(), frames()
    known = ~np.isnan(columns["grf_n"])
    np.testing.assert_array_equal(found.grf_n, columns["grf_n"][known])
    assert found.epoch_ns == batch.t_ns[0]
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m[:, 0], columns["cop_x_m"][known], rtol=1e-12)


def test_a_unit_that_is_not_ros_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is in N, not in kN"):
        read_reference(write_bag1(tmp_path, walk()), ReferenceOptions(units={"grf": "kN"}))


@pytest.mark.timeout(60)
@pytest.mark.parametrize("ending", [".bag", ".mcap", ".db3"])
def test_a_pipe_or_a_device_is_refused_at_once(tmp_path: Path, ending: str) -> None:
    pipe, device = tmp_path / f"pipe{ending}", tmp_path / f"device{ending}"
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    for path in (pipe, device):
        with pytest.raises(FileFormatError, match="not a file that can be read whole"):
            read_reference(path, LEFT)


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", ["metadata.yaml", "frames.db3"])
def test_a_pipe_in_the_folder_of_a_bag_is_refused_at_once(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "bag.db3"
    folder.mkdir()
    os.mkfifo(folder / name)
    with pytest.raises(FileFormatError, match="not a file that can be read whole"):
        read_reference(folder, LEFT)


def test_our_own_export_to_foxglove_has_no_wrenches(tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    path.write_bytes(written())
    with pytest.raises(FileFormatError, match="there is no wrench in it"):
        read_reference(path, ReferenceOptions())
