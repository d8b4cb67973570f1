"""The live websocket: the newest frame at a screen's own pace, and nobody waits for a slow one."""

from __future__ import annotations

import json
import socket as sockets
import time
from typing import Any

import pytest

import service.server.broadcast.broadcaster
from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.running import Running, closed
from tests.waiting import PATIENCE_S, until

LIVE = "/api/v1/live"


def next_of(socket: Any, kind: str, timeout_s: float = PATIENCE_S) -> dict[str, Any]:
    end_s = time.monotonic() + timeout_s
    while True:
        message: dict[str, Any] = json.loads(
            socket.recv(timeout=max(0.0, end_s - time.monotonic()))
        )
        if message["type"] == kind:
            return message


def next_frame_from(socket: Any, seq: int) -> dict[str, Any]:
    while (frame := next_of(socket, "frame"))["seq"] < seq:
        pass
    return frame


def test_hello_comes_first_and_says_who_is_there(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    with running.socket(LIVE) as live:
        assert live.subprotocol == "foottile.v1"
        hello = json.loads(live.recv(timeout=PATIENCE_S))
    assert hello["type"] == "hello"
    assert hello["protocol"] == 1
    assert [node["node"] for node in hello["nodes"]] == ["bench"]
    assert [recording["id"] for recording in hello["recording"]] == [session.id]
    assert abs(hello["t_ns"] - time.time_ns()) < 10e9


def test_a_screen_may_offer_no_subprotocol(running: Running) -> None:
    with running.socket(LIVE, subprotocols=None) as live:
        assert json.loads(live.recv(timeout=PATIENCE_S))["type"] == "hello"


def test_a_frame_has_what_the_contract_says(running: Running, tared: FakeNode) -> None:
    with running.socket(f"{LIVE}?rate_hz=60") as live:
        tared.send(60, [20.0, 60.0])
        frame = next_frame_from(live, tared.seq - 15)
    assert set(frame) >= {
        *("node", "seq", "t_ns", "n", "gauge_kpa", "force_n", "force_min_n", "force_max_n"),
        *(
            "force_sigma_n",
            "grf_n",
            "grf_sigma_n",
            "grf_lower_bound_n",
            "grf_min_n",
            "grf_max_n",
            "cop_x_m",
            "cop_y_m",
        ),
        *("cop_sigma_x_m", "cop_sigma_y_m", "angle_rad", "servo_age_us", "tile_flags"),
        *("frame_flags", "estimate_flags", "saturated", "contact", "age_ms"),
    }
    assert frame["force_n"] == pytest.approx([20.0, 60.0], abs=0.05)
    assert frame["grf_n"] == pytest.approx(80.0, abs=0.1)
    assert frame["cop_x_m"] == pytest.approx(0.014 * 0.75, abs=1e-4)
    assert frame["cop_y_m"] is frame["cop_sigma_y_m"] is None  # both tiles are in one row
    assert frame["gauge_kpa"] == pytest.approx([20 * 130 / 1023, 60 * 130 / 1023], abs=0.01)
    assert frame["tile_flags"] == [0, 0]
    assert frame["contact"] is True
    assert frame["saturated"] == [False, False]
    assert frame["age_ms"] > 0


def test_the_age_of_a_frame_is_known_once_the_clocks_are(running: Running, tared: FakeNode) -> None:
    tared.say_clock(0, uncertainty_ns=1000)
    with running.socket(f"{LIVE}?rate_hz=60") as live:
        tared.send(30, now=True)
        frame = next_frame_from(live, tared.seq - 15)
    assert -100 < frame["age_ms"] < 2000


@pytest.mark.real_time
def test_frames_come_at_the_rate_that_was_asked_for(running: Running, tared: FakeNode) -> None:
    with running.socket(f"{LIVE}?rate_hz=20") as live, Play(tared, 10.0):
        next_frame_from(live, tared.seq)
        frames = [next_of(live, "frame") for _ in range(20)]
    # By the node's clock: where this process is late, several come at once.
    assert 0.7e9 < frames[-1]["t_ns"] - frames[0]["t_ns"] < 2.0e9
    assert (
        sum(frame["n"] for frame in frames)
        == frames[-1]["seq"] - frames[0]["seq"] + (frames[0]["n"])
    )


def test_a_spike_of_one_frame_between_two_messages_is_not_hidden(
    running: Running, tared: FakeNode
) -> None:
    with running.socket(f"{LIVE}?rate_hz=1") as live:
        tared.send(10)
        next_of(live, "frame")
        # For a second it is told nothing; then all of this in one.
        for force_n in (10.0, [10.0, 90.0], 10.0):
            n = 1 if isinstance(force_n, list) else 40
            tared.send(n, force_n)
        frame = next_frame_from(live, tared.seq - 10)
    assert frame["n"] > 60
    assert frame["force_n"] == pytest.approx([10.0, 10.0], abs=0.5)
    assert frame["force_max_n"][1] > 30.0
    assert frame["grf_max_n"] > 40.0
    assert frame["force_max_n"][0] < 15.0


@pytest.mark.real_time
def test_a_heartbeat_comes_each_second(running: Running, tared: FakeNode) -> None:
    with running.socket(LIVE) as live:
        first, second = next_of(live, "heartbeat"), next_of(live, "heartbeat")
    assert 0.7e9 < second["t_ns"] - first["t_ns"] < 2.5e9
    assert second["last_seq"] == tared.seq - 1
    assert second["nodes"]["bench"]["connected"] is True
    assert second["nodes"]["bench"]["lost_frames"] == 0


def test_a_ping_is_answered(running: Running) -> None:
    with running.socket(LIVE) as live:
        live.send('{"type":"ping","t_ms":12.5}')
        pong = next_of(live, "pong")
    assert pong["t_ms"] == 12.5
    assert abs(pong["t_ns"] - time.time_ns()) < 10e9


@pytest.mark.parametrize(
    "message",
    [
        "",
        "ping",
        b'{"type":"ping","t_ms":1}',
        "[]",
        "{}",
        '{"type":"pong"}',
        '{"type":"ping"}',
        '{"type":"ping","t_ms":"1"}',
        '{"type":"ping","t_ms":NaN}',
        '{"type":"ping","t_ms":Infinity}',
        '{"type":"ping","t_ms":1e400}',
        '{"type":"ping","t_ms":' + "1" * 900 + "}",
        '{"type":"ping","t_ms":1,"x":"' + "x" * 2000 + '"}',
        "[" * 900,
    ],
    ids=lambda message: repr(message[:30]),
)
def test_anything_but_a_ping_closes(running: Running, message: str | bytes) -> None:
    with running.socket(LIVE) as live, running.socket(LIVE) as other:
        live.send(message)
        code, reason = closed(live)
        assert code == 1008
        assert "ping" in reason
        other.send('{"type":"ping","t_ms":1}')
        next_of(other, "pong")


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("speed=3", "'speed'"),
        ("format=xml", "format='xml'"),
        ("policy=all", "policy='all'"),
        ("rate_hz=0", "1 to 60"),
        ("rate_hz=61", "1 to 60"),
        ("rate_hz=nan", "1 to 60"),
        ("rate_hz=fast", "1 to 60"),
        ("rate_hz=", "1 to 60"),
        ("node=nobody", "'nobody'"),
        ("node=" + "x" * 500, "no node"),
        ("%F0%9F%98%80" * 60 + "=1", "unknown parameter"),
    ],
)
def test_a_query_that_is_none_closes_with_the_reason(
    running: Running, query: str, said: str
) -> None:
    with running.socket(f"{LIVE}?{query}") as live:
        code, reason = closed(live)
    assert code == 1008
    assert said in reason


