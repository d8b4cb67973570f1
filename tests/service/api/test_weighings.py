"""Guided calibrations over REST: who may, what is refused, what is withdrawn, and how they end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, cast

import pytest

from service.api.routes.weighings import WeighingResultView
from service.estimation.dead_weights import parse_weight
from service.server import weighing, weighings
from tests.builders.arrays import make_array
from tests.builders.calibrations import make_calibration, newton_tile
from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.running import Running, ServeWith, assert_refused
from tests.waiting import until

URL = "/nodes/bench/weighing"
FIVE_N = ["10 N", "20 N", "40 N", "60 N", "80 N"]
TOKEN = "a-token-of-this-test"  # noqa: S105  # of this test
STEP_S = 2.5
"""A fit takes steps of 2 s or more."""


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("REST_S", "HOLD_S"):
        monkeypatch.setattr(weighing, name, STEP_S)


def started(running: Running, **body: object) -> dict[str, Any]:
    answer = running.http.post(URL, json={"tiles": ["T01"], "weights": FIVE_N} | body)
    assert answer.status_code == 201, answer.text
    content: dict[str, Any] = answer.json()
    return content


def now(running: Running) -> dict[str, Any]:
    found: dict[str, Any] = running.http.get(URL).json()["weighing"]
    return found


def is_closed(running: Running) -> bool:
    return bool(running.http.get(URL).json() == {"node": "bench", "weighing": None})


def labels(running: Running, session_id: str) -> list[str]:
    items = running.http.get(f"/sessions/{session_id}/markers").json()["items"]
    return [item["label"] for item in items]


@contextmanager
def followed(
    node: FakeNode, put_on_n: Callable[[float], float] = float
) -> Iterator[Callable[[str], dict[str, Any]]]:
    """Somebody who puts on what the server asks for, or another force; gives a wait for a state."""

    with Play(node, alive=True) as play:

        def wait_for(state: str) -> dict[str, Any]:
            end_s = time.monotonic() + 120.0
            while (found := now(node.running))["state"] != state:
                assert time.monotonic() < end_s, found
                if found["prompt"].startswith("Put "):
                    weight = parse_weight(found["weights"][len(_tile(found)["held"])])
                    assert weight is not None
                    play.force_n = put_on_n(weight.force_n)
                elif found["step"] == "empty":
                    play.force_n = 0.0
                time.sleep(0.05)
            return found

        yield wait_for


def _tile(found: dict[str, Any]) -> dict[str, Any]:
    tile: dict[str, Any] = next(one for one in found["tiles"] if one["serial"] == found["tile"])
    return tile


@pytest.mark.slow
def test_tiles_are_calibrated_one_after_the_other_and_the_node_can_use_it(
    running: Running, tared: FakeNode
) -> None:
    with followed(tared) as wait_for:
        began = started(running, tiles=["T02", "T01"], within_percent=0.5, name="left leg")
        assert began["prompt"] == "Take everything off T02"
        done = wait_for("done")
    result = done["result"]
    assert (result["name"], result["refused"], result["misfit"]) == ("left leg", {}, None)
    for tile in result["tiles"]:
        assert [row["weight"] for row in tile["weights"]] == [f"{n} +-0.5 %" for n in FIVE_N]
        assert tile["weights"][-1]["residual_n"] == pytest.approx(0.0, abs=1.0)  # a count
        assert tile["band"][-1]["force_n"] == pytest.approx(80.0, abs=1.0)
    marked = labels(running, done["session_id"])
    assert len(marked) == 2 * len(FIVE_N) * 4
    assert marked[:4] == ["T02 rest", "end", "T02 10 N +-0.5 %", "end"]
    assert running.http.get(f"/sessions/{done['session_id']}").json()["tags"] == ["calibration"]
    used = running.http.put("/nodes/bench/calibration", json={"id": result["calibration_id"]})
    assert used.json()["calibration"]["name"] == "left leg"
    assert running.http.delete(URL).status_code == 204
    assert is_closed(running)


def test_a_result_of_one_tile_says_what_it_does_not_cover() -> None:
    node = SimpleNamespace(last_info=make_array(2))
    view = WeighingResultView.of(make_calibration(newton_tile("T01")), cast("Any", node))
    assert view.misfit is not None
    assert view.misfit.startswith("it covers T01, but not T02. Calibrate all tiles in one go, or ")


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ({"tiles": ["T77"]}, "no tile T77 that bears load; expected one of T01, T02"),
        ({"tiles": ["T01", "T01"]}, "named twice"),
        ({"weights": FIVE_N[:4]}, "4 weights on the tile"),
        ({"weights": ["1 kg"] * 5}, "1 of them different"),
        ({"weights": [*FIVE_N, "much"]}, "'much' is no weight"),
        ({"weights": [*FIVE_N, "0 g"]}, "'0 g' is no weight"),
        ({"weights": FIVE_N * 13}, "at most 60"),
        ({"within_percent": -1}, "within_percent"),
        ({"method": "scales"}, "method"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_what_cannot_become_a_curve_is_refused_before_the_first_weight(
    running: Running, tared: FakeNode, body: dict[str, Any], says: str
) -> None:
    answer = running.http.post(URL, json={"tiles": ["T01"], "weights": FIVE_N} | body)
    assert_refused(answer, 422, says)
    assert is_closed(running)
    assert running.sessions() == []


def test_one_at_a_time_on_a_node_and_another_one_is_not_ended(
    running: Running, tared: FakeNode
) -> None:
    with Play(tared, alive=True):
        first = started(running)
        again = running.http.post(URL, json={"tiles": ["T02"], "weights": FIVE_N})
        assert_refused(again, 409, "being calibrated by somebody")
        for method, url in (("DELETE", URL), ("POST", f"{URL}/repeat")):
            assert running.http.request(method, url, headers={"If-Match": '"x"'}).status_code == 412
        trial = running.record()  # others record meanwhile
        assert running.http.delete(URL, headers={"If-Match": first["session_id"]}).is_success
        assert is_closed(running)
        until(lambda: running.session(first["session_id"]).now()["state"] != "recording")
        assert trial.now()["state"] == "recording"
        assert started(running)["session_id"] != first["session_id"]
    for method, url in (("DELETE", "/nodes/none/weighing"), ("GET", "/nodes/none/weighing")):
        assert running.http.request(method, url).status_code == 404


def test_a_weight_is_repeated_by_hand_and_its_markers_are_gone(
    running: Running, tared: FakeNode
) -> None:
    with Play(tared, alive=True) as play:
        id_ = started(running)["session_id"]
        until(lambda: now(running)["step"] == "put on")
        play.force_n = 20.0
        until(lambda: now(running)["tiles"][0]["held"])
        play.force_n = 0.0
        until(lambda: now(running)["step"] == "resting")
        assert labels(running, id_) == ["T01 rest", "end", "T01 10 N +-1 %", "end", "T01 rest"]
        answer = running.http.post(f"{URL}/repeat").json()
        assert (answer["tiles"][0]["held"], answer["warning"]) == ([], "repeated by hand")
        assert labels(running, id_) == ["T01 rest", "end"]


def test_one_without_progress_ends_by_itself_and_says_what_to_do(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weighings, "IDLE_S", 1.0)
    with Play(tared, 5.0, alive=True):
        id_ = started(running)["session_id"]  # a rest takes longer
        until(lambda: now(running)["state"] == "failed")
        assert "no step was completed" in now(running)["problem"]
        assert "Repeat when you are at the foot" in now(running)["problem"]
        until(lambda: running.session(id_).now()["state"] != "recording")
        assert_refused(running.http.post(f"{URL}/repeat"), 409, "has ended")
        started(running)


def test_it_ends_when_its_node_leaves_and_when_it_is_restarted(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Play(tared, alive=True):
        started(running)
    tared.restart()
    tared.connect()
    until(lambda: now(running)["state"] == "failed")
    assert "was restarted" in now(running)["problem"]
    monkeypatch.setattr(weighings, "AWAY_S", 0.5)
    with Play(tared, alive=True):
        until(lambda: running.node()["last_seq"] is not None)
        started(running)
    until(lambda: now(running)["state"] == "failed")
    assert "has sent nothing" in now(running)["problem"]


@pytest.mark.slow
def test_a_refused_fit_shows_its_reason(running: Running, tared: FakeNode) -> None:
    with followed(tared, lambda force_n: min(force_n, 40.0)) as wait_for:
        id_ = started(running)["session_id"]
        found = wait_for("failed")
    assert "expected a pressure that rises with the weight" in found["problem"]
    assert "Check what each weight is" in found["problem"]
    assert running.session(id_).now()["state"] == "sealed"
    assert found["result"] is None


def test_a_viewer_sees_it_and_cannot_act(serve_with: ServeWith, node_of: NodeOf) -> None:
    running = serve_with(token=TOKEN)
    node = node_of(running, token=TOKEN)
    node.connect()
    node.tared()
    own = {"Authorization": f"Bearer {TOKEN}"}
    with Play(node, alive=True):
        answer = running.http.post(URL, json={"tiles": ["T01"], "weights": FIVE_N})
        assert answer.status_code == 401
        running.http.post(URL, json={"tiles": ["T01"], "weights": FIVE_N}, headers=own)
        assert now(running)["state"] == "weighing"
        assert running.http.delete(URL).status_code == 401


def test_it_ends_when_somebody_stops_its_recording(running: Running, tared: FakeNode) -> None:
    with Play(tared, alive=True):
        running.http.post(f"/sessions/{started(running)['session_id']}/stop")
        until(lambda: now(running)["state"] == "failed")
    assert "its recording was stopped" in now(running)["problem"]


def test_markers_have_the_instants_of_frames_that_come_late(
    running: Running, tared: FakeNode
) -> None:
    tared.next_t_mono_ns = time.monotonic_ns() - 1_500_000_000
    tared.deliver(20, alive=True)
    id_ = started(running)["session_id"]
    while not (events := running.http.get(f"/sessions/{id_}/markers").json()["items"]):
        tared.deliver(20, alive=True)
    assert events[0]["t_ns"] <= running.node()["last_t_ns"]


def test_a_server_that_ends_stops_the_recording(running: Running, tared: FakeNode) -> None:
    with Play(tared, alive=True):
        id_ = started(running)["session_id"]
        running.stop()
    running.start()
    assert running.session(id_).now()["state"] != "recording"
