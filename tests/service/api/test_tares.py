"""Tares over REST: by hand, undone, in a recording, and their history."""

from __future__ import annotations

import numpy as np
import pytest

from tests.builders.arrays import COUNT_KPA
from tests.service.fake_node import FakeNode
from tests.service.running import Running, assert_refused, content_of, receive_live

URL = "/nodes/bench/tare"


def test_a_tare_under_load_is_refused_with_the_tile(running: Running, tared: FakeNode) -> None:
    # A tare looks back ten seconds.
    tared.next_t_mono_ns += 11_000_000_000
    tared.deliver(300, [0.0, 40.0])
    assert_refused(running.http.post(URL, json={}), 409, "T02", "loaded")
    assert len(running.http.get("/nodes/bench/tares").json()["items"]) == 1


def test_a_tare_is_in_force_until_it_is_undone(running: Running, tared: FakeNode) -> None:
    def measure_n() -> list[float]:
        with running.socket("/api/v1/live?rate_hz=60") as live:
            tared.send(60, 3.0)
            message = receive_live(
                live, lambda each: each["type"] == "frame" and each["seq"] >= tared.seq - 20
            )
            values: list[float] = message["force_n"]
            return values

    by_lead = running.node()["tare"]
    tared.next_t_mono_ns += 11_000_000_000
    tared.send(300, 2.0, alive=True)  # warmer by two counts
    tared.taken_in()
    tare = content_of(running.http.post(URL, json={}), 201)
    assert tare["source"] == "unloaded"
    rise = np.subtract(tare["baseline_kpa"], by_lead["baseline_kpa"])
    assert rise == pytest.approx([2 * COUNT_KPA] * 2, abs=1e-6)
    assert running.node()["tare"]["id"] == tare["id"]
    assert measure_n() == pytest.approx([1.0, 1.0], abs=0.05)
    running.restart()
    assert running.node()["tare"]["id"] == tare["id"]
    tared.connect()
    assert running.http.delete(f"/nodes/bench/tares/{tare['id']}").status_code == 204
    assert running.node()["tare"] == by_lead
    assert measure_n() == pytest.approx([3.0, 3.0], abs=0.05)
    history = running.http.get("/nodes/bench/tares").json()["items"]
    assert [(t["id"], t["undone"]) for t in history] == [(tare["id"], True), (by_lead["id"], False)]
    assert running.http.delete(f"/nodes/bench/tares/{tare['id']}").status_code == 404


def test_a_node_that_is_away_is_not_tared(running: Running, tared: FakeNode) -> None:
    tared.leave()
    assert_refused(running.http.post(URL, json={}), 409, "not connected")


def test_a_tare_in_a_recording_counts_from_then_on(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    tared.deliver(300, 2.0, alive=True, now=True)
    answer = running.http.post(URL, json={})
    assert answer.status_code == 201, answer.text
    tared.deliver(100, 2.0)
    tared.finish(session)
    force_n = session.column("force_n_0")
    assert len(force_n) == 400
    assert force_n[50:200] == pytest.approx(np.full(150, 2.0), abs=0.01)
    assert force_n[330:390] == pytest.approx(np.zeros(60), abs=0.01)
    with session.reader() as file:
        assert [tare["source"] for tare in file.notes["tares"]] == ["lead", "unloaded"]


def test_a_history_has_reasons_and_the_drift(running: Running, node: FakeNode) -> None:
    node.next_t_mono_ns -= 900_000_000_000
    node.connect()
    shown = running.node()
    assert shown["tare"] is None
    assert shown["tare_problem"] == "not tared: lift the foot, hold it still, and tare"
    assert shown["drift"]["kpa_per_hour"] == shown["drift"]["kelvin_since_tare"] == [None, None]
    assert shown["drift"]["grf_n_per_hour"] is None
    node.tared()
    node.next_t_mono_ns += 900_000_000_000  # a quarter of an hour later, one count more
    node.send(300, 1.0, alive=True)
    node.taken_in()
    answer = running.http.post(URL, json={"reason": "  new shoe "})
    assert answer.status_code == 201, answer.text
    assert answer.json()["reason"] == "new shoe"
    assert answer.json()["temperature_raw_counts"] == [480.0, 480.0]
    page = running.http.get("/nodes/bench/tares").json()
    reasons = [(tare["source"], tare["reason"]) for tare in page["items"]]
    assert reasons == [("unloaded", "new shoe"), ("lead", "unloaded lead of the emulation")]
    drift = page["drift"]
    assert drift["kpa_per_hour"] == pytest.approx([4 * 130 / 1023] * 2, rel=0.01)
    assert drift["n_per_hour"] == pytest.approx([4.0, 4.0], rel=0.01)
    assert drift["grf_n_per_hour"] == pytest.approx(8.0, rel=0.01)
    assert drift["kelvin_since_tare"] == [0.0, 0.0]
    shown = running.node()
    assert (shown["drift"], shown["auto_tare"], shown["tare_warnings"]) == (drift, "on", [])
    assert running.http.post(URL, json={"why": "?"}).status_code == 422
    assert running.http.post(URL).status_code in (201, 409)


def test_a_change_of_tares_needs_the_tare_that_its_client_saw(
    running: Running, tared: FakeNode
) -> None:
    seen = running.node()["tare"]["id"]
    headers = {"If-Match": seen}
    tared.deliver(200, alive=True)
    other = running.http.post(URL, headers=headers)
    assert other.status_code == 201, other.text
    assert_refused(running.http.post(URL, headers=headers), 412, "changed by another client")
    undo = f"/nodes/bench/tares/{other.json()['id']}"
    assert_refused(running.http.delete(undo, headers=headers), 412, "changed by another client")
    assert running.node()["tare"]["id"] == other.json()["id"]
    headers = {"If-Match": f'"{other.json()["id"]}"'}
    assert running.http.delete(undo, headers=headers).status_code == 204
    assert running.node()["tare"]["id"] == seen
