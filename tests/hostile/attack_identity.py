"""Another machine takes the name of a node that records, knowing all that viewers can read."""

from __future__ import annotations

import time
from random import Random
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed

from service.protocol.link import Challenge, Proof, generate_secret
from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.stage import Served, recording
from tests.service.fake_node import Earlier, FakeNode

_HOUR_NS = 3_600_000_000_000
_REFUSED = 4013
_ANSWER_S = 5.0


@attack("another machine under the name of a node that records", tries=6, soak_tries=200)
def takeovers(play: Play) -> Outcome:
    """Connections that name a node and its streams, as `GET /nodes` publishes them.

    A try says hello with the node's running stream, or with a new one and the running one as
    earlier, and then sends frames of it, some of them dated hours ahead. The machine has a secret
    of its own, none, or sends a proof at random. It fails if the server lets it in, or if the
    node's connection ends, or its recording is not complete.
    """
    outcome = Outcome()
    with Served(play.folder, outcome=outcome) as served, recording(served, outcome) as node:
        for number in range(play.tries):
            time.sleep(play.random.uniform(0.1, 0.4))
            happened = _take_over(served, node, play.random)
            if happened == f"refused with {_REFUSED}":
                outcome.saw(happened)
            else:
                outcome.failed(f"try {number}: {happened}; the log ends with {served.log[-3:]}")
        _check_connected(served, outcome)
    return outcome


def _check_connected(served: Served, outcome: Outcome) -> None:
    time.sleep(0.5)
    if not served.node()["connected"]:
        outcome.failures.append("the node is no longer connected")


class _Stranger(FakeNode):
    """A machine that answers every challenge in the same wrong way."""

    answer = Proof()

    def proof(self, challenge: Challenge, **changes: Any) -> Proof:
        return self.answer


def _take_over(served: Served, victim: FakeNode, random: Random) -> str:
    stranger = _Stranger(served, victim.name)
    stranger.answer = random.choice(
        [Proof(), Proof(secret=generate_secret()), Proof(proof=generate_secret())]
    )
    running = Earlier(victim.info, victim.seq, victim.sent[-1:])
    changes: dict[str, Any] = {"earlier": (running.said(),)}
    if random.random() < 0.5:
        stranger.stream_id, stranger.utc_offset_ns = victim.stream_id, victim.utc_offset_ns
        stranger.seq = victim.seq + 50
        changes = {"stored": ((0, stranger.seq - 1),)}
    try:
        stranger.open_with_hello(**changes)
        stranger.receive("welcome", _ANSWER_S)
        stranger.next_t_mono_ns = time.monotonic_ns() + random.choice([0, 1, 5]) * _HOUR_NS
        stranger.deliver(20)
    except ConnectionClosed as end:
        code = None if end.rcvd is None else end.rcvd.code
        return f"refused with {code}"
    except TimeoutError:
        return "let in"
    else:
        return "let in, and its frames were acknowledged"
    finally:
        stranger.close()


@attack("frames that a node dates hours ahead in its running stream", tries=20, soak_tries=2000)
def frames_ahead(play: Play) -> Outcome:
    """Frames of a node that records, dated two minutes to ten hours ahead, or numbered far ahead.

    A try is one message between true ones, over the node's own connection. It fails if the
    connection ends, if such a frame is acknowledged, or if the recording is not complete with the
    true frames of the same numbers.
    """
    outcome = Outcome()
    with Served(play.folder, outcome=outcome) as served, recording(served, outcome) as node:
        for _ in range(play.tries):
            time.sleep(0.05)
            outcome.saw(_send_ahead(node, play.random))
        _check_connected(served, outcome)
        if "ahead" not in " ".join(served.node()["warnings"]):
            outcome.failures.append("no warning counts the frames that were refused")
        outcome.failures += _find_forged(served, node)
    return outcome


def _send_ahead(node: FakeNode, random: Random) -> str:
    # Apart from what the thread of the node sends: a copy, that does not move its numbers.
    forger = FakeNode(node.running, node.name)
    forger.stream_id, forger.utc_offset_ns, forger.seq = (
        node.stream_id,
        node.utc_offset_ns,
        node.seq,
    )
    forger.next_t_mono_ns = time.monotonic_ns()
    kind = random.choice(["dated ahead", "numbered ahead"])
    if kind == "dated ahead":
        forger.next_t_mono_ns += round(random.uniform(120.0, 36_000.0) * 1e9)
    else:
        forger.seq += random.choice([10**7, 2**40])
    node.socket.send(forger.payload(forger.frames(10, 77.0)))
    forger.close()
    return kind


def _find_forged(served: Served, node: FakeNode) -> list[str]:
    """Return what is wrong with what the server's journal holds of the stream."""
    held, sent = served.held(node.stream_id, node.name), node.all_sent()
    if not np.array_equal(held.seq, sent.seq[: len(held)]):
        return [f"the journal holds {len(held)} frames, of {len(sent)} that were taken"]
    if not np.array_equal(held.t_mono_ns, sent.t_mono_ns[: len(held)]):
        return ["the journal holds frames with instants that the node did not take"]
    return []
