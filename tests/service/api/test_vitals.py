"""Vitals of a node: in its view while it is connected, and in its sessions, begin and end."""

from __future__ import annotations

import json

from devices.vitals import Vitals
from service.protocol.link import NodeStatus
from service.sessions.sealing import rebuild_damaged_session_json
from storage.sessions.folder import SessionsFolder
from storage.verify.session import verify_session
from tests.service.fake_node import FakeNode
from tests.service.running import Running
from tests.waiting import until

START = Vitals(disk_free_bytes=10**10, cpu_celsius=48.3, is_undervolted=False)
STOP = Vitals(disk_free_bytes=10**9, cpu_celsius=81.0, is_undervolted=True, was_undervolted=True)


def test_a_session_has_the_vitals_of_its_begin_and_end(running: Running) -> None:
    node = FakeNode(running)
    node.connect(vitals=START)
    assert running.node()["vitals"] == START.model_dump()
    node.deliver(30, alive=True)
    session = node.record()
    assert session.now()["vitals_at_start"] == START.model_dump()
    status = NodeStatus(missed_slots=0, warnings=("the supply sags",), vitals=STOP)
    node.socket.send(status.model_dump_json())
    until(lambda: running.node()["vitals"] == STOP.model_dump())
    assert running.node()["warnings"] == ["the supply sags"]
    node.send(30, alive=True)
    node.taken_in()
    found = node.finish(session)
    assert found["vitals_at_start"] == START.model_dump()
    assert found["vitals_at_stop"] == STOP.model_dump()
    with session.reader() as file:
        notes = json.loads(json.dumps(file.notes["session"]))
    assert notes["vitals_at_start"] == START.model_dump()
    assert notes["vitals_at_stop"] == STOP.model_dump()
    assert verify_session(session.folder).problems == []
    node.close()
    running.stop()
    (session.folder / "session.json").write_bytes(b"{")
    rebuilt = rebuild_damaged_session_json(SessionsFolder(session.folder.parent), session.id)
    assert rebuilt is not None
    assert (rebuilt.vitals_at_start, rebuilt.vitals_at_stop) == (START, STOP)


def test_a_node_that_knows_no_vitals_says_none(running: Running) -> None:
    node = FakeNode(running)
    node.connect()
    assert running.node()["vitals"] is None
    node.deliver(30, alive=True)
    session = node.record()
    node.send(30, alive=True)
    node.taken_in()
    found = node.finish(session)
    assert (found["vitals_at_start"], found["vitals_at_stop"]) == (None, None)
    with session.reader() as file:
        assert not {"vitals_at_start", "vitals_at_stop"} & file.notes["session"].keys()
    node.close()


def test_vitals_of_a_node_that_is_away_are_unknown(running: Running) -> None:
    node = FakeNode(running)
    node.connect(vitals=START)
    node.deliver(30, alive=True)
    session = node.record()
    node.leave()
    until(lambda: not running.node()["connected"])
    assert running.node()["vitals"] is None
    session.stop()
    assert session.now()["vitals_at_stop"] is None
    running.stop()
    running.start()
    assert running.node()["vitals"] is None
