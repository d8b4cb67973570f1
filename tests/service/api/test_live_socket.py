"""What pages show: the newest frame at their rate, and the last seconds of a node over REST."""

from __future__ import annotations

import json
import logging
import socket as sockets
import time
from typing import Any

import numpy as np
import pytest

import service.server.broadcast.broadcaster
from service.protocol.link import INGEST_PATH
from service.protocol.live import SessionDeleted
from tests.service.api.sealed import Sealed
from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.running import Running, assert_refused, closed, receive_live
from tests.waiting import PATIENCE_S, until

LIVE = "/api/v1/live"


def receive(socket: Any, kind: str) -> dict[str, Any]:
    """Return the next message of a kind."""
    return receive_live(socket, lambda message: message["type"] == kind)


def receive_frame(socket: Any, seq: int) -> dict[str, Any]:
    """Return the first frame from a number on."""
    while (frame := receive(socket, "frame"))["seq"] < seq:
        pass
    return frame


def test_the_first_message_has_nodes_and_recordings(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    with running.socket(LIVE) as live:
        assert live.subprotocol == "foottile.v1"
        hello = json.loads(live.recv(timeout=PATIENCE_S))
    assert (hello["type"], hello["protocol"]) == ("hello", 1)
    assert [node["node"] for node in hello["nodes"]] == ["bench"]
    assert [recording["id"] for recording in hello["recording"]] == [session.id]
    assert abs(hello["t_ns"] - time.time_ns()) < 10e9
    with running.socket(LIVE, subprotocols=None) as live:
        assert json.loads(live.recv(timeout=PATIENCE_S))["type"] == "hello"


def test_a_frame_has_forces_flags_and_age(running: Running, tared: FakeNode) -> None:
    tared.say_clock(0, uncertainty_ns=1000)
    with running.socket(f"{LIVE}?rate_hz=60") as live:
        tared.send(60, [20.0, 60.0], now=True)
        frame = receive_frame(live, tared.seq - 15)
    assert set(frame) >= {
        *("node", "seq", "t_ns", "n", "gauge_kpa", "force_n", "force_min_n", "force_max_n"),
        *("force_sigma_n", "grf_n", "grf_sigma_n", "grf_lower_bound_n", "grf_min_n", "grf_max_n"),
        *("cop_x_m", "cop_y_m", "cop_sigma_x_m", "cop_sigma_y_m", "angle_rad", "servo_age_us"),
        *("tile_flags", "frame_flags", "estimate_flags", "saturated", "contact", "age_ms"),
    }
    assert frame["force_n"] == pytest.approx([20.0, 60.0], abs=0.05)
    assert frame["grf_n"] == pytest.approx(80.0, abs=0.1)
    assert frame["cop_x_m"] == pytest.approx(0.014 * 0.75, abs=1e-4)
    assert frame["cop_y_m"] is frame["cop_sigma_y_m"] is None  # both tiles are in one row
    assert frame["gauge_kpa"] == pytest.approx([20 * 130 / 1023, 60 * 130 / 1023], abs=0.01)
    assert frame["tile_flags"] == [0, 0]
    assert (frame["contact"], frame["saturated"]) == (True, [False, False])
    assert -100 < frame["age_ms"] < 2000


@pytest.mark.real_time
def test_a_heartbeat_comes_each_second(running: Running, tared: FakeNode) -> None:
    with running.socket(LIVE) as live:
        first, second = receive(live, "heartbeat"), receive(live, "heartbeat")
    assert 0.7e9 < second["t_ns"] - first["t_ns"] < 2.5e9
    assert second["last_seq"] == tared.seq - 1
    node = second["nodes"]["bench"]
    assert (node["connected"], node["lost_frames"]) == (True, 0)


def test_a_ping_is_answered(shared: Running) -> None:
    with shared.socket(LIVE) as live:
        for t_ms in (9007199254740993, 12.5):  # no float is the first
            live.send(json.dumps({"type": "ping", "t_ms": t_ms}))
            pong = receive(live, "pong")
            assert (pong["t_ms"], type(pong["t_ms"])) == (t_ms, type(t_ms))
    assert abs(pong["t_ns"] - time.time_ns()) < 10e9


@pytest.mark.parametrize(
    "message",
    [
        *("", "ping", b'{"type":"ping","t_ms":1}', "[]", "{}", '{"type":"pong"}', "[" * 900),
        '{"type":"ping"}',
        *(f'{{"type":"ping","t_ms":{value}}}' for value in ('"1"', "NaN", "Infinity", "1e400")),
        '{"type":"ping","t_ms":' + "1" * 900 + "}",
        '{"type":"ping","t_ms":1,"x":"' + "x" * 2000 + '"}',
        '{"type":"ping","t_ms":1}' + " " * 2000,
        '{"type":"ping","t_ms":1}' + " " * 1000 + "junk",
    ],
    ids=lambda message: repr(message[:30]),
)
def test_any_message_but_a_ping_closes(shared: Running, message: str | bytes) -> None:
    with shared.socket(LIVE) as live, shared.socket(LIVE) as other:
        live.send(message)
        code, reason = closed(live)
        assert (code, "ping" in reason) == (1008, True)
        other.send('{"type":"ping","t_ms":1}')
        receive(other, "pong")


@pytest.mark.parametrize("path", [LIVE, INGEST_PATH])
@pytest.mark.parametrize("message", [b"\xff\xfe", [b"{", b"\xff}"]], ids=["one", "fragments"])
def test_a_text_that_is_no_utf8_closes_and_is_no_fault_of_the_server(
    shared: Running, path: str, message: bytes | list[bytes], caplog: pytest.LogCaptureFixture
) -> None:
    with shared.socket(path) as socket:
        socket.send(message, text=True)
        assert closed(socket) == (1007, "a text is no UTF-8")
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []


@pytest.mark.parametrize(
    ("query", "word"),
    [
        ("speed=3", "unknown parameter 'speed'; known: format, policy, node, rate_hz"),
        ("format=xml", "format='xml': expected json or arrow"),
        ("policy=all", "policy='all': expected latest; others need format=arrow"),
        *[
            (f"rate_hz={value}", f"rate_hz='{value}': expected 1 to 60")
            for value in ("0", "61", "nan", "fast", "")
        ],
        ("node=nobody", "'nobody'"),
        ("node=" + "x" * 500, "no node"),
        ("%F0%9F%98%80" * 60 + "=1", "unknown parameter"),
    ],
)
def test_a_wrong_query_closes_with_a_reason(shared: Running, query: str, word: str) -> None:
    with shared.socket(f"{LIVE}?{query}") as live:
        code, reason = closed(live)
    assert code == 1008
    assert word in reason


def test_only_the_requested_node_is_shown(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    other = node_of(running, "other")
    other.connect()
    other.send(20)
    with running.socket(f"{LIVE}?node=bench&rate_hz=60") as live:
        hello = json.loads(live.recv(timeout=PATIENCE_S))
        assert [node["node"] for node in hello["nodes"]] == ["bench"]
        other.send(20)
        other.taken_in()
        tared.send(20)
        assert receive(live, "frame")["node"] == "bench"


@pytest.mark.real_time
def test_a_subscriber_that_does_not_read_is_disconnected_and_delays_no_other(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
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
        # The buffers of kernel and server have to fill.
        notice = SessionDeleted(session_id="x" * 200_000)
        end_s = time.monotonic() + PATIENCE_S
        received_s = []
        while running.server.broadcaster.subscriber_count == 2:
            assert time.monotonic() < end_s, "it is never disconnected"
            running.call(lambda: running.server.broadcaster.queue_notice(notice))
            receive(live, "frame")
            received_s.append(time.monotonic())
        # A server that waits for the slow one sends nothing meanwhile. A single long gap may be
        # that of a busy machine.
        behind_since_s = time.monotonic() - too_slow_s
        assert sum(at_s > behind_since_s for at_s in received_s) > 5
        tared.acknowledged(tared.seq - 1)
        assert playing.problem is None
        assert running.node()["lost_frames"] == 0


@pytest.mark.real_time
def test_a_late_subscriber_gets_a_frame_at_once(running: Running, tared: FakeNode) -> None:
    with Play(tared, 10.0):
        with running.socket(LIVE) as early:
            receive_frame(early, 100)
        with running.socket(LIVE) as late:
            begin_s = time.monotonic()
            (node,) = json.loads(late.recv(timeout=PATIENCE_S))["nodes"]
            assert node["tare"] is not None
            frame = receive(late, "frame")
            assert time.monotonic() - begin_s < 0.5
        assert frame["seq"] > node["last_seq"] - 20
        assert frame["force_n"] == pytest.approx([10.0, 10.0], abs=0.5)


def test_notices_follow_nodes_and_sessions(running: Running, tared: FakeNode) -> None:
    with running.socket(LIVE) as live:
        receive(live, "hello")
        session = tared.record()
        notice = receive(live, "session")["session"]
        assert (notice["id"], notice["state"]) == (session.id, "recording")
        running.http.patch(session.url, json={"name": "y"})
        while receive(live, "session")["session"]["name"] != "y":
            pass
        tared.leave()
        while receive(live, "node")["node"]["connected"]:
            pass
        tared.connect()
        while not receive(live, "node")["node"]["connected"]:
            pass
        running.stop()
        assert closed(live)[0] in (1001, 1012)


# --- the last seconds of a node -------------------------------------------------------------------


HISTORY_URL = "/nodes/bench/history"


def get_history(running: Running, **query: Any) -> dict[str, Any]:
    history: dict[str, Any] = running.http.get(HISTORY_URL, params=query).json()
    return history


def wait_for_frames(running: Running, node: FakeNode) -> None:
    """Wait for all frames but those in the look-ahead."""
    until(lambda: get_history(running)["seq"][-1] > node.seq - 12)


def test_a_history_has_every_peak(running: Running, tared: FakeNode) -> None:
    before = tared.seq
    assert get_history(running)["tiles"] is None
    for force_n in ([10.0, 10.0], [10.0, 90.0], [10.0, 10.0]):
        tared.send(1 if force_n[1] > 10.0 else 200, force_n)
    wait_for_frames(running, tared)
    history = get_history(running)
    assert (history["node"], history["stream_id"]) == ("bench", tared.stream_id)
    assert history["seq_first"][0] == 0
    assert sum(history["n"]) == history["seq"][-1] + 1
    assert np.array_equal(np.array(history["seq_first"][1:]), np.array(history["seq"][:-1]) + 1)
    peaks = zip(history["seq"], history["grf_max_n"], strict=True)
    pressed = [high for seq, high in peaks if seq > before + 20 and high is not None]
    assert max(pressed) > 40.0
    assert min(pressed) == pytest.approx(20.0, abs=1.0)
    tared.send(100, [10.0, 90.0])
    wait_for_frames(running, tared)
    tiles = get_history(running, tiles="force_n", seconds=60)["tiles"]
    assert sum(tiles["n"]) == tiles["seq"][-1] + 1
    highs = [max(v for v in tile if v is not None) for tile in zip(*tiles["max"], strict=True)]
    assert highs == pytest.approx([10.0, 90.0], abs=1.0)
    assert all(low is None or low < 95.0 for span in tiles["min"] for low in span)
    kpa = get_history(running, tiles="gauge_kpa")["tiles"]
    assert max(value for span in kpa["max"] for value in span if value is not None) > 0.0


def test_a_new_stream_has_a_new_history(running: Running, tared: FakeNode) -> None:
    assert get_history(running)["seq"] != []
    tared.restart()
    tared.connect()
    history = get_history(running)
    assert (history["stream_id"], history["seq"], history["age_ms"]) == (tared.stream_id, [], None)
    tared.send(20)
    until(lambda: get_history(running)["seq"])


@pytest.mark.parametrize(
    "query", ["seconds=0", "seconds=60.1", "before_seq=-1", "second=5", "tiles=grf_n"]
)
def test_a_wrong_query_is_refused(sealed: Sealed, query: str) -> None:
    answer = sealed.running.http.get(f"{HISTORY_URL}?{query}")
    assert_refused(answer, 422, query.partition("=")[0])
