"""The overview of a session that is not sealed yet: what there is so far."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

import service.sessions.preview
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused
from tests.waiting import until

HELD_BACK = 6
"""Frames whose estimates wait for 10 ms of look-ahead, and the one at its end."""


def asked(session: Recording, **query: Any) -> Any:
    answer = session.running.http.get(f"{session.url}/timeseries", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


def frames_of(session: Recording, **query: Any) -> int:
    return int(sum(asked(session, **query)["columns"]["frames"]))


def is_there(session: Recording, n: int) -> bool:
    return frames_of(session) >= n - HELD_BACK


def waves(n: int) -> Any:
    """Forces that rise and fall, 20 N and 60 N at most."""
    return (0.5 - 0.5 * np.cos(np.arange(n) / 40))[:, None] * [20.0, 60.0]


def test_what_there_is_so_far_is_what_will_be_sealed(tared: FakeNode) -> None:
    session = tared.record()
    tared.deliver(500, waves(500))
    until(lambda: frames_of(session) >= 500 - HELD_BACK)
    first = asked(session, points=8000)
    tared.deliver(300, waves(300))
    until(lambda: frames_of(session) >= 800 - HELD_BACK)
    second = asked(session, points=8000)
    assert (first["provisional"], second["provisional"]) == (True, True)
    assert second["frames_in_bin"] == 1
    coarse = asked(session, points=20)
    assert 20 <= len(coarse["columns"]["frames"]) <= 80
    assert max(coarse["columns"]["grf_n_max"]) == max(second["columns"]["grf_n_max"])
    tared.finish(session)
    sealed = asked(session, points=8000)
    assert sealed["provisional"] is False
    for so_far in (first, second):
        assert so_far["begin_t_ns"] == sealed["begin_t_ns"]
        n = len(so_far["columns"]["frames"])
        for name in ("t_first_s", "grf_n_max", "force_n_0_min", "cop_x_m_max", "estimate_flags"):
            assert so_far["columns"][name] == sealed["columns"][name][:n], name
    assert max(second["columns"]["grf_n_max"]) > 70.0


def test_frames_that_come_late_have_their_place_in_it(
    tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.sessions.preview, "_REST_FACTOR", 0)
    session = tared.record()
    tared.deliver(200, waves(200))
    late = tared.frames(100, waves(100))
    tared.deliver(200, waves(200))
    until(lambda: frames_of(session) >= 400 - HELD_BACK)
    assert sum(asked(session)["columns"]["missing"]) == 100
    tared.send_again(late)
    until(lambda: frames_of(session) >= 500 - HELD_BACK)
    assert sum(asked(session)["columns"]["missing"]) == 0


def test_a_long_session_is_caught_up_with_answer_by_answer(
    tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = tared.record()
    tared.deliver(2000, waves(2000))
    monkeypatch.setattr(service.sessions.preview, "UPDATE_BUDGET_S", 0.0)
    assert_refused(session.running.http.get(f"{session.url}/timeseries"), 409, "no frames yet")
    monkeypatch.setattr(service.sessions.preview, "UPDATE_BUDGET_S", 100.0)
    assert frames_of(session) >= 2000 - HELD_BACK
    assert asked(session)["catching_up"] is False


def test_after_a_restart_of_the_server_it_is_the_same(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    tared.deliver(300, waves(300))
    until(lambda: frames_of(session) >= 300 - HELD_BACK)
    before = asked(session, points=8000)
    running.restart()
    until(lambda: frames_of(running.session(session.id)) >= 300 - HELD_BACK)
    after = asked(running.session(session.id), points=8000)
    assert after["columns"]["grf_n_max"] == before["columns"]["grf_n_max"]
    assert after["provisional"] is True


def test_without_a_calibration_it_has_raw_counts(running: Running, node_of: NodeOf) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.send(10)
    node.taken_in()
    session = node.record()
    node.deliver(100, [0.0, 30.0], alive=True)
    until(lambda: frames_of(session) == 100)
    columns = asked(session)["columns"]
    assert "grf_n_max" not in columns
    assert min(columns["pressure_raw_1_min"]) == 469


def test_few_sessions_are_remembered(tared: FakeNode) -> None:
    sessions = [tared.record(name=str(i)) for i in range(6)]
    tared.deliver(200, waves(200))
    for each in sessions:
        until(partial(is_there, each, 200))
    kept = tared.running.server.previews._previews
    assert list(kept) == [session.id for session in sessions[-4:]]
    sessions[-1].stop()
    tared.finish(sessions[-2])
    sessions[-1].sealed()
    asked(sessions[-1])
    assert sessions[-1].id not in kept
