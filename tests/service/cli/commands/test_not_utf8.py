"""Paths that are not UTF-8: a sentence before anything is done, and nothing half done."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from devices.errors import StorageError
from service.cli.main import SUMMARIES
from storage.permissions import set_umask_and_create_private_folder
from tests.service.cli.commands.test_any_value import COMMANDS
from tests.service.cli.outcome import Run

ODD = "odd\udcff"


@pytest.mark.parametrize("command", SUMMARIES)
def test_every_command_refuses_an_argument_and_a_working_folder(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    arguments = COMMANDS[command]
    refused = run(command, *arguments, ODD)
    refused.fails(2, "not UTF-8", "odd\\udcff")
    assert refused.err.count("\n") == 1
    (tmp_path / ODD).mkdir()
    monkeypatch.chdir(tmp_path / ODD)
    run(command, *arguments).fails(2, "the working folder is not UTF-8")
    assert list((tmp_path / ODD).iterdir()) == []


def test_a_folder_of_a_variable_is_refused(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", f"/nowhere/{ODD}")
    run("sessions", "--data", ".").fails(2, "XDG_DATA_HOME is not UTF-8")


def test_no_server_or_node_begins_to_write_in_such_a_folder(tmp_path: Path) -> None:
    umask = os.umask(0o022)
    os.umask(umask)
    with pytest.raises(StorageError, match="not UTF-8"):
        set_umask_and_create_private_folder(tmp_path / ODD)
    assert list(tmp_path.iterdir()) == []
    assert os.umask(umask) == umask


def test_a_session_in_such_a_folder_is_named_among_many(run: Run, tmp_path: Path) -> None:
    for name in ("one", ODD):
        (tmp_path / "all" / name).mkdir(parents=True)
        (tmp_path / "all" / name / "session.json").write_text("{}")
    outcome = run("verify", "all", "--jobs", 1, "--out", "out")
    outcome.fails(1, "all/odd\\udcff: the path is not UTF-8")
    assert outcome.err.count("not UTF-8") == 1
