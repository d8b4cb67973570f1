"""A live stream in a program: every frame once, whatever breaks."""

from __future__ import annotations

import json
import threading
import warnings
from collections.abc import Iterator

import pyarrow as pa
import pytest

import foottile
from foottile.live import LiveProtocol, LiveRequest
from tests.service.fake_node import FakeNode, Play
from tests.service.running import Running
from tests.waiting import until


def taken(live: foottile.LiveStream, last: int) -> list[int]:
    """Numbers of frames until this one has come."""
    seqs: list[int] = []
    while not seqs or seqs[-1] < last:
        seqs += [seq for seq in next(live)["seq"].to_pylist() if seq is not None]
    return seqs


@pytest.fixture
def played(running: Running, tared: FakeNode) -> Iterator[FakeNode]:
    with Play(tared, 20.0):
        yield tared


def test_five_lines_give_every_frame(running: Running, played: FakeNode) -> None:
    seqs: list[int] = []
    with foottile.connect(running.url) as server:
        for batch in server.live("bench", columns=["grf_n", "cop_x_m"]):
            seqs += [seq for seq in batch["seq"].to_pylist() if seq is not None]
            if len(seqs) > 30:
                break
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))


def test_over_a_restart_of_the_server_it_goes_on_by_itself(
    running: Running, tared: FakeNode
) -> None:
    with foottile.connect(running.url) as server, server.live("bench", ["grf_n"]) as live:
        with Sending(tared) as sending:
            seqs = taken(live, sending.first)
        tared.acknowledged(tared.seq - 1)
        running.restart()
        tared.connect()
        tared.send(100, 20.0)
        seqs += taken(live, tared.seq - 20)
        assert live.losses == ()
    assert seqs == list(range(seqs[0], seqs[-1] + 1))


class Sending:
    """Frames are sent, ten at a time, while the block runs: who connects meanwhile gets some."""

    def __init__(self, node: FakeNode) -> None:
        self.node, self.first = node, node.seq
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Sending:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            self.node.send(10, 20.0)


def test_from_a_position_on_it_has_all_that_came_since(running: Running, tared: FakeNode) -> None:
    tared.deliver(100, 20.0)
    with foottile.connect(running.url) as server:
        with server.live("bench", stream_id=tared.stream_id, from_seq=20) as live:
            seqs = taken(live, 150)
            position = live.position
        assert position == (tared.stream_id, seqs[-1] + 1)
        stream_id, seq = position
        tared.deliver(20, 20.0)
        with server.live("bench", stream_id=stream_id, from_seq=seq) as live:
            seqs += taken(live, 175)
    assert seqs == list(range(20, seqs[-1] + 1))


def test_frames_that_are_lost_are_told(running: Running, tared: FakeNode) -> None:
    first = tared.seq
    tared.frames(30)
    tared.say_lost(disk_full=[[first, tared.seq - 1]])
    tared.deliver(50, 20.0)
    told: list[foottile.FrameLoss] = []
    loss = foottile.FrameLoss(tared.stream_id, first, first + 29, "disk_full")
    with foottile.connect(running.url) as server:
        with server.live("bench", from_seq=0, on_loss=told.append) as live:
            taken(live, tared.seq - 10)
            assert told == [loss]
            assert live.losses == (loss,)
        with (
            server.live("bench", from_seq=0) as live,
            pytest.warns(foottile.FramesLostWarning, match="disk_full"),
        ):
            taken(live, tared.seq - 10)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"node": "nobody"}, "no node 'nobody'"),
        ({"columns": ["colour"]}, "no column 'colour'"),
        ({"policy": "all"}, "drop_oldest"),
        ({"stream_id": "0" * 32, "from_seq": 1}, "no stream"),
    ],
)
def test_what_is_not_there_is_said_and_not_tried_again(
    running: Running, tared: FakeNode, asked: dict[str, object], said: str
) -> None:
    with (
        foottile.connect(running.url) as server,
        server.live(**asked) as live,  # type: ignore[arg-type]  # wrong on purpose
        pytest.raises(foottile.InvalidRequestError, match=said),
    ):
        next(live)


