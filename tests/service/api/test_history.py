"""History of a node over HTTP: the last seconds of its present stream, reduced."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.service.api.sealed import Sealed
from tests.service.fake_node import FakeNode
from tests.service.running import Running, assert_refused, receive_live
from tests.waiting import until

URL = "/nodes/bench/history"


def get(running: Running, **query: Any) -> dict[str, Any]:
    history: dict[str, Any] = running.http.get(URL, params=query).json()
    return history


def wait_for_frames(running: Running, node: FakeNode) -> None:
    """Wait for all frames but those in the look-ahead."""
    until(lambda: get(running)["seq"][-1] > node.seq - 12)


def test_a_history_has_every_peak(running: Running, tared: FakeNode) -> None:
    before = tared.seq
    assert get(running)["tiles"] is None
    for force_n in ([10.0, 10.0], [10.0, 90.0], [10.0, 10.0]):
        tared.send(1 if force_n[1] > 10.0 else 200, force_n)
    wait_for_frames(running, tared)
    history = get(running)
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
    tiles = get(running, tiles="force_n", seconds=60)["tiles"]
    assert sum(tiles["n"]) == tiles["seq"][-1] + 1
    highs = [max(v for v in tile if v is not None) for tile in zip(*tiles["max"], strict=True)]
    assert highs == pytest.approx([10.0, 90.0], abs=1.0)
    assert all(low is None or low < 95.0 for span in tiles["min"] for low in span)
    kpa = get(running, tiles="gauge_kpa")["tiles"]
    assert max(value for span in kpa["max"] for value in span if value is not None) > 0.0


def test_a_history_ends_where_a_live_message_begins(running: Running, tared: FakeNode) -> None:
    tared.send(500)
    with running.socket("/api/v1/live?rate_hz=10") as live:
        tared.send(300)
        message = receive_live(live, lambda message: message["type"] == "frame")
    first = message["seq_first"]
    assert message["seq"] - first + 1 == message["n"]
    assert get(running, before_seq=first, seconds=60)["seq"][-1] == first - 1


def test_a_new_stream_has_a_new_history(running: Running, tared: FakeNode) -> None:
    assert get(running)["seq"] != []
    tared.restart()
    tared.connect()
    history = get(running)
    assert (history["stream_id"], history["seq"], history["age_ms"]) == (tared.stream_id, [], None)
    tared.send(20)
    until(lambda: get(running)["seq"])


@pytest.mark.parametrize(
    "query", ["seconds=0", "seconds=60.1", "before_seq=-1", "second=5", "tiles=grf_n"]
)
def test_a_wrong_query_is_refused(sealed: Sealed, query: str) -> None:
    answer = sealed.running.http.get(f"{URL}?{query}")
    assert_refused(answer, 422, query.partition("=")[0])
