"""Warm-up frames of a server's session: kept, sent again, never waited for, and downloaded."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import foottile
from service.pull import pull_session
from storage.intervals import NO_END
from storage.sessions.folder import WARM_UP_NAME
from storage.sessions.reader import SealedFileReader
from storage.verify.data_folder import find_verdict, verify_path
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running


def numbers(path: Path) -> list[int]:
    with SealedFileReader(path) as reader:
        return [int(seq) for seq in reader.read_frames().seq]


def needed_of(running: Running, node: FakeNode) -> list[tuple[int, int]]:
    needed = running.call(lambda: running.server.recorder.collect_needed_frames(node.name))
    return [*needed[node.stream_id]]


def begun_under_load(tared: FakeNode) -> Recording:
    tared.deliver(100, [20.0, 60.0])
    session = tared.record()
    tared.deliver(200, [20.0, 60.0])
    return session


def test_what_was_before_a_session_is_kept_until_it_is_sealed(
    running: Running, tared: FakeNode
) -> None:
    session = begun_under_load(tared)
    first = session["parts"][0]["seq_first"]
    assert first == 170
    assert needed_of(running, tared) == [(0, NO_END)]
    tared.connect()
    assert [(each.stream_id, *each.numbers) for each in tared.wanted.streams] == [
        (tared.stream_id, (0, None))
    ]
    running.restart()
    tared.connect()
    assert needed_of(running, tared) == [(0, NO_END)]
    tared.finish(session)
    assert running.call(lambda: running.server.recorder.collect_needed_frames("bench")) == {}
    assert numbers(session.folder / WARM_UP_NAME) == list(range(first))
    assert session.frames().seq[0] == first


def test_a_foot_that_stands_for_long_has_the_frames_since_it_was_in_the_air(
    running: Running, tared: FakeNode
) -> None:
    tared.deliver(200)
    tared.deliver(6000, [20.0, 60.0])  # models settle in 5000
    tared.record()
    ((first, _),) = needed_of(running, tared)
    assert 200 < first < 270  # the last one in the air, and a little before


def test_a_session_does_not_wait_for_the_frames_before_it(tared: FakeNode) -> None:
    tared.frames(100)  # which the node has, and does not send
    tared.deliver(50, [20.0, 60.0])
    session = tared.record()
    tared.deliver(200, [20.0, 60.0])
    done = tared.finish(session)
    assert (done["complete"], session.ledger()["lossy"]) == (True, False)
    assert numbers(session.folder / WARM_UP_NAME) == [*range(70), *range(170, 220)]
    assert find_verdict(verify_path(session.folder)) == "complete"


def test_a_stream_that_begins_with_its_session_has_no_warm_up(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record(pre_roll_s=60.0)
    tared.deliver(100, [20.0, 60.0])
    tared.finish(session)
    assert session["parts"][0]["seq_first"] == 0
    assert not (session.folder / WARM_UP_NAME).exists()
    assert running.http.get(f"{session.url}/warm-up").status_code == 404


def test_warm_up_frames_are_downloaded_with_their_session(
    running: Running, tared: FakeNode, tmp_path: Path
) -> None:
    session = begun_under_load(tared)
    answer = running.http.get(f"{session.url}/warm-up")
    assert (answer.status_code, "recording" in answer.text) == (409, True)
    tared.finish(session)
    content = (session.folder / WARM_UP_NAME).read_bytes()
    assert running.http.get(f"{session.url}/warm-up").content == content
    answer = running.http.get("/sessions/zip", params={"ids": session.id})
    with zipfile.ZipFile(io.BytesIO(answer.content)) as file:
        assert file.read(f"{session.id}/{WARM_UP_NAME}") == content
    with foottile.connect(running.url) as server:
        pull_session(server, session.id, tmp_path)
    assert (tmp_path / session.id / WARM_UP_NAME).read_bytes() == content
    report = verify_path(tmp_path / session.id)
    assert (find_verdict(report), report.to_json_dict()["unproven"]) == ("complete", [])
