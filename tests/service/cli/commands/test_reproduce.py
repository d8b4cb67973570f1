"""`foottile reproduce` as a user meets it: real processes, loopback, real time."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from devices.errors import FootTileError
from studies.reproduce import run as reproduction
from studies.reproduce.run import Laboratory, RecordingJob
from tests.service.cli.outcome import Run

pytestmark = pytest.mark.slow


@pytest.mark.slow
def test_a_quick_look_goes_from_the_mill_to_the_figures_through_node_and_server(
    run: Run, tmp_path: Path
) -> None:
    outcome = run("reproduce", "--quick", "--out", "new/first", "--json")
    content = outcome.printed()
    folder = tmp_path / "new" / "first"
    assert content == json.loads((folder / "reproduce.json").read_text())
    assert content["failures"] == {}
    (dome,) = content["domes"]
    assert dome["name"] == "v60-11"
    assert dome["r2_of_mean"] > 0.999
    rolling = content["experiments"]["rolling"]
    (trial,) = rolling["trials"]
    assert trial["lost_frames"] == 0
    assert trial["frames"] > 500
    assert rolling["figures"]["cop_p95_m"]["mean"] < 0.004
    assert rolling["figures"]["grf_mae_n"]["mean"] < 1.0
    assert trial["reference"]["lag_s"]["inside"]
    text = (folder / "reproduce.md").read_text()
    assert "One foot is real and the other emulated" in text
    for name in ("domes.png", "rolling.png", "references.png"):
        assert f"]({name})" in text
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    (session,) = (folder / "sessions").iterdir()
    assert (session / "frames.parquet").is_file()


class Lab:
    """A laboratory in which every trial fails."""

    def __init__(self) -> None:
        self.tried: list[str] = []

    def __call__(self, folder: Path) -> Lab:
        return self

    def __enter__(self) -> Lab:
        return self

    def __exit__(self, *_: object) -> None: ...

    def record(self, trial: RecordingJob) -> None:
        self.tried.append(trial.name)
        raise FootTileError(f"node {trial.name} has ended by itself, with code 1")


@pytest.mark.slow(parts=8)
def test_a_trial_that_fails_twice_fails_alone_with_exit_code_3(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = Lab()
    monkeypatch.setattr(reproduction, "Laboratory", lab)
    outcome = run("reproduce", "--quick", "--out", "o")
    outcome.fails(3, "not measured: rolling-1: node rolling-1-again has ended by itself")
    assert lab.tried == ["rolling-1", "rolling-1-again"]
    text = (tmp_path / "o" / "reproduce.md").read_text()
    assert "Trial rolling-1 was repeated, alone: node rolling-1 has ended by itself" in text
    assert "| v60-11 |" in text, "the dome was measured"


def test_when_most_trials_fail_none_is_repeated(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab()
    monkeypatch.setattr(reproduction, "Laboratory", lab)
    monkeypatch.setattr(reproduction, "map_in_processes", lambda *_: iter(()))  # no dome is pressed
    outcome = run("reproduce", "--quick", "--trials", reproduction.REPEATED_MAX + 1, "--out", "o")
    assert outcome.code == 3
    assert len(lab.tried) == reproduction.REPEATED_MAX + 1


def test_a_node_that_does_not_start_is_named_with_its_log(tmp_path: Path) -> None:
    with Laboratory(tmp_path) as laboratory:
        trial = RecordingJob("wrong", ["--scene=no-such-scene"], 1.0, ())
        with pytest.raises(FootTileError, match="does not come") as raised:
            laboratory.record(trial)
    assert raised.value.where is not None
    assert "no-such-scene" in Path(raised.value.where).read_text()
