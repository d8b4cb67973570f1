"""`foottile pull --take` and `foottile export --take`: all sessions of a take in one file."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.service.cli.outcome import Run
from tests.service.fake_node import NodeOf
from tests.service.running import Running
from tests.service.takes import Take, frames_of_long_ago
from tests.storage.formats.writers.readers import said_in

NOBODY = "0123456789ab"


def test_a_take_is_pulled_and_exported_by_its_id(
    running: Running,
    node_of: NodeOf,
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames_of_long_ago(monkeypatch)
    take = Take(running, [node_of(running, name) for name in ("right", "left")]).sealed()
    url, name = take.running.url, f"take-{take.id}_0s-end"
    run("pull", "--take", take.id, "--format", "xdf", "--out", "here", "--server", url).succeeds()
    assert len(said_in("xdf", (tmp_path / "here" / f"{name}.xdf").read_bytes())) == 2
    wanted = ("--format", "opensim", "--out", "x.zip", "--data", str(take.running.data))
    run("export", "--take", take.id, *wanted).succeeds()
    said = said_in("opensim", (tmp_path / "x.zip").read_bytes())
    assert [each["node"] for each in said] == ["left", "right"]
    for arguments, why in (
        (("export", "--take", NOBODY, *wanted), f"no session of take '{NOBODY}'"),
        (("export", take.sessions[0].id, "--take", take.id, *wanted), "Name one"),
        (("pull", "--out", "here", "--server", url), "a session's id, or --take"),
        (("pull", "--take", take.id, "--out", "here", "--server", url), "parquet holds one"),
    ):
        refused = run(*arguments)
        assert (refused.code, why in refused.err) == (2, True), refused.err
