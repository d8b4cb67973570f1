"""Guided calibrations over REST: rights, refusals, repeated weights, and their ends."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from types import SimpleNamespace
from typing import Any, cast

import pytest

from service.api.routes.weighings import WeighingResultView
from service.estimation.dead_weights import parse_weight
from service.server import weighing, weighings
from tests.builders.arrays import make_array
from tests.builders.calibrations import make_calibration, newton_tile
from tests.service.api.access import BEARER, TOKEN
from tests.service.api.sealed import Sealed
from tests.service.fake_node import FakeNode, Play
from tests.service.running import Running, assert_refused, content_of
from tests.waiting import until

URL = "/nodes/bench/weighing"
WEIGHTS = ["10 N", "20 N", "40 N", "60 N", "80 N"]
BODY: dict[str, Any] = {"tiles": ["T01"], "weights": WEIGHTS}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("REST_S", "HOLD_S"):
        monkeypatch.setattr(weighing, name, 2.5)  # a fit needs steps of 2 s or more


def start(running: Running, **body: object) -> dict[str, Any]:
    return dict(content_of(running.http.post(URL, json=BODY | body), 201))


def get(running: Running) -> dict[str, Any]:
    found: dict[str, Any] = running.http.get(URL).json()["weighing"]
    return found


def is_closed(running: Running) -> bool:
    return bool(running.http.get(URL).json() == {"node": "bench", "weighing": None})


def wait_for_failure(running: Running) -> str:
    until(lambda: get(running)["state"] == "failed")
    return str(get(running)["problem"])


def list_labels(running: Running, session_id: str) -> list[str]:
    items = running.http.get(f"/sessions/{session_id}/markers").json()["items"]
    return [item["label"] for item in items]


@contextmanager
def late_node(running: Running, lag_s: float) -> Iterator[FakeNode]:
    """A tared node whose frames are this old: it can stream faster than real time."""
    with closing(FakeNode(running)) as node:
        node.next_t_mono_ns = time.monotonic_ns() - round(1e9 * lag_s)
        node.connect()
        node.tared()
        yield node


@contextmanager
def person(
    running: Running, lag_s: float, put_on_n: Callable[[float], float] = float
) -> Iterator[Callable[[str], dict[str, Any]]]:
    """Put on each requested weight, or another force; yield a wait for a state."""
    with late_node(running, lag_s) as node, Play(node, alive=True, catch_up=15) as play:

        def wait_for(state: str) -> dict[str, Any]:
            end_s = time.monotonic() + 120.0
            while (found := get(running))["state"] != state:
                assert time.monotonic() < end_s, found
                if found["prompt"].startswith("Put "):
                    tile = next(one for one in found["tiles"] if one["serial"] == found["tile"])
                    weight = parse_weight(found["weights"][len(tile["held"])])
                    assert weight is not None
                    play.force_n = put_on_n(weight.force_n)
                elif found["step"] == "empty":
                    play.force_n = 0.0
                time.sleep(0.01)
            return found

        yield wait_for


@pytest.mark.slow(parts=8)
def test_tiles_are_calibrated_in_turn_and_the_node_uses_the_result(running: Running) -> None:
    with person(running, 90.0) as wait_for:
        began = start(running, tiles=["T02", "T01"], within_percent=0.5, name="left leg")
        assert began["prompt"] == "Take everything off T02"
        done = wait_for("done")
    result = done["result"]
    assert (result["name"], result["refused"], result["misfit"]) == ("left leg", {}, None)
    for tile in result["tiles"]:
        assert [row["weight"] for row in tile["weights"]] == [f"{n} +-0.5 %" for n in WEIGHTS]
        assert tile["weights"][-1]["residual_n"] == pytest.approx(0.0, abs=1.0)  # a count
        assert tile["band"][-1]["force_n"] == pytest.approx(80.0, abs=1.0)
    labels = list_labels(running, done["session_id"])
    assert len(labels) == 2 * len(WEIGHTS) * 4
    assert labels[:4] == ["T02 rest", "end", "T02 10 N +-0.5 %", "end"]
    assert running.http.get(f"/sessions/{done['session_id']}").json()["tags"] == ["calibration"]
    used = running.http.put("/nodes/bench/calibration", json={"id": result["calibration_id"]})
    assert used.json()["calibration"]["name"] == "left leg"
    assert running.http.delete(URL).status_code == 204
    assert is_closed(running)


def test_a_result_of_one_tile_names_the_others() -> None:
    node = SimpleNamespace(last_info=make_array(2))
    view = WeighingResultView.of(make_calibration(newton_tile("T01")), cast("Any", node))
    assert view.misfit is not None
    assert view.misfit.startswith("it covers T01, but not T02. Calibrate all tiles in one go, or ")


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ({"tiles": ["T77"]}, "no tile T77 that bears load; expected one of T01, T02"),
        ({"tiles": ["T01", "T01"]}, "named twice"),
        ({"weights": WEIGHTS[:4]}, "4 weights on the tile"),
        ({"weights": ["1 kg"] * 5}, "1 of them different"),
        ({"weights": [*WEIGHTS, "much"]}, "'much' is no weight"),
        ({"weights": [*WEIGHTS, "0 g"]}, "'0 g' is no weight"),
        ({"weights": WEIGHTS * 13}, "at most 60"),
        ({"within_percent": -1}, "within_percent"),
        ({"method": "scales"}, "method"),
        ({"colour": "red"}, "colour"),
    ],
    ids=str,
)
def test_an_impossible_calibration_is_refused_before_its_first_weight(
    sealed: Sealed, body: dict[str, Any], reason: str
) -> None:
    assert_refused(sealed.running.http.post(URL, json=BODY | body), 422, reason)
    assert is_closed(sealed.running)
    assert len(sealed.running.sessions()) == 2


def test_a_node_has_one_calibration_and_only_its_client_ends_it(
    running: Running, tared: FakeNode
) -> None:
    with Play(tared, alive=True):
        first = start(running)
        again = running.http.post(URL, json=BODY | {"tiles": ["T02"]})
        assert_refused(again, 409, "being calibrated by somebody")
        for method, url in (("DELETE", URL), ("POST", f"{URL}/repeat")):
            assert running.http.request(method, url, headers={"If-Match": '"x"'}).status_code == 412
        trial = running.record()  # others record meanwhile
        assert running.http.delete(URL, headers={"If-Match": first["session_id"]}).is_success
        assert is_closed(running)
        until(lambda: running.session(first["session_id"]).now()["state"] != "recording")
        assert trial.now()["state"] == "recording"
        assert start(running)["session_id"] != first["session_id"]
    for method, url in (("DELETE", "/nodes/none/weighing"), ("GET", "/nodes/none/weighing")):
        assert running.http.request(method, url).status_code == 404


def test_a_repeated_weight_loses_its_markers(running: Running) -> None:
    with late_node(running, 20.0) as node, Play(node, alive=True, catch_up=5) as play:
        id_ = start(running)["session_id"]
        until(lambda: get(running)["step"] == "put on")
        play.force_n = 20.0
        until(lambda: get(running)["tiles"][0]["held"])
        play.force_n = 0.0
        until(lambda: get(running)["step"] == "resting")
        labels = ["T01 rest", "end", "T01 10 N +-1 %", "end", "T01 rest"]
        assert list_labels(running, id_) == labels
        answer = running.http.post(f"{URL}/repeat").json()
        assert (answer["tiles"][0]["held"], answer["warning"]) == ([], "repeated by hand")
        assert list_labels(running, id_) == ["T01 rest", "end"]


def test_a_calibration_without_progress_fails_with_a_remedy(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weighings, "IDLE_S", 1.0)
    with Play(tared, 5.0, alive=True):
        id_ = start(running)["session_id"]  # a rest takes longer
        problem = wait_for_failure(running)
        assert "no step was completed" in problem
        assert "Repeat when you are at the foot" in problem
        until(lambda: running.session(id_).now()["state"] != "recording")
        assert_refused(running.http.post(f"{URL}/repeat"), 409, "has ended")
        start(running)


def test_a_calibration_fails_with_its_node_or_its_recording(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Play(tared, alive=True):
        running.http.post(f"/sessions/{start(running)['session_id']}/stop")
        assert "its recording was stopped" in wait_for_failure(running)
        start(running)
    tared.restart()
    tared.connect()
    assert "was restarted" in wait_for_failure(running)
    monkeypatch.setattr(weighings, "AWAY_S", 0.5)
    with Play(tared, alive=True):
        until(lambda: running.node()["last_seq"] is not None)
        start(running)
    assert "has sent nothing" in wait_for_failure(running)


@pytest.mark.slow(parts=8)
def test_a_refused_fit_has_its_reason(running: Running) -> None:
    with person(running, 45.0, lambda force_n: min(force_n, 40.0)) as wait_for:
        id_ = start(running)["session_id"]
        found = wait_for("failed")
    assert "expected a pressure that rises with the weight" in found["problem"]
    assert "Check what each weight is" in found["problem"]
    assert running.session(id_).now()["state"] == "sealed"
    assert found["result"] is None


def test_a_calibration_needs_the_token(guarded: Running) -> None:
    node = FakeNode(guarded, token=TOKEN)
    node.connect()
    node.tared()
    with Play(node, alive=True):
        assert guarded.http.post(URL, json=BODY).status_code == 401
        guarded.http.post(URL, json=BODY, headers=BEARER)
        assert get(guarded)["state"] == "weighing"
        assert guarded.http.delete(URL).status_code == 401
    node.close()


def test_markers_of_late_frames_have_the_time_of_these_frames(
    running: Running, tared: FakeNode
) -> None:
    tared.next_t_mono_ns = time.monotonic_ns() - 1_500_000_000
    tared.deliver(20, alive=True)
    url = f"/sessions/{start(running)['session_id']}/markers"
    for _ in range(1000):
        if markers := running.http.get(url).json()["items"]:
            break
        tared.deliver(20, alive=True)
    assert markers[0]["t_ns"] <= running.node()["last_t_ns"]


def test_a_server_that_stops_stops_the_recording(running: Running, tared: FakeNode) -> None:
    with Play(tared, alive=True):
        id_ = start(running)["session_id"]
        running.stop()
    running.start()
    assert running.session(id_).now()["state"] != "recording"
