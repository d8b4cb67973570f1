"""Several sessions in one file: each format that holds them, by readers that are not its writer."""

from __future__ import annotations

import io
import shutil
import subprocess
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import pyxdf
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore
from scipy.io import loadmat

from devices.arrays import Floats
from devices.errors import UsageError
from storage.clock.table import ClockTable, StreamClockFacts
from storage.formats.export import Export
from storage.formats.slice import NO_OPTIONS, FormatOptions, Slice
from storage.formats.writers import matlab
from storage.formats.writers.format import make_names_unique
from storage.formats.writers.registry import FORMATS, get_multi_session_format
from tests.storage.formats.walks import (
    ARRAY,
    BOUND_NS,
    DOCUMENT,
    LATE_NS,
    PEAK_N,
    RATE_HZ,
    ROWS,
    export_of_walk,
    two_feet,
    walk,
)
from tests.storage.formats.writers.readers import C3dFile, said_in
from tests.storage.formats.writers.test_every_format import LOSSY, WHOLE


@dataclass
class Seen:
    """A session as a reader finds it."""

    time_s: Floats
    """On the axis of all."""
    grf_n: Floats
    bound_ns: float
    """How far it may be from that axis, at most."""


def of_mcap(content: bytes) -> dict[str, Seen]:
    decoded = make_reader(
        io.BytesIO(content), decoder_factories=[DecoderFactory()]
    ).iter_decoded_messages()
    frames = (
        (channel.topic, message.log_time, frame.grf_n)
        for _, channel, message, frame in decoded
        if channel.topic.endswith("/frames")
    )
    return of_messages(content, frames)


def of_ros2(content: bytes) -> dict[str, Seen]:
    types: Any = get_typestore(Stores.ROS2_HUMBLE)
    kind = "geometry_msgs/msg/WrenchStamped"
    wrenches = (
        (channel.topic, message.log_time, types.deserialize_cdr(message.data, kind).wrench.force.z)
        for _, channel, message in make_reader(io.BytesIO(content)).iter_messages()
        if channel.topic.endswith("/wrench")
    )
    return of_messages(content, wrenches)


def of_messages(content: bytes, messages: Iterator[tuple[str, int, float]]) -> dict[str, Seen]:
    rows: dict[str, list[tuple[float, float]]] = {}
    for topic, t_ns, grf_n in messages:
        rows.setdefault(topic[: topic.rindex("/") + 1], []).append((t_ns * 1e-9, grf_n))
    found = {}
    for said in said_in("mcap", content):
        time_s, grf_n = np.array(rows[said["topics"]]).T
        found[said["node"]] = Seen(time_s, grf_n, float(said["log_time_uncertainty_ns"]))
    return found


def of_xdf(content: bytes) -> dict[str, Seen]:
    found = {}
    for stream in pyxdf.load_xdf(io.BytesIO(content), dejitter_timestamps=False)[0]:
        node, _, kind = stream["info"]["name"][0].rpartition(" ")
        if kind == "frames":
            channels = stream["info"]["desc"][0]["channels"][0]["channel"]
            labels = [channel["label"][0] for channel in channels]
            columns = dict(zip(labels, stream["time_series"].T, strict=True))
            bound_ns = float(columns["t_server_uncertainty_ns"].max())
            found[node] = Seen(stream["time_stamps"], columns["grf_n"], bound_ns)
    return found


def of_matlab(content: bytes) -> dict[str, Seen]:
    file: Any = io.BytesIO(content)
    sessions = loadmat(file, simplify_cells=True)["sessions"]
    begin_ns = min(each["t_server_ns"][0] for each in sessions)
    return {
        each["node"]: Seen(
            (each["t_server_ns"] - begin_ns) * 1e-9,
            each["grf_n"],
            float(each["t_server_uncertainty_ns"].max()),
        )
        for each in sessions
    }


def of_opensim(content: bytes) -> dict[str, Seen]:
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        (name,) = (name for name in file.namelist() if name.endswith(".mot"))
        names, *rows = file.read(name).decode().partition("endheader\n")[2].splitlines()
    table = np.array([row.split("\t") for row in rows], dtype=np.float64)
    columns = dict(zip(names.split("\t"), table.T, strict=True))
    found = {}
    for said in said_in("opensim", content):
        prefix = said["columns"].split("_ground")[0]
        bound_ns = float(said["clock_uncertainty"].split()[4]) * 1e6
        found[said["node"]] = Seen(columns["time"], columns[f"{prefix}_ground_force_vy"], bound_ns)
    return found


