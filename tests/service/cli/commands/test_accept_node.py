"""`foottile accept-node`: the person's word, said on the server's own computer."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from service.node_identity import compute_fingerprint
from tests.service.cli.outcome import Outcome, Run
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, closed

Accept = Callable[..., Outcome]


@pytest.fixture
def accept(run: Run, running: Running) -> Accept:
    return lambda *arguments: run("accept-node", *arguments, "--server", running.url)


@pytest.fixture
def stranger(running: Running, node: FakeNode, node_of: NodeOf) -> FakeNode:
    """Another machine, that was refused."""
    node.connect()
    node.leave()
    stranger = node_of(running)
    stranger.prove(secret=stranger.secret, proof=None)
    stranger.socket.send(stranger.hello().model_dump_json())
    assert closed(stranger.socket)[0] == 4013
    return stranger


def test_the_machine_that_asked_last_is_accepted_and_named(
    accept: Accept, stranger: FakeNode
) -> None:
    assert stranger.secret is not None
    outcome = accept("bench")
    assert (outcome.code, outcome.err) == (0, "")
    assert compute_fingerprint(stranger.secret) in outcome.out
    stranger.connect()


def test_a_machine_with_another_fingerprint_is_not(accept: Accept, stranger: FakeNode) -> None:
    outcome = accept("bench", "--fingerprint", "0000-0000-0000-0000")
    assert outcome.code == 1
    assert "another machine was refused as 'bench' meanwhile" in outcome.err
    stranger.open_with_hello()
    assert closed(stranger.socket)[0] == 4013


def test_a_node_without_a_request_is_named(accept: Accept, node: FakeNode) -> None:
    node.connect()
    outcome = accept("bench")
    assert outcome.code == 1
    assert "no other machine asks to connect as 'bench'" in outcome.err


def test_an_unknown_name_is_refused(accept: Accept) -> None:
    outcome = accept("nobody")
    assert outcome.code == 1
    assert "no node 'nobody'" in outcome.err
