"""Damaged files of a server: it starts, names them, and shows no wrong number."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.flags import EstimateFlag
from service.protocol.link import PROTOCOL
from service.server import nodes
from service.sessions.tares import TareHistory
from storage.documents import read_checksummed_json, write_checksummed_json
from tests.service.fake_node import FakeNode
from tests.service.running import Running, receive_live
from tests.waiting import PATIENCE_S

LOST = int(EstimateFlag.TARE_LOST)


def flip(path: Path, before: bytes, after: bytes) -> None:
    text = path.read_bytes()
    assert text.count(before) >= 1
    at = text.rindex(before)
    path.write_bytes(text[:at] + after + text[at + len(before) :])


def list_problems(running: Running) -> str:
    return " ".join(running.http.get("/health").json()["problems"])


def receive_frame(running: Running, node: FakeNode) -> dict[str, Any]:
    """Return a live message of the next frames."""
    with running.socket("/api/v1/live?rate_hz=60") as live:
        assert json.loads(live.recv(timeout=PATIENCE_S))["type"] == "hello"
        node.deliver(60, 3.0)
        return receive_live(
            live, lambda each: each["type"] == "frame" and each["seq"] >= node.seq - 20
        )


@pytest.fixture
def lost(running: Running, tared: FakeNode) -> FakeNode:
    """A node whose tare was damaged while the server was down."""
    running.stop()
    path = running.data / "nodes" / "bench" / "tares.json"
    flip(path, b'"baseline_kpa": [100.', b'"baseline_kpa": [102.')
    running.start()
    tared.connect()
    return tared


def test_while_a_tare_is_lost_no_force_is_known(running: Running, lost: FakeNode) -> None:
    node = running.node()
    assert node["tare"] is None
    assert "damaged and lost" in node["tare_problem"]
    assert "tares.json.damaged-1" in list_problems(running)
    message = receive_frame(running, lost)
    assert message["gauge_kpa"] == message["force_n"] == [None, None]
    assert message["grf_n"] is None
    assert message["contact"] is None
    assert message["estimate_flags"] & LOST
    # The lead, which the server has seen, is not tared again.
    assert running.http.get("/nodes/bench/tares").json()["items"] == []
    recording = lost.record()
    lost.deliver(100, 3.0, now=True)
    sealed = lost.finish(recording)
    assert sealed["complete"] is True
    assert "a tare is damaged and lost" in sealed["problem"]
    assert np.isnan(recording.column("grf_n").astype(float)).all()
    assert (recording.column("estimate_flags") & LOST).all()
    with recording.reader() as reader:
        assert [tare["source"] for tare in reader.notes["tares"]] == ["lost"]


def test_a_tare_by_hand_replaces_a_lost_one(running: Running, lost: FakeNode) -> None:
    lost.deliver(10)
    recording = lost.record()
    lost.deliver(300, alive=True, now=True)
    answer = running.http.post("/nodes/bench/tare", json={})
    assert answer.status_code == 201, answer.text
    assert running.node()["tare_problem"] is None
    message = receive_frame(running, lost)
    assert message["force_n"] == pytest.approx([3.0, 3.0], abs=0.05)
    assert not message["estimate_flags"] & LOST
    lost.finish(recording)
    is_lost = (recording.column("estimate_flags") & LOST) != 0
    assert is_lost[:300].all()
    assert not is_lost[300:360].any()
    assert recording.column("grf_n")[300:360] == pytest.approx(6.0, abs=0.1)
    running.restart()
    assert running.node()["tare"]["id"] == answer.json()["id"]
    assert running.http.get("/health").json()["problems"] == []


@pytest.mark.parametrize("is_one_between", [False, True])
def test_a_session_has_forces_if_a_later_tare_precedes_the_lost_one(
    running: Running, tared: FakeNode, *, is_one_between: bool
) -> None:
    pending = tared.record()
    tared.deliver(100, 5.0)
    later_ns = tared.next_t_mono_ns + 60_000_000_000
    tared.leave()
    pending.stop()
    tared.next_t_mono_ns = later_ns
    running.stop()
    path = running.data / "nodes" / "bench" / "tares.json"
    info, by_lead = tared.info, TareHistory(path).all_tares_with_undone[0].tare
    for later_s in (100, 200) if is_one_between else (200,):
        t_ns = by_lead.t_ns + later_s * 10**9
        TareHistory(path).store_tare_in_force(replace(by_lead, t_ns=t_ns, source="unloaded"), info)
    flip(path, b'"undone": false', b'"undone": true ')
    running.start()
    assert "1 tare is lost" in list_problems(running)
    tared.connect()
    tared.send(10, now=True)
    problem = pending.sealed()["problem"]
    is_lost = (pending.column("estimate_flags") & LOST) != 0
    grf_n = pending.column("grf_n").astype(float)
    assert len(grf_n) == 100
    if is_one_between:
        assert problem is None
        assert not is_lost.any()
        assert grf_n == pytest.approx(10.0, abs=0.1)
    else:  # the lost one may be of right after the lead
        assert "a tare is damaged and lost" in problem
        assert is_lost.all()
        assert np.isnan(grf_n).all()


@pytest.mark.parametrize("damage", ["flip", "folder", "of another node", "another version"])
def test_a_node_with_a_damaged_hello_is_unknown_until_it_connects(
    running: Running, tared: FakeNode, node_of: Any, damage: str
) -> None:
    other = node_of(running, "other")
    other.connect()
    pending = tared.record()
    tared.deliver(100, 5.0)
    tared.leave()
    pending.stop()
    ends = tared.frames(10, now=True)
    running.stop()
    path = running.data / "nodes" / "bench" / "hello.json"
    match damage:
        case "flip":
            flip(path, b'"x_m": 0.0', b'"x_m": 1.0')
        case "folder":
            path.unlink()
            path.mkdir()
        case "of another node":
            shutil.copy(path.parent.parent / "other" / "hello.json", path)
        case _:
            write_checksummed_json(path, b'{"type":"hello","protocol":1,"first_seq":0}')
    running.start()
    assert [node["node"] for node in running.http.get("/nodes").json()["items"]] == ["other"]
    assert "hello.json" in list_problems(running)
    assert path.with_name("hello.json.damaged-1").exists() == (damage != "another version")
    assert pending.now()["state"] == "pending"
    with running.socket("/api/v1/live") as live:
        assert "hello.json" in " ".join(json.loads(live.recv(timeout=PATIENCE_S))["problems"])
    tared.connect()
    tared.send_again(ends)
    sealed = pending.sealed()
    assert (sealed["frames"], sealed["complete"], sealed["problem"]) == (100, True, None)
    assert pending.clock() != {}
    assert running.node()["tare"] is not None
    read_checksummed_json(path)
    assert "until it connects" not in list_problems(running)


def test_the_present_protocol_is_among_those_that_can_be_read() -> None:
    assert nodes._READABLE_PROTOCOLS[-1] == PROTOCOL


def test_a_hello_of_the_version_before_is_no_problem(running: Running, tared: FakeNode) -> None:
    running.stop()
    path = running.data / "nodes" / "bench" / "hello.json"
    hello = json.loads(read_checksummed_json(path)) | {"protocol": 5}
    del hello["vitals"]
    write_checksummed_json(path, json.dumps(hello).encode())
    running.start()
    assert list_problems(running) == ""
    assert running.node()["tare"] is not None


def test_a_server_starts_beside_a_lock_and_a_probe_that_are_no_files(
    running: Running, tared: FakeNode
) -> None:
    running.stop()
    (running.data / ".lock").unlink()
    os.mkfifo(running.data / ".lock")
    (running.data / ".writable").unlink()
    (running.data / ".writable").mkdir()
    running.start()
    assert running.http.get("/ready").status_code == 200


def test_a_problem_of_any_file_name_is_printable(running: Running, tared: FakeNode) -> None:
    running.stop()
    journal = running.data / "journal" / "bench" / tared.stream_id
    odd_names = ("\x1b[31mred", "\udcff", "two\nlines", "\u202eoverridden")
    for odd in odd_names:
        (journal / f"{odd}.arrows").mkdir()
        (running.data / "nodes" / odd).mkdir()
        write_checksummed_json(running.data / "nodes" / odd / "hello.json", b'{"a": 1}')
    running.start()
    text = list_problems(running)
    assert text.count("it is not a file") == len(odd_names)
    assert text.count("written by another version") == len(odd_names)
    assert text.isprintable()
    with running.socket("/api/v1/live") as live:
        assert json.loads(live.recv(timeout=PATIENCE_S))["problems"]


def test_a_hello_of_another_version_is_named_in_one_sentence(
    running: Running, tared: FakeNode
) -> None:
    running.stop()
    path = running.data / "nodes" / "bench" / "hello.json"
    hello = json.loads(read_checksummed_json(path)) | {"older": 1}
    write_checksummed_json(path, json.dumps(hello).encode())
    running.start()
    text = list_problems(running)
    assert "written by another version, or edited (older: Extra inputs are not permitted)" in text
    assert "validation error" not in text