def of_c3d(content: bytes) -> dict[str, Seen]:
    read, found = C3dFile(content), {}
    for number, said in enumerate(said_in("c3d", content), 1):
        grf_n = -read.channel(f"Fz{number}")
        bound_s = np.nanmax(read.channel(f"{number}:t_server_uncertainty_s"))
        found[said["node"]] = Seen(np.arange(len(grf_n)) / RATE_HZ, grf_n, 1e9 * bound_s)
    return found


READERS: Mapping[tuple[str, FormatOptions], Callable[[bytes], dict[str, Seen]]] = {
    ("c3d", NO_OPTIONS): of_c3d,
    ("opensim", NO_OPTIONS): of_opensim,
    ("mcap", NO_OPTIONS): of_mcap,
    ("mcap", FormatOptions(messages="ros2")): of_ros2,
    ("mat", NO_OPTIONS): of_matlab,
    ("xdf", NO_OPTIONS): of_xdf,
}
EACH = pytest.mark.parametrize(
    ("to", "options"), READERS, ids=lambda value: value if isinstance(value, str) else ""
)


def written(to: str, exports: Sequence[Export], options: FormatOptions = NO_OPTIONS) -> bytes:
    given = [replace(each, options=options) for each in exports]
    return b"".join(get_multi_session_format(to).encode_together_on_server_clock(given))


def test_formats_of_one_session_name_those_of_several() -> None:
    several = {name for name, known in FORMATS.items() if known.can_hold_several_sessions}
    assert {to for to, _ in READERS} == several
    for name in set(FORMATS) - several:
        with pytest.raises(UsageError, match=f"{name} holds one.*c3d, opensim, mcap, mat, xdf"):
            get_multi_session_format(name)


@EACH
def test_two_feet_are_on_one_axis_with_their_bounds(to: str, options: FormatOptions) -> None:
    left, right = two_feet()
    both = [replace(left, notes={"ledger": WHOLE}), replace(right, notes={"ledger": LOSSY})]
    content = written(to, both, options)
    found = READERS[to, options](content)
    assert set(found) == {"left", "right-2"}
    peaks_s = []
    for name in ("left", "right-2"):
        seen = found[name]
        peak = int(np.nanargmax(seen.grf_n))
        assert seen.grf_n[peak] == pytest.approx(PEAK_N, rel=1e-3)
        peaks_s.append(seen.time_s[peak])
        # There is one measurement; two seconds from it another 0.1 ms and more are possible.
        assert 0.99 * BOUND_NS <= seen.bound_ns <= 2.0 * BOUND_NS
    # The second stance has its peak in two frames.
    assert peaks_s[1] - peaks_s[0] == pytest.approx(LATE_NS * 1e-9, abs=2.0 / RATE_HZ)
    complete = {said["node"]: said["complete"] for said in said_in(to, content)}
    assert complete["left"].lower() in ("true", "complete")
    assert complete["right-2"].startswith("lossy")


@EACH
@pytest.mark.parametrize("nodes", [("left", "left"), ("a/é 🦶", "a/é_🦶"), ("", "'")])
def test_nodes_of_one_name_are_told_apart(
    to: str, options: FormatOptions, nodes: tuple[str, str]
) -> None:
    content = written(to, two_feet(*nodes), options)
    assert len(said_in(to, content)) == 2
    if to == "mcap":
        summary = make_reader(io.BytesIO(content)).get_summary()
        assert summary is not None
        names = [channel.topic for channel in summary.channels.values()]
    elif to == "xdf":
        names = [stream["info"]["name"][0] for stream in pyxdf.load_xdf(io.BytesIO(content))[0]]
    elif to == "opensim":
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            mot = next(name for name in file.namelist() if name.endswith(".mot"))
            names = file.read(mot).decode().partition("endheader\n")[2].split("\n")[0].split("\t")
        assert len(names) == 1 + 2 * 9
    else:  # platforms and structs have numbers
        names = []
    assert len(set(names)) == len(names)


def test_a_name_that_is_taken_has_a_number() -> None:
    assert make_names_unique(["a", "b", "a", "a_2", "a"]) == ["a", "b", "a_2", "a_2_2", "a_3"]


@EACH
def test_sessions_without_a_common_axis_are_refused(to: str, options: FormatOptions) -> None:
    with pytest.raises(UsageError, match="the nodes' own clocks are no common axis"):
        written(to, [export_of_walk(), export_of_walk()], options)
    left, right = two_feet()
    never = ClockTable({}, [StreamClockFacts(ARRAY.stream_id)], [ARRAY.stream_id])
    second = replace(right, clock=never, provenance={"session": "s2"})
    with pytest.raises(UsageError, match=r"session s2 of right-2: .* time is not known"):
        written(to, [left, second], options)


