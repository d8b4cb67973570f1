"""A recording over and over again is one stream, and timing it takes every model_set."""

from __future__ import annotations

import numpy as np
import pytest

from devices.flags import EstimateFlag
from devices.scene.scene_file import load_scene
from service.estimation.estimate import ModelEstimator
from studies.benchmark.draws import (
    ComparedModelSet,
    DrawRecording,
    RepeatedRecording,
    compute_recording_accuracy,
    list_model_sets,
    make_recording_plan,
    record_draw,
    time_model_sets,
)


@pytest.fixture(scope="module")
def recording() -> DrawRecording:
    scene = load_scene("rolling").model_copy(update={"calibration": "paper-eq2-shape"})
    return record_draw(scene, 2.0, 1)


def test_an_endless_recording_rises_without_a_gap(recording: DrawRecording) -> None:
    n = len(recording.frames)
    stream = RepeatedRecording(recording.frames)
    rows = stream.get_frames(0, 3 * n)
    assert (np.diff(rows.seq.astype(np.int64)) == 1).all()
    assert (np.diff(rows.t_ns) > 0).all()
    assert (np.diff(rows.t_ns) == np.diff(rows.t_mono_ns)).all()
    assert (rows.pressure_raw[n : 2 * n] == recording.frames.pressure_raw).all()
    pieces = [stream.get_frames(begin, begin + 7) for begin in range(n - 10, n + 11, 7)]
    assert (np.concatenate([p.t_ns for p in pieces]) == rows.t_ns[n - 10 : n + 11]).all()
    plan = make_recording_plan(recording, ("unwrap", "static"), 0.0)
    estimates = ModelEstimator(plan).process_frames(rows)
    assert not (estimates.estimate_flags & EstimateFlag.GAP).any()


def test_every_rung_is_timed_in_both_modes_as_often_as_asked(recording: DrawRecording) -> None:
    ladder = list_model_sets(("unwrap", "static"), all_models=("unwrap", "static"))
    times, failures = time_model_sets(recording, ladder, {"live": 100, "offline": 5000}, 2)
    assert not failures
    assert set(times) == {(m, r.label) for m in ("live", "offline") for r in ladder}
    assert all(len(t) == 2 and min(t) > 0 for t in times.values())


def test_a_rung_that_cannot_be_timed_is_named(recording: DrawRecording) -> None:
    broken = ComparedModelSet("broken", ("nonsense",), True, None, None, True)
    times, failures = time_model_sets(recording, [broken], {"live": 10, "offline": 10}, 1)
    assert not times
    assert [f.what for f in failures] == ["time of broken, live", "time of broken, offline"]
    assert "nonsense" in failures[0].why


@pytest.mark.slow
def test_a_draw_is_itself_again_and_another_draw_is_another(recording: DrawRecording) -> None:
    scene = load_scene("rolling").model_copy(update={"calibration": "paper-eq2-shape"})
    again, other = record_draw(scene, 2.0, 1), record_draw(scene, 2.0, 2)
    assert (again.frames.pressure_raw == recording.frames.pressure_raw).all()
    assert again.info.tiles == recording.info.tiles
    words = [tile.registers for tile in recording.info.tiles]
    assert [tile.registers for tile in other.info.tiles] != words


def test_the_look_ahead_changes_what_is_published(recording: DrawRecording) -> None:
    live, offline = (
        compute_recording_accuracy(recording, ("unwrap", "static"), lag) for lag in (10.0, 100.0)
    )
    assert live.frames == offline.frames == len(recording.frames)
    assert offline.grf_published_mae_n != live.grf_published_mae_n
