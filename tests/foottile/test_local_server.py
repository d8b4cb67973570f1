"""A program finds the token of its own user's running server on this machine, and no other."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import foottile
from foottile import local_server
from foottile.local_server import LocalServer, find_local_server, is_loopback, publish_local_server

URL = "http://127.0.0.1:8000"
SERVER = LocalServer(URL, "a-token-of-this-test")


@pytest.fixture
def records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a user who has no record yet, and no token in the environment."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.delenv("FOOTTILE_TOKEN")
    return tmp_path / "foottile" / "servers"


@pytest.fixture
def record(records: Path) -> Iterator[Path]:
    """The record of a server that runs."""
    with publish_local_server(SERVER):
        (path,) = records.iterdir()
        yield path


@pytest.mark.parametrize(
    "url",
    [
        *(URL, f"{URL}/", "ws://127.0.0.1:8000", "http://[::ffff:127.0.0.1]:8000"),
        *("http://localhost:8000", "http://LOCALHOST:8000"),
    ],
)
def test_a_running_server_is_found_by_its_address(record: Path, url: str) -> None:
    assert find_local_server(url) == SERVER


@pytest.mark.parametrize(
    "url",
    [
        *("http://127.0.0.1:8001", "http://127.0.0.1", "http://127.0.0.2:8000"),
        *("http://[::1]:8000", "http://192.168.4.1:8000", "http://laptop.local:8000"),
        *("http://localhost.evil.example:8000", "http://0.0.0.0:8000", "https://127.0.0.1:8000"),
        *("http://127.0.0.1.evil.example:8000", "http://127.0.0.1@evil.example:8000"),
        *("http://127.0.0.1:8000/other", "http://[::1", "http://127.0.0.1:x", "", "laptop"),
    ],
)
def test_a_token_is_for_the_address_at_which_its_server_listens(record: Path, url: str) -> None:
    assert find_local_server(url) is None


def test_only_the_user_may_read_a_record(record: Path) -> None:
    assert record.stat().st_mode & 0o077 == 0
    assert record.parent.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602, 0o601])
def test_a_record_that_others_may_read_or_write_does_not_count(record: Path, mode: int) -> None:
    record.chmod(mode)
    assert find_local_server(URL) is None


@pytest.mark.parametrize("mode", [0o750, 0o705, 0o720, 0o702])
def test_a_record_in_a_folder_that_is_open_to_others_does_not_count(
    record: Path, mode: int
) -> None:
    record.parent.chmod(mode)
    assert find_local_server(URL) is None
    with publish_local_server(SERVER):  # closes it
        assert find_local_server(URL) == SERVER


def test_a_record_of_another_user_does_not_count(
    record: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: record.stat().st_uid + 1)
    assert find_local_server(URL) is None


def test_a_link_to_a_record_does_not_count(record: Path) -> None:
    elsewhere = record.with_name("elsewhere")
    record.rename(elsewhere)
    record.symlink_to(elsewhere)
    assert find_local_server(URL) is None


def test_the_record_of_a_server_that_was_killed_does_not_count(records: Path) -> None:
    code = (
        "import sys, time; from foottile.local_server import *\n"
        f"with publish_local_server({SERVER!r}): print(flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert find_local_server(URL) == SERVER
        process.send_signal(signal.SIGKILL)
        process.wait()
    (path,) = records.iterdir()
    assert json.loads(path.read_text())["token"] == SERVER.token
    assert find_local_server(URL) is None


def test_a_server_removes_its_own_record_and_not_that_of_a_later_one(records: Path) -> None:
    later = LocalServer(URL, "another-token-of-this-test")
    with publish_local_server(SERVER):
        with publish_local_server(later):
            assert find_local_server(URL) == later
        assert list(records.iterdir()) == []
    with publish_local_server(SERVER):
        (path,) = records.iterdir()
        path.unlink()
    with publish_local_server(SERVER), publish_local_server(later):
        pass
    assert list(records.iterdir()) == []


@given(st.binary(max_size=200) | st.from_type(dict[str, str]).map(lambda d: json.dumps(d).encode()))
def test_a_record_that_is_damaged_does_not_count(content: bytes) -> None:
    with publish_local_server(LocalServer("http://127.0.0.1:9", "x")):
        from foottile.local_server import _record_path

        path = _record_path(9)
        assert path is not None
        path.write_bytes(content)
        assert find_local_server("http://127.0.0.1:9") is None


def test_a_token_that_is_given_comes_before_the_environment_and_that_before_a_record(
    record: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shown(token: str | None = None) -> str:
        with foottile.connect("http://localhost:8000", token) as server:
            return server.headers["Authorization"]

    assert shown() == f"Bearer {SERVER.token}"
    monkeypatch.setenv("FOOTTILE_TOKEN", "of-the-environment")
    assert shown() == "Bearer of-the-environment"
    assert shown("given") == "Bearer given"


def test_localhost_is_asked_at_the_address_of_the_record(record: Path) -> None:
    # Another user may listen at [::1], which `localhost` stands for as well.
    with foottile.connect("http://localhost:8000") as server:
        assert server.url == URL
    with foottile.connect("http://localhost:8001") as server:
        assert server.url == "http://localhost:8001"
        assert server.headers == {}


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        ("localhost", True),
        ("127.0.0.1", True),
        ("127.9.9.9", True),
        ("::1", True),
        ("::ffff:127.0.0.1", True),
        ("0.0.0.0", False),  # noqa: S104  # compared only
        ("::", False),
        ("192.168.4.1", False),
        ("::ffff:192.168.4.1", False),
        ("robot.local", False),
        ("localhost.evil.example", False),
        ("", False),
    ],
)
def test_loopback_is_only_this_machine(host: str, expected: bool) -> None:
    assert is_loopback(host) is expected


def test_a_user_without_a_home_finds_no_server_and_cannot_publish_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(local_server, "user_state_path", lambda _: Path("~/foottile"))
    assert find_local_server(URL) is None
    with pytest.raises(OSError, match="no home folder"), publish_local_server(SERVER):
        pass
