"""What a sealed session's files prove, over REST: the same as `foottile verify` says of them."""

from __future__ import annotations

import shutil

import pytest

from storage.verify.session import verify_session
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import assert_refused


@pytest.fixture
def sealed(tared: FakeNode) -> Recording:
    session = tared.record()
    tared.deliver(200, [20.0, 60.0], alive=True)
    tared.finish(session)
    return session


def test_a_whole_session_is_said_to_be_whole(sealed: Recording) -> None:
    answer = sealed.running.http.get(f"{sealed.url}/verification")
    assert answer.status_code == 200
    found = answer.json()
    assert found | {"unproven": []} == verify_session(sealed.folder).to_json_dict()
    assert (found["problems"], found["complete"]) == ([], True)
    assert found["sha256"] == sealed.now()["sha256"]


@pytest.mark.parametrize("name", ["frames.parquet", "markers.parquet", "clock.parquet"])
def test_a_byte_that_changed_is_named_and_nothing_is_written(sealed: Recording, name: str) -> None:
    path = sealed.folder / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    before = {one.name: one.read_bytes() for one in sealed.folder.iterdir()}
    found = sealed.running.http.get(f"{sealed.url}/verification").json()
    assert any(name in problem for problem in found["problems"])
    assert found["complete"] is False
    assert {one.name: one.read_bytes() for one in sealed.folder.iterdir()} == before


def test_what_is_not_sealed_or_not_there_is_refused(tared: FakeNode, sealed: Recording) -> None:
    http = tared.running.http
    assert_refused(http.get("/sessions/none/verification"), 404, "none")
    open_ = tared.record()
    assert_refused(http.get(f"{open_.url}/verification"), 409, "recording", "Stop it")
    shutil.rmtree(sealed.folder)
    assert_refused(http.get(f"{sealed.url}/verification"), 404, "no such folder")