def test_only_the_node_that_was_asked_for_is_shown(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    other = node_of(running, "other")
    other.connect()
    other.send(20)
    with running.socket(f"{LIVE}?node=bench&rate_hz=60") as live:
        hello = json.loads(live.recv(timeout=PATIENCE_S))
        assert [node["node"] for node in hello["nodes"]] == ["bench"]
        other.send(20)
        until(lambda: running.node("other")["last_seq"] == 39)
        tared.send(20)
        assert next_of(live, "frame")["node"] == "bench"


@pytest.mark.real_time
def test_a_screen_that_never_reads_is_let_go_and_delays_nobody(
    running: Running,
    tared: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    too_slow_s = 3.0
    monkeypatch.setattr(service.server.broadcast.broadcaster, "TOO_SLOW_S", too_slow_s)
    slow = sockets.socket()
    slow.setsockopt(sockets.SOL_SOCKET, sockets.SO_RCVBUF, 2048)
    slow.connect(("127.0.0.1", running.port))
    slow.sendall(
        f"GET {LIVE}?rate_hz=60 HTTP/1.1\r\nHost: 127.0.0.1:{running.port}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
    )
    with slow, running.socket(f"{LIVE}?rate_hz=60") as live, Play(tared, 10.0) as playing:
        until(lambda: running.server.broadcaster.subscriber_count == 2)
        # Buffers of the kernel and of the server fill first: give it more to say.
        notice = {"type": "node", "node": {"padding": "x" * 200_000}}
        end_s = time.monotonic() + 15.0
        told_s = []
        while running.server.broadcaster.subscriber_count == 2:
            assert time.monotonic() < end_s, "it is never let go"
            running.call(lambda: running.server.broadcaster.queue_droppable_notice(notice))
            next_of(live, "frame")
            told_s.append(time.monotonic())
        # Who waited for it would have told nothing while it was waited for. One long gap says
        # something about a busy machine, not about this.
        behind_since_s = time.monotonic() - too_slow_s
        assert sum(at_s > behind_since_s for at_s in told_s) > 5
        last = tared.seq - 1
        tared.acknowledged(last)
        assert playing.problem is None
        assert running.node()["lost_frames"] == 0


@pytest.mark.real_time
def test_who_joins_late_sees_the_picture_at_once(running: Running, tared: FakeNode) -> None:
    with Play(tared, 10.0):
        with running.socket(LIVE) as early:
            next_frame_from(early, 100)
        with running.socket(LIVE) as late:
            begin_s = time.monotonic()
            hello = json.loads(late.recv(timeout=PATIENCE_S))
            assert hello["nodes"][0]["tare"] is not None
            frame = next_of(late, "frame")
            assert time.monotonic() - begin_s < 0.5
        assert frame["seq"] > hello["nodes"][0]["last_seq"] - 20
        assert frame["force_n"] == pytest.approx([10.0, 10.0], abs=0.5)


def test_a_node_that_leaves_and_returns_is_told(running: Running, tared: FakeNode) -> None:
    with running.socket(LIVE) as live:
        json.loads(live.recv(timeout=PATIENCE_S))
        tared.leave()
        while next_of(live, "node")["node"]["connected"]:
            pass
        tared.connect()
        while not next_of(live, "node")["node"]["connected"]:
            pass


def test_a_session_is_told_from_start_to_stop(running: Running, tared: FakeNode) -> None:
    with running.socket(LIVE) as live:
        session = tared.record()
        told = next_of(live, "session")["session"]
        assert (told["id"], told["state"]) == (session.id, "recording")
        running.http.patch(session.url, json={"name": "y"})
        while next_of(live, "session")["session"]["name"] != "y":
            pass


def test_frames_that_were_lost_on_the_way_are_told(running: Running, tared: FakeNode) -> None:
    with running.socket(f"{LIVE}?rate_hz=60") as live:
        tared.send(30)
        next_frame_from(live, tared.seq - 15)
        tared.frames(25)
        tared.send(30)
        dropped = next_of(live, "dropped")
    assert dropped["node"] == "bench"
    assert (dropped["from_seq"], dropped["to_seq"]) == (100, 124)


def test_without_a_tare_a_frame_has_its_status_and_no_forces(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    with running.socket(LIVE) as live:
        node.send(20, 5.0)
        frame = next_of(live, "frame")
    assert frame["force_n"] == [None, None]
    assert frame["grf_n"] is None
    assert frame["contact"] is None
    assert frame["tile_flags"] == [0, 0]


def test_a_server_that_ends_lets_its_screens_go(running: Running) -> None:
    with running.socket(LIVE) as live:
        next_of(live, "hello")
        running.stop()
        code, _ = closed(live)
    assert code in (1001, 1012)
