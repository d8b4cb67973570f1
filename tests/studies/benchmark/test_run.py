"""Draws in processes of their own are the same draws."""

from __future__ import annotations

import pytest

from devices.scene.scene_file import load_scene
from studies.benchmark.draws import DrawTask, list_model_sets, run_draw
from studies.benchmark.run import BenchmarkOptions, run_benchmark, run_draws


@pytest.mark.slow
@pytest.mark.process
def test_draws_in_processes_of_their_own_give_the_same() -> None:
    scene = load_scene("rolling").model_copy(
        update={"calibration": "paper-eq2-shape", "models": ("unwrap", "static")}
    )
    (whole,) = (model_set for model_set in list_model_sets(scene.models) if model_set.is_full_set)
    tasks = [DrawTask(scene, 1.0, draw, (whole,)) for draw in (0, 1)]
    there = sorted(run_draws(tasks, process_count=2), key=lambda d: d.draw)
    # By their texts: what is not known in either is no difference.
    assert repr(there) == repr([run_draw(task) for task in tasks])
    assert not any(d.failures for d in there)


def test_a_draw_that_cannot_be_made_is_a_failure_and_no_end() -> None:
    scene = load_scene("rolling").model_copy(update={"calibration": "nowhere.json"})
    (result,) = run_draws([DrawTask(scene, 1.5, 7, list_model_sets(scene.models))], process_count=1)
    assert not result.accuracy
    assert [f.what for f in result.failures] == ["draw 7"]
    assert "nowhere.json" in result.failures[0].why


@pytest.mark.slow
def test_a_foot_with_a_bare_tile_is_measured_and_timed() -> None:
    scene = load_scene("mud").model_copy(
        update={"calibration": "paper-eq2-shape", "models": ("unwrap", "static")}
    )
    said: list[str] = []
    bench = run_benchmark(
        BenchmarkOptions(
            scenes=(scene,), draws=1, process_count=1, seconds=1.5, live_frames=20,
            offline_frames=100, repetitions=1, full_only=True,
        ),
        said.append,
    )  # fmt: skip
    (figures,) = bench.scenes
    assert figures.assumed_scale
    assert not figures.failures
    assert [row.ns_per_frame.n for row in figures.figures_by_mode_and_label.values()] == [1, 1]
    assert said == ["mud: 1 of 1 draws", "mud: timing"]
