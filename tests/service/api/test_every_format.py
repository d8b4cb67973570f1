"""What holds for a download in each format of the registry, over a real socket."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import pytest

from storage.formats.export import Export
from storage.formats.writers.registry import FORMATS
from tests.service.api.sealed import Sealed
from tests.service.fake_node import NodeOf
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused
from tests.storage.formats.writers.readers import said_in
from tests.waiting import until


def complete_in(to: str, content: bytes) -> str:
    (said,) = said_in(to, content)
    return said["complete"].lower()


def test_of_a_session_that_is_recorded_each_is_so_far_and_says_so_or_waits(sealed: Sealed) -> None:
    for to, known in FORMATS.items():
        answer = sealed.made(sealed.recording, format=to)
        if known.needs_sealed:
            assert_refused(answer, 409, "is recording", "when it is sealed", "Stop it")
        else:
            assert answer.headers["foottile-complete"] == "false"
            assert complete_in(to, answer.content).startswith(("false", "not complete"))


def test_a_lossy_session_is_lossy_and_one_without_curve_is_counts_in_each(
    running: Running, node_of: NodeOf
) -> None:
    raw, lossy = node_of(running, "raw", calibration=None), node_of(running, "lossy")
    sessions: dict[str, Recording] = {}
    for node in (raw, lossy):
        node.connect()
        if node.calibration is not None:
            node.tared()
        else:
            node.send(70)
        sessions[node.name] = node.record()
        node.deliver(50, [20.0, 60.0])
    first = lossy.seq
    lossy.seq += 20
    lossy.next_t_mono_ns += 40_000_000
    lossy.say_lost(disk_full=[[first, lossy.seq - 1]])
    lossy.deliver(50, [20.0, 60.0])
    for node in (raw, lossy):
        node.finish(sessions[node.name])
    for to, known in FORMATS.items():
        answer = sessions["lossy"].data(format=to, markers=True)
        assert answer.headers["foottile-complete"] == "lossy"
        assert complete_in(to, answer.content).startswith("lossy")
        url = f"{sessions['raw'].url}/data"
        answer = running.http.get(url, params={"format": to, "markers": "true"})
        if known.needs_forces:
            assert_refused(answer, 422, "this session has none", "ask for its counts")
        else:
            assert complete_in(to, answer.content) == "true"


@pytest.mark.parametrize("to", FORMATS)
def test_who_goes_away_in_between_ends_the_making_of_it(
    sealed: Sealed, monkeypatch: pytest.MonkeyPatch, to: str
) -> None:
    ended = threading.Event()

    def endless(_: Export) -> Iterator[bytes]:
        try:
            while True:
                yield bytes(1 << 20)
        finally:
            ended.set()

    monkeypatch.setitem(FORMATS, to, replace(FORMATS[to], encoder=endless))
    query = {"format": to, "start_s": "0.1"}
    with sealed.running.http.stream("GET", f"{sealed.session.url}/data", params=query) as answer:
        pieces = answer.iter_bytes()  # once it is let go, so is the connection
        next(pieces)
        assert not ended.is_set()
    until(ended.is_set)
