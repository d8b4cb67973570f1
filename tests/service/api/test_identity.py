"""Who has read all that a viewer can read of a node still does not take its place."""

from __future__ import annotations

import json
import time
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed

from service.node_identity import compute_fingerprint
from storage.permissions import SECRETS_NAME, read_secrets_or_empty
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import Earlier, FakeNode, NodeOf
from tests.service.node.publishing import Publishing
from tests.service.running import Running, assert_refused, closed
from tests.waiting import in_a_loop, until

HOUR_NS = 3_600_000_000_000


@pytest.fixture
def stranger(running: Running, node: FakeNode, node_of: NodeOf) -> FakeNode:
    """Another machine under the name of the node."""
    return node_of(running, node.name)


def replacement(running: Running) -> dict[str, Any] | None:
    found: dict[str, Any] | None = running.node()["replacement"]
    return found


def accept(running: Running, fingerprint: str) -> Any:
    return running.http.post("/nodes/bench/accept-replacement", json={"fingerprint": fingerprint})


def test_the_secret_is_on_the_disk_when_a_node_is_welcomed_and_nobody_is_shown_it(
    running: Running, node: FakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    node.greet()
    path = running.data / "nodes" / "bench" / SECRETS_NAME
    assert read_secrets_or_empty(path) == {"bench": node.secret}
    node.deliver(10)
    node.leave()
    challenge = node.open_and_identify()
    assert challenge.is_known
    assert node.secret is not None
    shown = [
        running.http.get(where).text for where in ("/nodes", "/nodes/bench", "/nodes/bench/scene")
    ]
    shown += [(path.parent / "hello.json").read_text(), caplog.text]
    assert not any(node.secret in text for text in shown)


@pytest.mark.parametrize("claim", ["present", "earlier"])
def test_a_stream_id_is_no_proof_and_the_node_goes_on_recording(
    running: Running, tared: FakeNode, stranger: FakeNode, claim: str
) -> None:
    session = tared.record()
    tared.deliver(20)
    running_stream = Earlier(tared.info, tared.seq, tared.sent[-1:])
    changes: dict[str, Any] = {"earlier": (running_stream.said(),)}
    if claim == "present":
        stranger.stream_id, stranger.utc_offset_ns = tared.stream_id, tared.utc_offset_ns
        changes = {}
    stranger.open_with_hello(**changes)
    code, reason = closed(stranger.socket)
    assert (code, "foottile accept-node bench" in reason) == (4013, True)
    sent = tared.deliver(50)
    sealed = tared.finish(session)
    assert (sealed["complete"], sealed["frames"]) == (True, 70)
    assert_same_bits(running.held(tared.stream_id).slice_rows(90, 140), sent)


def test_an_answer_that_was_overheard_is_worth_nothing_on_another_connection(
    node: FakeNode, stranger: FakeNode
) -> None:
    node.connect()
    node.leave()
    overheard = node.proof(node.open_and_identify())
    stranger.open_and_identify()
    stranger.socket.send(overheard.model_dump_json())
    stranger.socket.send(stranger.hello().model_dump_json())
    assert closed(stranger.socket)[0] == 4013


def test_the_node_is_known_after_restarts_of_both_ends(
    running: Running, node: FakeNode, stranger: FakeNode
) -> None:
    node.connect()
    node.deliver(10)
    node.restart()
    running.restart()
    stranger.open_with_hello()
    assert closed(stranger.socket)[0] == 4013
    node.come_back()
    node.deliver(10)


def test_a_machine_without_a_secret_is_let_in_under_a_free_name_and_displaces_nobody(
    running: Running, node: FakeNode, stranger: FakeNode
) -> None:
    node.secret = stranger.secret = None
    node.connect()
    node.deliver(10)
    stranger.stream_id, stranger.utc_offset_ns = node.stream_id, node.utc_offset_ns
    stranger.open_with_hello()
    assert closed(stranger.socket)[0] == 4009
    node.deliver(10)


def test_a_copy_of_its_card_is_the_node_and_does_not_take_a_running_connection(
    node: FakeNode, running: Running, node_of: NodeOf
) -> None:
    node.connect()
    copy = node_of(running, secret=node.secret)
    copy.open_with_hello()
    assert closed(copy.socket)[0] == 4009
    node.leave()
    copy.connect()
    copy.deliver(10)


def test_a_person_accepts_another_machine_which_then_is_the_node(
    running: Running, node: FakeNode, stranger: FakeNode
) -> None:
    node.connect()
    node.deliver(10)
    assert replacement(running) is None
    before_t_ns = time.time_ns()
    stranger.prove(secret=stranger.secret, proof=None).send(stranger.hello().model_dump_json())
    assert closed(stranger.socket)[0] == 4013
    asking = replacement(running)
    assert asking is not None
    assert stranger.secret is not None
    assert asking["fingerprint"] == compute_fingerprint(stranger.secret)
    assert asking["address"] == "127.0.0.1"
    assert abs(asking["requested_t_ns"] - before_t_ns) < 60e9
    assert_refused(accept(running, "0000-0000-0000-0000"), 412, asking["fingerprint"])
    node.deliver(10)
    answer = accept(running, asking["fingerprint"])
    assert (answer.status_code, answer.content) == (204, b"")
    assert closed(node.socket)[0] == 4013
    assert replacement(running) is None
    stranger.connect()
    stranger.deliver(10)
    node.open_with_hello()
    assert closed(node.socket)[0] == 4013
    assert_refused(accept(running, asking["fingerprint"]), 409, "no other machine was refused")


def test_screens_are_told_of_a_machine_that_asks_once(
    running: Running, node: FakeNode, stranger: FakeNode
) -> None:
    node.connect()
    with running.socket("/api/v1/live") as live:
        for _ in range(3):
            stranger.prove(secret=stranger.secret, proof=None).send(
                stranger.hello().model_dump_json()
            )
            assert closed(stranger.socket)[0] == 4013
        shown = []
        node.leave()
        while True:
            message = json.loads(live.recv(timeout=20.0))
            if message["type"] == "node":
                shown.append(message["node"])
                if not message["node"]["connected"]:
                    break
    assert len([each for each in shown if each["connected"] and each["replacement"]]) == 1


def test_nobody_asks_under_a_name_that_is_not_known(running: Running) -> None:
    assert_refused(accept(running, "0000-0000-0000-0000"), 404, "no node")


@in_a_loop
async def test_a_real_publisher_is_refused_says_what_it_is_and_is_let_in_once_accepted(
    running: Running, node: FakeNode, stranger: FakeNode
) -> None:
    node.connect()
    node.leave()
    assert stranger.secret is not None
    fingerprint = compute_fingerprint(stranger.secret)
    async with Publishing(stranger, running.url) as publishing:
        await publishing.until(lambda: replacement(running))
        assert any(
            "foottile accept-node bench" in said and fingerprint in said
            for said in publishing.reports
        ), publishing.reports
        assert accept(running, fingerprint).status_code == 204
        publishing.take(30)
        await publishing.emptied()


def test_frames_dated_ahead_are_refused_over_an_open_link_and_true_ones_go_on(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record()
    tared.deliver(20)
    for hours in (1, 10):
        seq, clock_ns = tared.seq, tared.next_t_mono_ns
        tared.next_t_mono_ns += hours * HOUR_NS
        tared.send(10, 99.0)
        tared.sent.pop()
        tared.seq, tared.next_t_mono_ns = seq, clock_ns
    tared.seq += 10**9
    tared.send(10)
    tared.sent.pop()
    tared.seq = seq
    sent = tared.deliver(50)
    assert tared.acked == tared.acked.restricted_to(0, tared.seq - 1)
    (warning,) = running.node()["warnings"]
    assert "30 frames were refused" in warning
    assert_same_bits(running.held(tared.stream_id), tared.all_sent())
    sealed = tared.finish(session)
    assert (sealed["complete"], sealed["frames"]) == (True, 70)
    assert len(sent) == 50


def test_a_measurement_at_another_time_than_the_nodes_is_not_kept(
    running: Running, node: FakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    node.connect()
    until(lambda: running.node()["clock"])
    clock = running.node()["clock"]
    for ahead_ns in (HOUR_NS, -HOUR_NS):
        node.say_clock(-ahead_ns, t_mono_ns=time.monotonic_ns() + ahead_ns)
    until(lambda: caplog.text.count("a measurement of its clock is not kept") == 2)
    assert running.node()["clock"] == clock
    node.deliver(10)


def test_a_name_that_was_refused_first_is_not_kept(running: Running, node: FakeNode) -> None:
    """Whoever says ever new names, with a hello that cannot be, leaves no secret behind."""
    node.open_with_hello(array_info=node.info.model_copy(update={"tiles": ()}))
    with pytest.raises(ConnectionClosed):
        node.receive("welcome")
    assert not (running.data / "nodes").exists()
