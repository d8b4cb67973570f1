"""MCAP files, read by the MCAP project's reader with Protobuf, and by rosbags."""

from __future__ import annotations

import io
import json
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from devices.chips.pressure_chips import Compensation
from devices.errors import UsageError
from devices.flags import CONTACT_UNKNOWN, TileFlag
from devices.frames import NOT_READ
from storage.clock.bounds import OffsetRows
from storage.clock.table import ClockTable, StreamClockFacts
from storage.formats.export import make_one_pass_frame_source
from storage.formats.markers import PLACEMENT_COLUMNS, PlacedMarkers, place_markers
from storage.formats.slice import NO_OPTIONS, FormatOptions, Slice
from storage.formats.writers.mcap_messages import make_ros2_name
from storage.schema import Array
from storage.sessions.folder import Marker
from tests.builders.arrays import make_array
from tests.storage.formats.exports import NOTES, ROWS, cut, export, extra, frames

ROS2 = FormatOptions(messages="ros2")
LABEL = "a “stone” / 石 🦶"
Messages = dict[str, list[tuple[Any, Any]]]
"""By topic, the file's record of each message, and what it says."""


def estimates() -> dict[str, Array]:
    grf_n = np.linspace(0.0, 40.0, ROWS)
    grf_n[7] = np.nan
    cop_x_m = np.where(grf_n > 5.0, np.linspace(-0.02, 0.03, ROWS), np.nan)
    status = np.where(np.isnan(cop_x_m), 16, 0).astype(np.uint16)
    cop = {"cop_x_m": cop_x_m, "cop_y_m": 0.5 * cop_x_m, "estimate_flags": status}
    return extra() | {"grf_n": grf_n, **cop}


def markers() -> PlacedMarkers:
    clock = ClockTable(
        {"a": OffsetRows(np.array([0]), np.array([0]), np.array([1]))},
        [StreamClockFacts("a", 0, True)],
        ["a"],
    )
    batch = frames()
    event = Marker(id="0" * 12, label=LABEL, t_ns=int(batch.t_ns[12]))
    return place_markers(
        [event], [{name: getattr(batch, name) for name in PLACEMENT_COLUMNS}], clock, Slice()
    )


def written(
    options: FormatOptions = NO_OPTIONS,
    part: Slice | None = None,
    columns: Mapping[str, Array] | None = None,
    node: str = "left",
    *,
    every: int = 20,
) -> bytes:
    given = estimates() if columns is None else columns
    content = make_one_pass_frame_source(cut(frames(), given, every))
    facts = (None, markers(), {"session": "s"}, options)
    info = make_array(2, node=node)
    return b"".join(export(content, info, NOTES, "mcap", part or Slice(), *facts))


def foxglove(content: bytes) -> Messages:
    reader = make_reader(io.BytesIO(content), decoder_factories=[DecoderFactory()])
    found: Messages = defaultdict(list)
    for _, channel, message, said in reader.iter_decoded_messages():
        found[channel.topic].append((message, said))
    return found


def ros2(folder: Path, content: bytes) -> Messages:
    path = folder / "session.mcap"
    path.write_bytes(content)
    types = get_typestore(Stores.EMPTY)
    found: Messages = defaultdict(list)
    with Reader(path) as reader:
        for connection in reader.connections:  # by what the file says of them, and nothing else
            assert connection.msgdef.data
            types.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, t_ns, raw in reader.messages():
            found[connection.topic].append((t_ns, types.deserialize_cdr(raw, connection.msgtype)))
    return found


# --- Foxglove's -----------------------------------------------------------------------------------


def test_each_frame_is_a_message_at_its_time() -> None:
    batch, columns = frames(), estimates()
    said = foxglove(written())["/left/frames"]
    assert [message.log_time for message, _ in said] == batch.t_ns.tolist()
    assert [message.publish_time for message, _ in said] == batch.t_ns.tolist()
    found = [frame for _, frame in said]
    assert [frame.seq for frame in found] == batch.seq.tolist()
    assert [frame.t_ns for frame in found] == batch.t_ns.tolist()
    assert [frame.frame_flags for frame in found] == batch.frame_flags.tolist()
    assert [frame.sample_offset_us_1 for frame in found] == batch.sample_offset_us[:, 1].tolist()
    pressure_raw = np.where(batch.pressure_raw[:, 1] == NOT_READ, np.nan, batch.pressure_raw[:, 1])
    np.testing.assert_array_equal([frame.pressure_raw_1 for frame in found], pressure_raw)
    contact = np.where(columns["contact"] == CONTACT_UNKNOWN, np.nan, columns["contact"])
    np.testing.assert_array_equal([frame.contact for frame in found], contact)
    for name in ("grf_n", "cop_x_m"):
        np.testing.assert_array_equal(
            np.array([getattr(frame, name) for frame in found]), columns[name].astype(np.float32)
        )
    np.testing.assert_array_equal(
        np.array([frame.force_n_0 for frame in found]), columns["force_n"][:, 0].astype(np.float32)
    )


