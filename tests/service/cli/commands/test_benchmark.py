"""`foottile benchmark`: scenes with a preset for the bench, the broad family with made arrays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from devices.errors import FootTileError
from service.estimation.calibration import Calibration
from service.offline.calibration_lookup import find_calibration
from studies.benchmark import draws
from studies.broad import arrays as broad_run
from studies.broad.arrays import ArrayTask
from studies.broad.results import ArrayResult, RefusedItem
from tests.service.cli.outcome import Run, scene_text, static_only
from tests.studies.broad.kept import made

pytestmark = pytest.mark.slow

QUICK = ("--quick", "--frames", 500, "--seconds", 2, "--jobs", 1)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """`rolling` with the paper's curve, and the models that go with it."""
    path = tmp_path / "rolling.toml"
    path.write_text('calibration = "paper-eq2-shape"\n' + static_only(scene_text("rolling")))
    return path


def test_bench_writes_json_tables_and_plot(run: Run, scene: Path, tmp_path: Path) -> None:
    outcome = run(
        "benchmark", "--scene", scene, "--draws", 2, *QUICK, "--out", "new/folder", "--json"
    )
    outcome.fails(0, "rolling: 2 of 2 draws")
    folder = tmp_path / "new" / "folder"
    content = json.loads((folder / "benchmark.json").read_text())
    assert json.loads(outcome.out) == content
    (rolling,) = content["scenes"]
    assert (rolling["draws"], rolling["failures"]) == (2, [])
    assert not all(goal["met"] for goal in rolling["goals"]), "said, and no failure unless asked"
    assert rolling["absolute_scale"] == "assumed"
    for model_set in rolling["model_sets"]:
        for mode, lag_ms in (("live", 10.0), ("offline", 100.0)):
            assert model_set[mode]["lag_ms"] == lag_ms
            assert model_set[mode]["ns_per_frame"]["n"] == 3
            assert model_set[mode]["figures"]["grf_mae_n"]["n"] == 2
            assert model_set[mode]["coverage"]["all"]["frames"] > 1000
    assert sum(model_set["is_full_set"] for model_set in rolling["model_sets"]) == 1
    text = (folder / "benchmark.md").read_text()
    assert "an emulated foot" in text
    assert "forces in newtons are unreliable" in text
    assert (folder / "benchmark.png").read_bytes().startswith(b"\x89PNG")


def test_goals_that_are_not_met_are_named_and_code_3_if_asked_for(run: Run, scene: Path) -> None:
    outcome = run(
        "benchmark", "--scene", scene, "--draws", 1, *QUICK, "--out", "o", "--check-goals"
    )
    assert outcome.code == 3
    assert outcome.out.startswith("# Speed against error")
    # The paper's curve has another scale than the emulated domes.
    assert "goal not met: rolling, live: GRF mean absolute error, N" in outcome.err
    assert "| NO |" in outcome.out


@pytest.mark.slow(parts=8)
def test_another_estimator_is_measured_with_the_static_curve_alone(
    run: Run, scene: Path, tmp_path: Path
) -> None:
    options = ("--estimator", "low-pass", "--out", "o")
    run("benchmark", "--scene", scene, "--draws", 1, *QUICK, *options).succeeds()
    content = json.loads((tmp_path / "o" / "benchmark.json").read_text())
    (rolling,) = content["scenes"]
    assert (content["estimator"], rolling["failures"]) == ("low-pass", [])
    assert [each["models"] for each in rolling["model_sets"]] == [["static"]]
    run("benchmark", "--estimator", "unknown", "--out", "o").fails(2, "--estimator unknown")


def test_a_draw_that_fails_is_reported_and_the_others_count(
    run: Run, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(*asked: Any, parts_seed: int, **others: Any) -> Calibration:
        if parts_seed == 1:
            raise FootTileError("tile T03 does not rise")
        return find_calibration(*asked, parts_seed=parts_seed, **others)

    monkeypatch.setattr(draws, "find_calibration", refuses)
    outcome = run("benchmark", "--scene", scene, "--draws", 2, *QUICK, "--out", "o")
    outcome.fails(3, "rolling, draw 1: tile T03 does not rise")
    assert "- draw 1: tile T03 does not rise" in (tmp_path / "o" / "benchmark.md").read_text()
    (rolling,) = json.loads((tmp_path / "o" / "benchmark.json").read_text())["scenes"]
    assert rolling["draws"] == 1
    assert len(rolling["failures"]) == 1


def test_a_scene_of_which_no_draw_can_be_used_leaves_nothing_behind(
    run: Run, scene: Path, tmp_path: Path
) -> None:
    scene.write_text(scene.read_text().replace("paper-eq2-shape", "nowhere.json"))
    outcome = run("benchmark", "--scene", scene, "--draws", 2, *QUICK, "--out", "o")
    outcome.fails(1, "none of 2 draws gave a figure", "nowhere.json")
    assert not (tmp_path / "o").exists()


def test_a_missing_matplotlib_is_named_with_the_extra_that_brings_it(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    outcome = run("benchmark", "--scene", "rolling", "--out", "o")
    outcome.fails(2, "pip install 'foottile[plot]'")


# --- broad family ---------------------------------------------------------------------------------


BROAD = ("benchmark", "--family", "broad", "--draws", 3, "--jobs", 1, "--out", "o")


def test_broad_writes_json_tables_and_plot(run: Run, tmp_path: Path, made_arrays: None) -> None:
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
def made_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broad_run, "run_array", made)


def test_seeds_of_judgement_have_to_be_asked_for(
    run: Run, tmp_path: Path, made_arrays: None
) -> None:
    run(*BROAD, "--seeds", "judgement").fails(0)
    assert "seeds of judgement" in (tmp_path / "o" / "broad.md").read_text()


def test_a_draw_without_a_result_is_named_with_exit_code_3(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(task: ArrayTask) -> ArrayResult:
        refusal = RefusedItem(what="calibration of T02", why="it drifts")
        return made(task).model_copy(update={"judged": {}, "refusals": (refusal,)})

    monkeypatch.setattr(broad_run, "run_array", refused)
    run(*BROAD).fails(3, "no result: array 2, calibration of T02: it drifts")
    assert "| 2 | calibration of T02 |  | it drifts |" in (tmp_path / "o" / "broad.md").read_text()
