"""The array of a session over REST: what its foot is drawn from."""

from __future__ import annotations

import pytest

from service.estimation import LIVE_LAG_MS, OFFLINE_LAG_MS
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, assert_refused


def test_a_session_says_where_its_tiles_are_and_how_its_forces_were_estimated(
    running: Running, tared: FakeNode
) -> None:
    node = running.node()
    session = tared.record()
    tared.deliver(50, [20.0, 60.0])
    recording = running.http.get(f"{session.url}/tiles").json()
    tared.finish(session)
    sealed = running.http.get(f"{session.url}/tiles").json()
    for said in (recording, sealed):
        assert said["tiles"] == node["tiles"]
        assert said["servo"] == node["servo"]
        assert said["calibration"] == node["calibration"]
        assert said["node"] == node["node"]
        assert said["nominal_rate_hz"] == node["nominal_rate_hz"]
        assert said["estimates_problem"] is None
        tare = node["tare"]
        assert said["tares"] == [{"t_ns": tare["t_ns"], "source": tare["source"]}]
    assert (recording["lag_ms"], sealed["lag_ms"]) == (LIVE_LAG_MS, OFFLINE_LAG_MS)
    assert sealed["tiles"][0]["full_scale_n"] == pytest.approx(node["tiles"][0]["full_scale_n"])
    assert sealed["tiles"][0]["full_scale_n"] > 0


def test_without_a_calibration_it_says_why_there_are_no_forces(
    running: Running, node_of: NodeOf
) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.send(10)
    node.taken_in()
    session = node.record()
    node.deliver(50, [0.0, 30.0])
    node.finish(session)
    said = running.http.get(f"{session.url}/tiles").json()
    assert said["calibration"] is None
    assert said["lag_ms"] is None
    assert said["estimates_problem"] == "the node had no calibration"
    assert [tile["full_scale_n"] for tile in said["tiles"]] == [None, None]
    assert [tile["serial"] for tile in said["tiles"]] == list(node.info.serials)


def test_of_a_session_that_is_not_there_there_is_no_array(running: Running) -> None:
    assert_refused(running.http.get("/sessions/none/tiles"), 404, "none")
