"""The Foxglove bridge, seen by a viewer of its protocol."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import foottile as client
from devices.flags import EstimateFlag
from service.bridges.follower import LiveClock
from service.bridges.foxglove import UNKNOWN_FLAGS, FoxgloveOutlet
from tests.service.bridges.readers import Viewer, make_live_frames
from tests.service.fake_node import FakeNode, Play
from tests.service.process import Process, Start
from tests.service.running import Running, ServeWith
from tests.waiting import until

ROOT = Path(__file__).resolve().parents[3]
pytestmark = pytest.mark.process


def url_of(bridge: Process) -> str:
    return bridge.said("ws://").split()[-1]


@pytest.fixture
def bridge(running: Running, tared: FakeNode, foottile: Start) -> Process:
    return foottile("bridge", "foxglove", "--port", 0, "--server", running.url)


@pytest.fixture
def viewer(bridge: Process) -> Iterator[Viewer]:
    viewer = Viewer(url_of(bridge))
    yield viewer
    viewer.close()


def test_a_viewer_gets_every_frame_with_all_values_and_flags_at_the_servers_time(
    running: Running, tared: FakeNode, viewer: Viewer
) -> None:
    with (
        client.connect(running.url) as server,
        server.live("bench", from_seq=70) as live,
        Play(tared, [20.0, 160.0]),  # the other tile is beyond its calibrated range
    ):
        first = viewer.receive_of("/bench/frames", lambda frame: frame.t_server_ns > 0)
        seen = [first, *(viewer.receive_of("/bench/frames") for _ in range(99))]
        wanted = {frame.content.seq: frame for frame in seen}
        found = 0
        for batch in live:
            for row in batch.to_pylist():
                if (frame := wanted.get(row["seq"])) is None:
                    continue
                found += 1
                for field in frame.content.DESCRIPTOR.fields:
                    value = getattr(frame.content, field.name)
                    if field.name.startswith("t_server"):
                        continue
                    expected = row[field.name]
                    np.testing.assert_equal(value, np.nan if expected is None else expected)
                assert frame.content.estimate_flags & EstimateFlag.SATURATED
                assert np.isnan(frame.content.grf_n)
                # Node and server have one clock here.
                off_ns = abs(frame.content.t_server_ns - row["t_ns"])
                assert off_ns <= frame.content.t_server_uncertainty_ns < 10_000_000
                assert frame.log_time_ns == frame.content.t_server_ns
            if found == len(seen):
                break
    seqs = [frame.content.seq for frame in seen]
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))


def test_markers_recordings_and_the_foot_are_shown(
    running: Running, tared: FakeNode, viewer: Viewer
) -> None:
    with Play(tared, 20.0):
        foot = viewer.receive_of("/bench/foot", lambda update: update.entities[0].arrows).content
        (entity,) = foot.entities
        assert (entity.frame_id, len(entity.cylinders)) == ("bench_foot", 2)
        assert entity.arrows[0].shaft_length == pytest.approx(0.04, rel=0.01)  # 2 tiles of 20 N
        recording = tared.record(name="mud")
        started = viewer.receive_of("/bench/markers")
        assert started.content.message == "recording started: mud"
        marker = running.http.post(f"{recording.url}/markers", json={"label": "a “stone”"}).json()
        seen = viewer.receive_of("/bench/markers")
        assert (seen.content.message, seen.log_time_ns) == ("a “stone”", marker["t_ns"])
        recording.stop()
        assert viewer.receive_of("/bench/markers").content.message == "recording stopped: mud"


@pytest.mark.slow
def test_a_node_that_comes_back_with_more_tiles_has_another_topic_of_frames_and_no_zero_forces(
    tared: FakeNode, viewer: Viewer
) -> None:
    with Play(tared, 20.0):
        viewer.receive_of("/bench/frames")
    tared.restart()
    tared.tiles = 3
    tared.connect()
    with Play(tared, 0.0):
        more = viewer.receive_of("/bench/frames", lambda frame: hasattr(frame, "tile_flags_2"))
    assert [viewer.topics[number] for number in viewer.closed] == ["/bench/frames"]
    assert np.isnan(more.content.grf_n)  # no tare yet


def test_topics_stay_open_when_estimates_begin_and_when_the_node_restarts() -> None:
    outlet, clock = FoxgloveOutlet("127.0.0.1", 0), LiveClock()
    frames = make_live_frames(10**18 + np.arange(2) * 10**8, "bench")  # estimate, none
    restarted = replace(frames, stream_id="another")
    with closing(outlet):
        outlet.write_frames(frames, clock)
        with closing(Viewer(outlet.url)) as viewer:
            channels = outlet._nodes["bench"]._open
            until(
                lambda: viewer.skip_message(0.02) or all(c.has_sinks() for c in channels.values())
            )
            for each in (frames, restarted):
                outlet.write_frames(each, clock)
                seen = [viewer.receive_of("/bench/frames").content for _ in range(2)]
                assert [frame.estimate_flags == UNKNOWN_FLAGS for frame in seen] == [False, True]
                assert [np.isnan(frame.grf_n) for frame in seen] == [False, True]
            assert sorted(viewer.topics.values()) == [
                *("/bench/foot", "/bench/frames", "/bench/markers")
            ]
            assert not viewer.closed


@pytest.mark.slow
def test_it_goes_on_after_a_restart_of_the_server_says_so_once_and_ends_with_ctrl_c(
    running: Running, tared: FakeNode, bridge: Process, viewer: Viewer
) -> None:
    with Play(tared, 20.0):
        viewer.receive_of("/bench/frames")
    running.restart()
    bridge.said("works again")
    tared.connect()
    first = tared.seq
    with Play(tared, 20.0):
        viewer.receive_of("/bench/frames", lambda frame: frame.seq >= first)
    assert len([line for line in bridge.err if "no connection" in line]) == 1
    bridge.process.send_signal(signal.SIGINT)
    assert bridge.ended() == 0


def test_a_viewer_that_does_not_read_takes_nothing_from_another() -> None:
    outlet, clock = FoxgloveOutlet("127.0.0.1", 0), LiveClock()
    written = 0

    def write(n: int) -> bool:
        nonlocal written
        t_ns = 10**18 + (written + np.arange(n)) * 1_000_000
        outlet.write_frames(make_live_frames(t_ns, "bench", tiles=64, seq_first=written), clock)
        written += n
        return False

    with closing(outlet), closing(Viewer(outlet.url)) as viewer, closing(Viewer(outlet.url)) as off:
        write(1)  # it advertises the topics
        until(lambda: viewer.skip_message(timeout_s=0.02) or write(1))
        until(lambda: off.skip_message(timeout_s=0.02) or write(1))
        begin = written
        seen: list[int] = []
        while written < begin + 4000:
            write(100)
            while not seen or seen[-1] < written - 1:
                seen.append(viewer.receive_of("/bench/frames").content.seq)
        assert seen[-4000:] == list(range(begin, written))
        held = [off.receive_of("/bench/frames").content.seq]
        while held[-1] < written - 1:
            held.append(off.receive_of("/bench/frames").content.seq)
        assert len(held) < 4000  # more than waits for one viewer


@pytest.mark.slow
def test_a_private_server_is_republished_only_if_that_is_said(
    serve_with: ServeWith, foottile: Start
) -> None:
    running = serve_with(is_private=True)
    words = ("bridge", "foxglove", "--port", 0, "--server", running.url)
    refused = foottile(*words)
    assert refused.ended() == 2
    assert "is private" in refused.err[-1]
    assert "--public" in refused.err[-1]
    allowed = foottile(*words, "--public")
    viewer = Viewer(url_of(allowed))
    until(lambda: allowed.process.poll() is None)
    viewer.close()


def test_the_layout_names_topics_and_fields_that_there_are() -> None:
    text = json.dumps(json.loads((ROOT / "deploy" / "foxglove-layout.json").read_text()))
    named = set(re.findall(r'"/demo/([a-z]+)(?:\.([a-z_]+?)(?:_\d)?)?"', text))
    topics = {topic for topic, _ in named}
    assert topics == {"frames", "foot", "markers"}
    outlet = FoxgloveOutlet("127.0.0.1", 0)
    outlet.close()
    assert {column for _, column in named if column} <= {*outlet.columns}
