"""A recording over and over again is one stream, and timing it takes every rung."""

from __future__ import annotations

import numpy as np
import pytest

from devices.scene.file import load_scene
from service.estimation.estimate import Estimator
from service.estimation.estimates import EstimateStatus
from service.offline.benchmark.draws import (
    Endless,
    Recording,
    estimated,
    plan_of,
    record,
    time_rungs,
)
from service.offline.benchmark.rungs import Rung, rungs


@pytest.fixture(scope="module")
def recording() -> Recording:
    scene = load_scene("rolling").model_copy(update={"calibration": "paper-eq2-shape"})
    return record(scene, 2.0, 1)


def test_an_endless_recording_rises_without_a_gap(recording: Recording) -> None:
    n = len(recording.frames)
    stream = Endless(recording.frames)
    rows = stream.rows(0, 3 * n)
    assert (np.diff(rows.seq.astype(np.int64)) == 1).all()
    assert (np.diff(rows.t_ns) > 0).all()
    assert (np.diff(rows.t_ns) == np.diff(rows.t_mono_ns)).all()
    assert (rows.padc[n : 2 * n] == recording.frames.padc).all()
    pieces = [stream.rows(begin, begin + 7) for begin in range(n - 10, n + 11, 7)]
    assert (np.concatenate([p.t_ns for p in pieces]) == rows.t_ns[n - 10 : n + 11]).all()
    plan = plan_of(recording, ("unwrap", "static"), 0.0)
    estimates = Estimator(plan).step(rows)
    assert not (estimates.estimate_status & EstimateStatus.GAP).any()


def test_every_rung_is_timed_in_both_modes_as_often_as_asked(recording: Recording) -> None:
    ladder = rungs(("unwrap", "static"), existing=("unwrap", "static"))
    times, failures = time_rungs(recording, ladder, {"live": 100, "offline": 5000}, 2)
    assert not failures
    assert set(times) == {(m, r.label) for m in ("live", "offline") for r in ladder}
    assert all(len(t) == 2 and min(t) > 0 for t in times.values())


def test_a_rung_that_cannot_be_timed_is_named(recording: Recording) -> None:
    broken = Rung("broken", ("nonsense",), True, None, None, True)
    times, failures = time_rungs(recording, [broken], {"live": 10, "offline": 10}, 1)
    assert not times
    assert [f.what for f in failures] == ["time of broken, live", "time of broken, offline"]
    assert "nonsense" in failures[0].why


def test_a_draw_is_itself_again_and_another_draw_is_another(recording: Recording) -> None:
    scene = load_scene("rolling").model_copy(update={"calibration": "paper-eq2-shape"})
    again, other = record(scene, 2.0, 1), record(scene, 2.0, 2)
    assert (again.frames.padc == recording.frames.padc).all()
    assert again.info.tiles == recording.info.tiles
    words = [tile.coefficient_words for tile in recording.info.tiles]
    assert [tile.coefficient_words for tile in other.info.tiles] != words


def test_the_look_ahead_changes_what_is_published(recording: Recording) -> None:
    live, offline = (estimated(recording, ("unwrap", "static"), lag) for lag in (10.0, 100.0))
    assert live.frames == offline.frames == len(recording.frames)
    assert offline.grf_published_mae_n != live.grf_published_mae_n
