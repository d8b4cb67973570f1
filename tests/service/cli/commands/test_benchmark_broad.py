"""`foottile benchmark --family broad` as a user meets it, with arrays that nobody ran."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from studies.broad import arrays as run
from studies.broad.arrays import ArrayTask
from studies.broad.results import ArrayResult, RefusedItem
from tests.service.cli.outcome import Run
from tests.studies.broad.kept import made

pytestmark = pytest.mark.slow

BROAD = ("benchmark", "--family", "broad", "--draws", 3, "--jobs", 1, "--out", "o")


def test_broad_writes_json_tables_and_plot(run: Run, tmp_path: Path, quick: None) -> None:
    outcome = run(*BROAD, "--json")
    outcome.fails(0, "2 arrays of about 30 s CPU each")
    content = json.loads((tmp_path / "o" / "broad.json").read_text())
    assert json.loads(outcome.out) == content
    assert (content["seeds"], content["arrays"]) == ("development", 3)
    assert len(content["results"]) == 3
    text = (tmp_path / "o" / "broad.md").read_text()
    assert "3 arrays of four tiles of the broad family, seeds of development" in text
    assert "an emulated foot" in text
    assert (tmp_path / "o" / "broad.png").read_bytes().startswith(b"\x89PNG")
    assert len(list((tmp_path / "o" / "arrays").iterdir())) == 3


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "run_array", made)


def test_seeds_of_judgement_have_to_be_asked_for(run: Run, tmp_path: Path, quick: None) -> None:
    run(*BROAD, "--seeds", "judgement").fails(0)
    assert "seeds of judgement" in (tmp_path / "o" / "broad.md").read_text()


def test_a_draw_without_a_result_is_named_with_exit_code_3(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from studies.broad import arrays as broad_run

    def refused(task: ArrayTask) -> ArrayResult:
        refusal = RefusedItem(what="calibration of T02", why="it drifts")
        return made(task).model_copy(update={"judged": {}, "refusals": (refusal,)})

    monkeypatch.setattr(broad_run, "run_array", refused)
    run(*BROAD).fails(3, "no result: array 2, calibration of T02: it drifts")
    assert "| 2 | calibration of T02 |  | it drifts |" in (tmp_path / "o" / "broad.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--family", "odd"), "--family odd"),
        (("--family", "broad", "--seeds", "mine"), "--seeds mine"),
        (("--family", "broad", "--scene", "rolling"), "--scene and --family broad"),
        (("--family", "broad", "--full-only"), "--full-only and --family broad"),
    ],
)
def test_absurd_arguments_are_refused(
    run: Run, tmp_path: Path, arguments: tuple[object, ...], says: str
) -> None:
    run("benchmark", *arguments, "--out", "o").fails(2, says)
    assert not (tmp_path / "o").exists()
