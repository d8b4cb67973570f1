"""What screens were told lately, over HTTP: of the present stream, with gaps as gaps."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from tests.service.fake_node import FakeNode
from tests.service.running import Running, assert_refused
from tests.waiting import PATIENCE_S, until

RECENT = "/nodes/bench/history"


def test_a_peak_that_nobody_watched_is_in_it(running: Running, tared: FakeNode) -> None:
    before = tared.seq
    for force_n in (10.0, [10.0, 90.0], 10.0):
        tared.send(1 if isinstance(force_n, list) else 200, force_n)
    until(lambda: running.http.get(RECENT).json()["seq"][-1] > tared.seq - 12)
    recent = running.http.get(RECENT).json()
    assert (recent["node"], recent["stream_id"]) == ("bench", tared.stream_id)
    assert recent["seq_first"][0] == 0
    assert sum(recent["n"]) == recent["seq"][-1] + 1
    assert np.array_equal(np.array(recent["seq_first"][1:]), np.array(recent["seq"][:-1]) + 1)
    pressed = [
        high
        for seq, high in zip(recent["seq"], recent["grf_max_n"], strict=True)
        if seq > before + 20 and high is not None
    ]
    assert max(pressed) > 40.0
    assert min(pressed) == pytest.approx(20.0, abs=1.0)


def test_it_ends_where_a_live_message_begins(running: Running, tared: FakeNode) -> None:
    tared.send(500)
    with running.socket("/api/v1/live?rate_hz=10") as live:
        tared.send(300)
        message: dict[str, Any] = {"type": ""}
        while message["type"] != "frame":
            message = json.loads(live.recv(timeout=PATIENCE_S))
    first = message["seq_first"]
    assert message["seq"] - first + 1 == message["n"]
    recent = running.http.get(RECENT, params={"before_seq": first, "seconds": 60}).json()
    assert recent["seq"][-1] == first - 1


def test_each_tile_is_in_it_if_that_is_asked_for(running: Running, tared: FakeNode) -> None:
    assert running.http.get(RECENT).json()["tiles"] is None
    for force_n in ([10.0, 20.0], [10.0, 90.0], [10.0, 20.0]):
        tared.send(100, force_n)
    until(lambda: running.http.get(RECENT).json()["seq"][-1] > tared.seq - 12)
    tiles = running.http.get(RECENT, params={"tiles": "force_n", "seconds": 60}).json()["tiles"]
    assert sum(tiles["n"]) == tiles["seq"][-1] + 1
    highs = [
        [value for value in tile if value is not None] for tile in zip(*tiles["max"], strict=True)
    ]
    assert [max(tile) for tile in highs] == pytest.approx([10.0, 90.0], abs=1.0)
    assert all(low is None or low < 95.0 for span in tiles["min"] for low in span)
    kpa = running.http.get(RECENT, params={"tiles": "gauge_kpa"}).json()["tiles"]
    assert max(value for span in kpa["max"] for value in span if value is not None) > 0.0


def test_frames_that_are_missing_are_missing_in_it(running: Running, tared: FakeNode) -> None:
    missing = tared.frames(100)
    tared.send(100)
    tared.taken_in()
    first, last = int(missing.seq[0]), int(missing.seq[-1])
    recent = running.http.get(RECENT).json()
    assert sum(recent["n"]) == recent["seq"][-1] + 1 - 100
    assert last + 1 in recent["seq_first"]
    assert not any(
        a <= seq <= b
        for a, b in zip(recent["seq_first"], recent["seq"], strict=True)
        for seq in (first, last)
    )


def test_another_stream_is_another_story(running: Running, tared: FakeNode) -> None:
    assert running.http.get(RECENT).json()["seq"] != []
    tared.restart()
    tared.connect()
    recent = running.http.get(RECENT).json()
    assert (recent["stream_id"], recent["seq"], recent["age_ms"]) == (tared.stream_id, [], None)
    tared.send(20)
    until(lambda: running.http.get(RECENT).json()["seq"])


@pytest.mark.parametrize(
    "query", ["seconds=0", "seconds=60.1", "before_seq=-1", "second=5", "tiles=grf_n"]
)
def test_what_cannot_be_asked_is_refused(running: Running, tared: FakeNode, query: str) -> None:
    assert_refused(running.http.get(f"{RECENT}?{query}"), 422, query.partition("=")[0])


def test_a_node_that_nobody_knows_has_no_past(running: Running) -> None:
    assert_refused(running.http.get("/nodes/nobody/history"), 404, "nobody")