def test_a_mark_is_a_line_of_log_at_its_frame() -> None:
    ((message, log),) = foxglove(written())["/left/markers"]
    at_ns = int(frames().t_ns[12])
    assert message.log_time == at_ns
    assert log.timestamp.seconds * 10**9 + log.timestamp.nanos == at_ns
    assert (log.message, log.name) == (LABEL, "left")


def test_the_foot_is_drawn_with_an_arrow_at_its_cop() -> None:
    tiles = make_array(2).tiles
    drawn = foxglove(written())["/left/foot"]
    assert len(drawn) in (2, 3)  # 98 ms
    for message, update in drawn:
        (entity,) = update.entities
        places = [(c.pose.position.x, c.pose.position.y) for c in entity.cylinders]
        assert places == [(tile.x_m, tile.y_m) for tile in tiles]
        row = frames().t_ns.tolist().index(message.log_time)
        has_centre = not np.isnan(estimates()["cop_x_m"][row])
        assert len(entity.arrows) == has_centre
    assert drawn[-1][1].entities[0].arrows


@pytest.mark.parametrize("options", [NO_OPTIONS, ROS2])
def test_any_pieces_give_the_same_messages(options: FormatOptions) -> None:
    def messages(content: bytes) -> list[tuple[str, int, bytes]]:
        found = make_reader(io.BytesIO(content)).iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in found]

    one = messages(written(options))
    assert one == messages(written(options, every=7)) == messages(written(options, every=ROWS))


def test_metadata_have_clock_serials_and_markers() -> None:
    (record,) = make_reader(io.BytesIO(written())).iter_metadata()
    assert "node's clock" in record.metadata["log_time"]
    assert json.loads(record.metadata["serials"]) == [tile.serial for tile in make_array(2).tiles]
    (marker,) = json.loads(record.metadata["notes"])["markers"]
    assert marker["label"] == LABEL


# --- those of ROS 2 -------------------------------------------------------------------------------


def test_a_wrench_has_the_force_and_its_moment(tmp_path: Path) -> None:
    columns, batch = estimates(), frames()
    said = ros2(tmp_path, written(ROS2))["/left/wrench"]
    assert [t_ns for t_ns, _ in said] == batch.t_ns.tolist()
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in said]
    assert stamps == batch.t_ns.tolist()
    assert {m.header.frame_id for _, m in said} == {"left_foot"}
    force_n = np.array([m.wrench.force.z for _, m in said])
    np.testing.assert_array_equal(force_n, columns["grf_n"])
    known = ~np.isnan(columns["cop_x_m"])
    x_m = np.array([-m.wrench.torque.y for _, m in said])[known] / force_n[known]
    y_m = np.array([m.wrench.torque.x for _, m in said])[known] / force_n[known]
    np.testing.assert_allclose(x_m, columns["cop_x_m"][known], rtol=1e-12)
    np.testing.assert_allclose(y_m, columns["cop_y_m"][known], rtol=1e-12)
    assert np.isnan([m.wrench.torque.x for _, m in said])[~known].all()


def test_forces_of_one_row_of_tiles_act_at_the_row(tmp_path: Path) -> None:
    columns = estimates() | {"cop_y_m": np.full(ROWS, np.nan)}
    stated = ~np.isnan(columns["cop_x_m"])
    wrenches = [m.wrench for _, m in ros2(tmp_path, written(ROS2, columns=columns))["/left/wrench"]]
    torque_x = np.array([wrench.torque.x for wrench in wrenches])
    np.testing.assert_array_equal(torque_x[stated], 0.0)  # the row is at y = 0
    assert np.isnan(torque_x[~stated]).all()
    said = foxglove(written(columns=columns))
    assert np.isnan([frame.cop_y_m for _, frame in said["/left/frames"]]).all()
    drawn = {record.log_time: scene.entities[0].arrows for record, scene in said["/left/foot"]}
    for t_ns, has_centre in zip(frames().t_ns.tolist(), stated, strict=True):
        if t_ns in drawn:
            assert [arrow.pose.position.y for arrow in drawn[t_ns]] == [0.0] * int(has_centre)


