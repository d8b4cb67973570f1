"""A client that pulls sessions, and resumes."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path

import pytest

from devices.errors import LinkError, StateError, UsageError
from service.client import Client
from storage.verify.data import verdict_of, verify
from tests.service.api.sealed import Sealed
from tests.service.running import Running


def test_the_client_pulls_a_session_whole(sealed: Sealed, tmp_path: Path) -> None:
    with Client(sealed.running.url) as client:
        assert {s["id"] for s in client.sessions()} == {sealed.id, sealed.recording.id}
        pulled = client.pull(sealed.id, tmp_path / "out")
        assert Path(pulled["path"]).read_bytes() == sealed.content
        assert pulled["resumed_bytes"] == 0
        folder = tmp_path / "out" / sealed.id
        assert {path.name for path in folder.iterdir()} == {
            "frames.parquet",
            "session.json",
            "events.json",
            "events.parquet",
            "ledger.json",
            "clock.parquet",
        }
        again = client.pull(sealed.id, tmp_path / "out")
        assert again["path"] == pulled["path"]


def test_what_is_pulled_proves_itself_file_by_file(sealed: Sealed, tmp_path: Path) -> None:
    with Client(sealed.running.url) as client:
        client.pull(sealed.id, tmp_path)
        folder = tmp_path / sealed.id
        report = verify(folder)
        assert (verdict_of(report), report.as_dict()["unproven"]) == ("complete", [])
        for path in sorted(folder.iterdir()):
            whole = path.read_bytes()
            path.write_bytes(whole[:40] + bytes([whole[40] ^ 1]) + whole[41:])
            assert path.name in " ".join(verify(folder).as_dict()["problems"])
            path.write_bytes(whole)
        (folder / "session.json").write_bytes(b"{")
        client.pull(sealed.id, tmp_path)
        assert (folder / "session.json.damaged-1").read_bytes() == b"{"
        assert verdict_of(verify(folder)) == "complete"


def test_nothing_is_pulled_into_a_servers_data_folder(sealed: Sealed, tmp_path: Path) -> None:
    folder = sealed.session.folder
    before = (folder / "session.json").read_bytes()
    with Client(sealed.running.url) as client:
        for out in (folder.parent, folder.parent.parent, folder):
            with pytest.raises(UsageError, match="this is a data folder"):
                client.pull(sealed.id, out)
        copied = tmp_path / "copied"
        shutil.copytree(folder.parent, copied)  # without the lock, but still not ours
        with pytest.raises(UsageError, match=r"not one that `foottile pull` wrote"):
            client.pull(sealed.id, copied)
    assert (folder / "session.json").read_bytes() == before
    assert (copied / sealed.id / "session.json").read_bytes() == before
    assert not (folder.parent.parent / sealed.id).exists()


@pytest.mark.parametrize("have", [1, 1000, None])
def test_the_client_resumes_a_partial_file(
    sealed: Sealed, tmp_path: Path, have: int | None
) -> None:
    folder = tmp_path / "out" / sealed.id
    folder.mkdir(parents=True)
    (folder / ".frames.parquet.part").write_bytes(sealed.content[:have])
    with Client(sealed.running.url) as client:
        pulled = client.pull(sealed.id, tmp_path / "out")
    assert Path(pulled["path"]).read_bytes() == sealed.content
    assert pulled["resumed_bytes"] == (have or len(sealed.content))
    assert not list(folder.glob("*.part"))


@pytest.mark.parametrize(
    "partial", [b"x" * 1000, b"x" * 10_000_000], ids=["shorter", "longer than the file"]
)
def test_the_client_repairs_a_partial_file_that_is_wrong(
    sealed: Sealed, tmp_path: Path, partial: bytes
) -> None:
    folder = tmp_path / "out" / sealed.id
    folder.mkdir(parents=True)
    (folder / ".frames.parquet.part").write_bytes(partial)
    with Client(sealed.running.url) as client:
        with suppress(LinkError):  # it may say so, once
            client.pull(sealed.id, tmp_path / "out")
        client.pull(sealed.id, tmp_path / "out")
    assert (folder / "frames.parquet").read_bytes() == sealed.content


def test_the_client_replaces_a_file_that_is_wrong(sealed: Sealed, tmp_path: Path) -> None:
    folder = tmp_path / "out" / sealed.id
    folder.mkdir(parents=True)
    (folder / "frames.parquet").write_bytes(b"something else")
    with Client(sealed.running.url) as client:
        client.pull(sealed.id, tmp_path / "out")
    assert (folder / "frames.parquet").read_bytes() == sealed.content


def test_the_client_says_that_a_session_is_not_sealed(sealed: Sealed, tmp_path: Path) -> None:
    with (
        Client(sealed.running.url) as client,
        pytest.raises(StateError, match=r"is recording.*Stop it"),
    ):
        client.pull(sealed.recording.id, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_client_says_that_there_is_no_such_session(sealed: Sealed, tmp_path: Path) -> None:
    with Client(sealed.running.url) as client, pytest.raises(LinkError, match="no session"):
        client.pull("20200101T000000Z-000000", tmp_path)


def test_the_client_says_that_no_server_answers(running: Running, tmp_path: Path) -> None:
    running.stop()
    with Client(running.url) as client, pytest.raises(LinkError, match="foottile serve"):
        client.sessions()