@pytest.mark.parametrize("to", ["mcap", "mat", "xdf"])
def test_chosen_columns_alone_have_their_time(to: str) -> None:
    content = written(to, two_feet(part=Slice(0.0, 1.0, ("grf_n",))))
    assert not any(other in content for other in (b"force_n", b"pressure_raw", b"counters"))
    found = READERS[to, NO_OPTIONS](content)
    assert len(found["left"].grf_n) == round(RATE_HZ)
    assert found["right-2"].time_s[0] - found["left"].time_s[0] == pytest.approx(0.3, abs=1e-5)


def test_messages_of_both_are_in_order_of_time() -> None:
    content = written("mcap", two_feet())
    times = [message.log_time for *_, message in make_reader(io.BytesIO(content)).iter_messages()]
    reader = make_reader(io.BytesIO(content))
    as_they_stand = [m.log_time for *_, m in reader.iter_messages(log_time_order=False)]
    assert as_they_stand == sorted(times)


# --- OpenSim --------------------------------------------------------------------------------------


def test_each_foot_is_a_force_on_a_body_of_its_own(tmp_path: Path) -> None:
    columns = walk()
    ground = {"cop_ground_x_m": columns["cop_x_m"] + 0.1, "cop_ground_y_m": columns["cop_y_m"]}
    feet = two_feet(columns={**columns, **ground})
    content = written("opensim", feet, FormatOptions(body="calcn_l,calcn_r"))
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        file.extractall(tmp_path)
    loads = ElementTree.parse(next(tmp_path.glob("*.xml"))).getroot()  # noqa: S314  # ours
    forces = list(loads.iter("ExternalForce"))
    assert [force.get("name") for force in forces] == ["foottile_left_grf", "foottile_right-2_grf"]
    for force, body, name in zip(forces, ("calcn_l", "calcn_r"), ("left", "right-2"), strict=True):
        said = {each.tag: each.text for each in force}
        # None of them knows where the ground of the other is.
        for tag in ("applied_to_body", "force_expressed_in_body", "point_expressed_in_body"):
            assert said[tag] == body
        assert said["force_identifier"] == f"{name}_ground_force_v"


def test_of_several_feet_all_bodies_are_named_or_none() -> None:
    with pytest.raises(UsageError, match=r"1 bodies for 2 sessions; expected one for each.*left"):
        written("opensim", two_feet(), FormatOptions(body="calcn_r"))


# --- MATLAB ---------------------------------------------------------------------------------------

SCRIPT = """
{example}
assert(isequal(size(take.sessions), [1 2]) && strcmp(take.units.grf_n, "N"));
left = take.sessions(1); right = take.sessions(2);
assert(isa(left.t_server_ns, "int64") && isequal(size(left.force_n), [{rows} {tiles}]));
assert(isempty(left.angle_rad) && numel(right.angle_rad) == {rows});
printf("%s %s %.1f\\n", left.node, right.about.complete, since_s(1));
"""


def feet_of_which_one_has_a_servo() -> list[Export]:
    left, _ = two_feet(part=Slice(columns=("force_n", "grf_n")))
    _, right = two_feet(columns={**walk(), "angle_rad": np.zeros(ROWS)})
    return [left, replace(right, notes={"ledger": WHOLE})]


def test_sessions_are_structs_with_the_same_fields() -> None:
    file: Any = io.BytesIO(written("mat", feet_of_which_one_has_a_servo()))
    left, right = loadmat(file, simplify_cells=True)["sessions"]
    assert set(left) == set(right)
    assert left["angle_rad"].size == 0
    assert len(right["angle_rad"]) == ROWS
    np.testing.assert_array_equal(left["force_n"], walk()["force_n"].astype(np.float32))


@pytest.mark.slow
def test_octave_reads_an_array_of_structs(tmp_path: Path) -> None:
    octave = shutil.which("octave-cli") or shutil.which("octave")
    if octave is None:
        pytest.skip("Octave is not installed")
    (tmp_path / "take.mat").write_bytes(written("mat", feet_of_which_one_has_a_servo()))
    document = DOCUMENT.read_text("utf-8").split("```matlab\ntake = load")[1].split("```")[0]
    lines = [line for line in document.splitlines() if "plot" not in line]  # there is no screen
    example = "\n".join(["take = load" + lines[0], *lines[1:]])
    script = SCRIPT.format(example=example, rows=ROWS, tiles=len(ARRAY.tiles))
    command = [octave, "--no-gui", "--norc", "--quiet", "--eval", script]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=120, cwd=tmp_path
    )
    assert done.stdout.split() == ["left", "true", f"{LATE_NS * 1e-9:.1f}"], done.stderr


def test_too_many_bytes_for_a_variable_are_refused_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matlab, "BYTES_MAX", 100_000)
    with pytest.raises(UsageError, match="bytes in these sessions, and 100000 in a variable"):
        next(get_multi_session_format("mat").encode_together_on_server_clock(two_feet()))