@pytest.mark.parametrize("every", [3, ROWS])
def test_a_tiles_pressure_is_absolute_at_its_own_time(tmp_path: Path, every: int) -> None:
    batch = frames()
    messages = ros2(tmp_path, written(ROS2, every=every))
    kpa = Compensation(make_array(2).tiles).law.compute_kpa(
        batch.pressure_raw, batch.temperature_raw
    )
    unknown = (batch.pressure_raw == NOT_READ) | ((batch.tile_flags & TileFlag.UNUSABLE) != 0)
    for i, tile in enumerate(make_array(2).tiles):
        said = messages[f"/left/tile_{i}/pressure"]
        assert {m.header.frame_id for _, m in said} == {tile.serial}
        stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in said]
        assert stamps == (batch.t_ns + 1000 * batch.sample_offset_us[:, i].astype(int)).tolist()
        expected = np.where(unknown[:, i], np.nan, kpa[:, i] * 1e3)
        np.testing.assert_allclose([m.fluid_pressure for _, m in said], expected, rtol=1e-12)


def test_an_unread_temperature_is_that_of_the_last_second(tmp_path: Path) -> None:
    from storage.formats.writers.mcap_messages import _TemperatureHold

    held = _TemperatureHold(1)
    second_ns = 10**9
    t_ns = np.array([0, 1, second_ns, second_ns + 1, second_ns + 2]) + 10**18
    temperature_raw = np.array([[470], [NOT_READ], [NOT_READ], [NOT_READ], [480]], dtype=np.uint16)
    one = held.hold_temperature(t_ns, temperature_raw)
    assert np.array_equal(one[:, 0], [470, 470, 470, np.nan, 480], equal_nan=True)
    pieces = _TemperatureHold(1)
    apart = [pieces.hold_temperature(t_ns[i : i + 1], temperature_raw[i : i + 1]) for i in range(5)]
    assert np.array_equal(np.vstack(apart), one, equal_nan=True)


def test_tiles_are_drawn_and_a_mark_is_a_text(tmp_path: Path) -> None:
    messages = ros2(tmp_path, written(ROS2))
    tiles = make_array(2).tiles
    for _, array in messages["/left/foot"]:
        *drawn, arrow = array.markers
        places = [(m.pose.position.x, m.pose.position.y, m.pose.position.z) for m in drawn]
        assert places == [(tile.x_m, tile.y_m, tile.z_m) for tile in tiles]
        assert (arrow.action == arrow.ADD) == (len(arrow.points) == 2)
    ((t_ns, text),) = messages["/left/markers"]
    assert (t_ns, text.data) == (int(frames().t_ns[12]), LABEL)


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [NO_OPTIONS, ROS2])
def test_a_session_without_forces_has_its_counts(tmp_path: Path, options: FormatOptions) -> None:
    content = written(options, columns={})
    topics = set(ros2(tmp_path, content)) if options is ROS2 else set(foxglove(content))
    assert "/left/wrench" not in topics
    assert ("/left/tile_1/pressure" if options is ROS2 else "/left/frames") in topics


@pytest.mark.parametrize(
    ("node", "name"),
    [("left foot/2", "left_foot_2"), ("2nd", "n_2nd"), ("🦶", "n"), ('a"b\\c', "a_b_c")],
)
def test_a_nodes_name_becomes_one_of_ros(tmp_path: Path, node: str, name: str) -> None:
    assert make_ros2_name(node) == name
    assert f"/{name}/wrench" in ros2(tmp_path, written(ROS2, node=node))
    assert f"/{name}/frames" in foxglove(written(node=node))


def test_columns_of_ros_messages_cannot_be_chosen() -> None:
    with pytest.raises(UsageError, match="fixed fields"):
        written(ROS2, Slice(columns=("grf_n",)))


@pytest.mark.parametrize("options", [NO_OPTIONS, ROS2])
def test_a_file_cut_off_is_not_read(options: FormatOptions) -> None:
    content = written(options)
    for end in (len(content) - 1, len(content) - 20, len(content) // 2):
        # Where it reads a checksum as text, this reader says so in Python's words.
        with pytest.raises((McapError, UnicodeDecodeError)):
            make_reader(io.BytesIO(content[:end])).get_summary()