def test_it_gives_up_if_that_is_wanted(running: Running, played: FakeNode) -> None:
    with (
        foottile.connect(running.url) as server,
        server.live("bench", reconnect_timeout_s=0.0) as live,
    ):
        next(live)
        running.stop()
        with pytest.raises(foottile.ServerUnavailableError):
            list(live)


def test_closed_from_another_thread_it_ends(running: Running, tared: FakeNode) -> None:
    with foottile.connect(running.url) as server:
        live = server.live("bench")
        done = threading.Event()

        def read() -> None:
            assert list(live) is not None
            done.set()

        thread = threading.Thread(target=read)
        thread.start()
        until(lambda: live.is_connected)
        live.close()
        thread.join()
        assert done.is_set()


def protocol(**asked: object) -> LiveProtocol:
    content: dict[str, object] = {
        "url": "http://x",
        "node": "n",
        "columns": (),
        "policy": "lossless",
    }
    return LiveProtocol(LiveRequest(**(content | asked)))  # type: ignore[arg-type]  # of several types


def test_a_stream_that_is_gone_is_a_loss_and_the_next_one_is_begun() -> None:
    live = protocol()
    live.parse_message(json.dumps({"type": "stream", "stream_id": "a" * 32, "from_seq": 5}))
    assert f"stream_id={'a' * 32}&from_seq=5" in live.make_url()
    with pytest.warns(foottile.FramesLostWarning, match="from 5 on"):
        live.check_close(4011, "no stream")
    assert "stream_id" not in live.make_url()
    assert "from_seq=0" in live.make_url()  # nothing of the next one is left out
    assert live.losses[0].reason == "no_stream"


def begun(seq: int, policy: str = "lossless") -> LiveProtocol:
    """A live stream whose next frame is this one."""
    live = protocol(policy=policy)
    live.parse_message(json.dumps({"type": "stream", "stream_id": "a" * 32, "from_seq": seq}))
    live.parse_message(SCHEMA.serialize().to_pybytes())
    return live


SCHEMA = pa.schema([("seq", pa.uint64())])


def frames(*seqs: int) -> bytes:
    batch = pa.RecordBatch.from_arrays([pa.array(seqs, pa.uint64())], schema=SCHEMA)
    return bytes(batch.serialize().to_pybytes())


@pytest.mark.parametrize(
    "message",
    [
        frames(6, 7),
        frames(5, 7),
        json.dumps(
            {"type": "lost", "stream_id": "a" * 32, "from_seq": 6, "to_seq": 9, "reason": ""}
        ),
    ],
    ids=["frames before it", "a frame among them", "a loss that leaves some out"],
)
def test_a_frame_of_which_nothing_was_said_is_missed(message: str | bytes) -> None:
    with pytest.raises(foottile.DamagedError):
        begun(5).parse_message(message)


def test_frames_that_were_here_already_are_left_out() -> None:
    live = begun(5)
    assert live.parse_message(frames(5, 6)) is not None
    rows = live.parse_message(frames(5, 6, 7))
    assert rows is not None
    assert rows["seq"].to_pylist() == [7]
    assert live.parse_message(frames(6, 7)) is None


def test_a_frame_that_the_server_cannot_read_is_an_error_and_is_not_tried_again() -> None:
    with pytest.raises(foottile.DamagedError, match="from_seq=5"):
        begun(5).check_close(4012, "resume with from_seq=5")


def test_one_who_gets_nowhere_waits_longer_each_time_until_frames_come() -> None:
    live, waits = begun(5), []
    for _ in range(9):
        live.check_close(1013, "try later")
        waits.append(live.compute_retry_delay_s(OSError(), 0.0, None))
        live.make_url()
        live.parse_message(json.dumps({"type": "hello"}))
    assert waits == sorted(waits)
    assert waits[0] < waits[-1] == 5.0
    live.parse_message(SCHEMA.serialize().to_pybytes())
    live.parse_message(frames(5))
    assert live.compute_retry_delay_s(OSError(), 0.0, None) == waits[0]


@pytest.mark.parametrize(
    "message", ["", "[]", "{}", '{"type": 1}', '{"type":"stream"}', b"", b"x" * 99]
)
def test_what_no_foottile_server_says_is_damage(message: str | bytes) -> None:
    live = protocol()
    with warnings.catch_warnings(), pytest.raises(foottile.DamagedError):
        live.parse_message(message)
