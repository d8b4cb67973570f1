"""Environment variables are read as they were meant, whoever wrote them."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import foottile
from foottile.environment import read_token, read_variable

ROOT = Path(__file__).resolve().parents[2]
NAME = "FOOTTILE_OF_THIS_TEST"
VALUE = "0123456789abcdef"

_LETTERS = st.characters(min_codepoint=33, max_codepoint=0x17F, exclude_characters="'\"\x7f")
_SPACE = st.text("\r\n\t \v", max_size=3)


@given(
    st.text(_LETTERS.filter(str.isprintable), min_size=1),
    _SPACE,
    _SPACE,
    st.sampled_from(["", "'", '"']),
)
def test_what_env_files_leave_around_a_value_is_not_part_of_it(
    value: str, before: str, behind: str, quote: str
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(NAME, f"{before}{quote}{value}{quote}{behind}")
        assert read_variable(NAME) == value


@pytest.mark.parametrize("value", ["", " ", "\r", "''", '""', '""\r', '" "'])
def test_an_empty_variable_is_not_set(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(NAME, value)
    assert read_variable(NAME) is None
    monkeypatch.setenv("FOOTTILE_TOKEN", value)
    assert read_token() is None


@pytest.mark.parametrize("value", ["a\rb", "a\nb", "a\x1bb"])
def test_a_control_character_within_a_value_is_refused(
    value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(NAME, value)
    with pytest.raises(foottile.InvalidRequestError, match=f"{NAME}.*control character"):
        read_variable(NAME)


@pytest.mark.parametrize("protocol", ["tcp", "udp"])
def test_the_variable_of_a_kubernetes_service_is_ignored_with_a_warning(
    protocol: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("FOOTTILE_PORT", f"{protocol}://10.0.0.1:8000")
    with caplog.at_level(logging.WARNING, "foottile.environment"):
        assert read_variable("FOOTTILE_PORT") is None
    assert "Kubernetes" in caplog.text
    assert "FOOTTILE_PORT" in caplog.text


@pytest.mark.parametrize("token", ["schlüssel", "two words", "a\tb"])
def test_a_token_that_no_header_can_carry_is_refused(
    token: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FOOTTILE_TOKEN", token)
    with pytest.raises(foottile.InvalidRequestError, match="FOOTTILE_TOKEN"):
        read_token()
    monkeypatch.delenv("FOOTTILE_TOKEN")
    with pytest.raises(foottile.InvalidRequestError, match="token"):
        foottile.connect("http://127.0.0.1:1", token)


def test_a_token_read_from_a_file_may_have_its_line_end() -> None:
    with foottile.connect("http://127.0.0.1:1", VALUE + "\r\n") as server:
        assert server.headers == {"Authorization": f"Bearer {VALUE}"}


def test_no_other_place_reads_a_variable_of_ours() -> None:
    allowed = {
        ROOT / "foottile" / "environment.py",
        # A demo passes its whole environment on, and names the token for the node that it starts.
        ROOT / "service" / "cli" / "commands" / "serve.py",
        ROOT / "studies" / "reproduce" / "run.py",
        # systemd's own.
        ROOT / "service" / "systemd.py",
        # Read or set for a library.
        ROOT / "devices" / "jit.py",
        # It refuses paths that are not UTF-8, those in variables too.
        ROOT / "service" / "cli" / "main.py",
    }
    found = {
        path
        for folder in ("devices", "storage", "service", "studies", "foottile")
        for path in (ROOT / folder).rglob("*.py")
        if "environ" in path.read_text().replace("environment", "") or "getenv(" in path.read_text()
    }
    assert found <= allowed


def test_the_node_of_the_container_reads_its_variables_by_the_same_function(tmp_path: Path) -> None:
    """The script is run as it is; a stand-in for `foottile` prints what it is given."""
    stand_in = tmp_path / "foottile"
    stand_in.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    stand_in.chmod(0o755)
    (tmp_path / "python").symlink_to(sys.executable)
    done = subprocess.run(
        ["sh", str(ROOT / "scripts" / "container-node")],
        env={
            "PATH": f"{tmp_path}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "FOOTTILE_SERVER": '"http://10.0.0.1:8000"\r',
            "FOOTTILE_NODE": "left\r",
            "FOOTTILE_SCENE": "",
        },
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split()[:7] == [
        *("node", "--scene", "rolling", "--server", "http://10.0.0.1:8000", "--name", "left")
    ]
