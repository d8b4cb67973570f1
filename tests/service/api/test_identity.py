"""Identity of nodes: only the machine with the secret of a name is this node."""

from __future__ import annotations

import time
from typing import Any

import pytest

from service.protocol.link import compute_fingerprint
from storage.permissions import SECRETS_NAME, read_secrets_or_empty
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import Earlier, FakeNode, NodeOf
from tests.service.node.publishing import Publishing
from tests.service.running import Running, assert_refused, closed, receive_live
from tests.waiting import in_a_loop


@pytest.fixture
def stranger(running: Running, node: FakeNode, node_of: NodeOf) -> FakeNode:
    """Another machine under the name of the node."""
    return node_of(running, node.name)


def is_refused(node: FakeNode, **proof: Any) -> bool:
    """Return whether the server refuses the machine of a node."""
    node.prove(**proof).send(node.hello().model_dump_json())
    code, reason = closed(node.socket)
    return code == 4013 and "foottile accept-node bench" in reason


def request_replacement(node: FakeNode) -> None:
    """Show the secret of a refused machine, so that a person can accept it."""
    assert is_refused(node, secret=node.secret, proof=None)


def accept(running: Running, fingerprint: str) -> Any:
    return running.http.post("/nodes/bench/accept-replacement", json={"fingerprint": fingerprint})


def test_a_secret_is_stored_before_the_welcome_and_shown_nowhere(
    running: Running, node: FakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    node.greet()
    path = running.data / "nodes" / "bench" / SECRETS_NAME
    assert read_secrets_or_empty(path) == {"bench": node.secret}
    node.deliver(10)
    node.leave()
    assert node.open_and_identify().is_known
    assert node.secret is not None
    shown = [running.http.get(path).text for path in ("/nodes", "/nodes/bench/scene")]
    shown += [(path.parent / "hello.json").read_text(), caplog.text, str(running.node())]
    assert not any(node.secret in text for text in shown)


@pytest.mark.parametrize("claim", ["present", "earlier"])
def test_a_stream_id_is_no_proof(
    running: Running, tared: FakeNode, stranger: FakeNode, claim: str
) -> None:
    session = tared.record()
    tared.deliver(20)
    stream = Earlier(tared.info, tared.seq, tared.sent[-1:])
    changes: dict[str, Any] = {"earlier": (stream.said(),)}
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


def test_a_machine_without_a_secret_displaces_no_other(node: FakeNode, stranger: FakeNode) -> None:
    node.secret = stranger.secret = None
    node.connect()
    node.deliver(10)
    stranger.stream_id, stranger.utc_offset_ns = node.stream_id, node.utc_offset_ns
    stranger.open_with_hello()
    assert closed(stranger.socket)[0] == 4009
    node.deliver(10)


def test_an_accepted_machine_replaces_the_node(
    running: Running, node: FakeNode, stranger: FakeNode
) -> None:
    assert_refused(accept(running, "0000-0000-0000-0000"), 404, "no node")
    node.connect()
    node.deliver(10)
    assert running.node()["replacement"] is None
    before_t_ns = time.time_ns()
    with running.socket("/api/v1/live") as live:
        for _ in range(3):
            request_replacement(stranger)
        found = running.node()["replacement"]
        assert stranger.secret is not None
        assert found["fingerprint"] == compute_fingerprint(stranger.secret)
        assert found["address"] == "127.0.0.1"
        assert abs(found["requested_t_ns"] - before_t_ns) < 60e9
        assert_refused(accept(running, "0000-0000-0000-0000"), 412, found["fingerprint"])
        node.deliver(10)
        answer = accept(running, found["fingerprint"])
        assert (answer.status_code, answer.content) == (204, b"")
        assert closed(node.socket)[0] == 4013
        assert running.node()["replacement"] is None
        notices: list[Any] = []
        while not notices or notices[-1]["connected"]:
            notices.append(receive_live(live, lambda each: each["type"] == "node")["node"])
        # Three requests are one notice.
        assert sum(bool(node["connected"] and node["replacement"]) for node in notices) == 1
    stranger.connect()
    stranger.deliver(10)
    assert is_refused(node)
    refused = accept(running, found["fingerprint"])
    assert_refused(refused, 409, "no other machine was refused")


@in_a_loop
async def test_a_refused_publisher_reports_its_fingerprint_until_it_is_accepted(
    running: Running, node: FakeNode, stranger: FakeNode
) -> None:
    node.connect()
    node.leave()
    assert stranger.secret is not None
    fingerprint = compute_fingerprint(stranger.secret)
    async with Publishing(stranger, running.url) as publishing:
        await publishing.until(lambda: running.node()["replacement"])
        assert any(
            "foottile accept-node bench" in report and fingerprint in report
            for report in publishing.reports
        ), publishing.reports
        assert accept(running, fingerprint).status_code == 204
        publishing.take(30)
        await publishing.emptied()
