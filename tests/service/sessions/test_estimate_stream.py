"""Estimates of a recording, piece by piece: one for every frame, whatever the pieces."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import CalibrationError, TareError, UsageError
from devices.flags import TileFlag
from devices.frames import FrameBatch
from service.estimation.calibration import Calibration
from service.estimation.estimate import ModelEstimator
from service.estimation.pipeline.plan import make_plan
from service.estimation.records import Estimates
from service.estimation.tare.tare import Tare
from service.sessions import estimate_stream
from service.sessions.estimate_stream import EstimateStream, make_estimate_metadata
from storage.schema import ESTIMATE_COLUMNS
from tests.builders.arrays import COUNT_KPA, UNLOADED_KPA
from tests.service.sessions.pieces import (
    Piece,
    array,
    calibration,
    cut,
    frames,
    hopping,
    options,
    run,
    same,
)


@settings(max_examples=40, deadline=None)
@given(
    cuts=st.one_of(st.just(range(1, 120)), st.sets(st.integers(1, 119))),
    lead=st.integers(20, 120),
    lag_ms=st.sampled_from([0.0, 5.0, 10.0, 100.0, 5000.0]),
    chunk=st.sampled_from([1, 7, 64, 4096]),
)
def test_every_frame_comes_out_once_with_its_own_estimate_whatever_the_pieces(
    cuts: Sequence[int], lead: int, lag_ms: float, chunk: int
) -> None:
    batch = frames(hopping(120, loaded_from=lead), lead=lead)
    _, _, whole = run(cut(batch, []), lag_ms=lag_ms)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimate_stream, "ROWS_PER_STEP", chunk)
        _, out, columns = run(cut(batch, cuts), lag_ms=lag_ms)
    for f in fields(FrameBatch):
        assert getattr(out, f.name).tobytes() == getattr(batch, f.name).tobytes(), f.name
    assert columns["true_grf_n"].tolist() == [1000.0 + i for i in range(120)]
    same(columns, whole)


def test_the_estimate_beside_a_frame_is_about_that_frame() -> None:
    # With a look-ahead of 50 frames a pairing that is off by one would show in every loaded frame.
    batch = frames(hopping(300, loaded_from=50), lead=50)
    stream, out, columns = run(cut(batch, [13, 77, 78, 200]), lag_ms=100.0)
    assert stream.plan is not None
    counts = 500 - out.pressure_raw.astype(np.float64)
    offset = (stream.plan.tare.baseline_kpa - UNLOADED_KPA) / COUNT_KPA
    np.testing.assert_allclose(columns["gauge_kpa"] / COUNT_KPA, counts - offset, atol=1e-9)


def test_frames_leave_before_the_recording_ends() -> None:
    # A live stream must not wait for its end: after the lead, a frame waits for its look-ahead.
    batch = frames(hopping(300, loaded_from=50), lead=50)
    asked = 0

    def pieces() -> Iterator[Piece]:
        nonlocal asked
        for piece in cut(batch, range(1, 300)):
            asked += 1
            yield piece

    stream = EstimateStream(array(), options(lag_ms=10.0))
    for out, _ in stream.estimate_batches(pieces()):
        assert int(out.seq[-1]) >= asked - 51
    assert asked == 300


def test_all_columns_of_the_schema_are_there_in_its_order_and_double_precision() -> None:
    batch = frames(hopping(100, loaded_from=50), lead=50)
    _, _, columns = run([(batch, {})])
    assert list(columns) == [column.name for column in ESTIMATE_COLUMNS]
    assert {columns[c.name].dtype for c in ESTIMATE_COLUMNS[:-2]} == {np.dtype(np.float64)}
    assert columns["contact"].dtype == np.uint8
    assert columns["estimate_flags"].dtype == np.uint16


@pytest.mark.parametrize(
    ("loaded_from", "lead", "cuts", "tare_s", "tare"),
    [
        pytest.param(120, 120, range(1, 300), None, ("lead", 120), id="the lead to its end"),
        pytest.param(300, 300, [30, 60], None, ("lead", 300), id="all is lead"),
        # Unloaded from 0.4 to 0.5 s only; frames before it are estimated with that tare as well.
        pytest.param(0, 0, range(1, 300), (0.4, 0.5), ("interval", 51), id="an interval later on"),
        pytest.param(300, 100, [10, 20], (0.3, 0.5), ("interval", 101), id="it wins over the lead"),
    ],
)
def test_the_tare_is_the_named_interval_or_else_the_whole_lead_whatever_the_pieces(
    loaded_from: int,
    lead: int,
    cuts: Sequence[int],
    tare_s: tuple[float, float] | None,
    tare: tuple[str, int],
) -> None:
    forces_n = hopping(300, loaded_from=loaded_from)
    forces_n[200:251] = np.random.default_rng(1).normal(0.0, 1.0, (51, 2))
    stream, out, _ = run(cut(frames(forces_n, lead=lead), cuts), tare_s=tare_s)
    assert stream.plan is not None
    assert (stream.plan.tare.source, stream.plan.tare.frames) == tare
    assert len(out) == 300


def a_minute_under_load(unloaded_from_s: float, seconds: float) -> FrameBatch:
    """100 frames/s under a load, then flight; no lead, so the tare has to be recognised."""
    n = round(seconds * 100)
    forces_n = np.random.default_rng(2).normal(0.0, 1.0, (n, 2))
    forces_n[: round(unloaded_from_s * 100)] += 40.0
    return frames(forces_n, period_ns=10_000_000)


@pytest.mark.parametrize("cuts", [[], [6001], [6002, 6003], [5990, 6020], [1000, 6049], [6300]])
def test_a_recognised_tare_does_not_depend_on_the_pieces(cuts: list[int]) -> None:
    # Unloaded from 58.9 s on: windows of half a second begin at 59.0 s.
    batch = a_minute_under_load(58.9, 64.0)
    whole, _, expected = run(cut(batch, []), array(100.0))
    stream, _, columns = run(cut(batch, cuts), array(100.0))
    assert whole.plan is not None
    assert stream.plan is not None
    assert whole.plan.tare.begin_s == stream.plan.tare.begin_s == pytest.approx(59.0)
    same(columns, expected)


@pytest.mark.parametrize("unloaded_from_s", [59.7, 60.3])
@pytest.mark.parametrize("cuts", [[6002], [6030], [6200], [6390]])
def test_at_the_end_of_the_minute_too_it_does_not_depend_on_the_pieces(
    unloaded_from_s: float, cuts: list[int]
) -> None:
    # A tare is looked for in the first minute; where that ends is not for the pieces to say.
    def outcome(pieces: list[Piece]) -> tuple[float, ...] | str:
        try:
            stream, _, _ = run(pieces, array(100.0))
        except TareError:
            return "refused"
        assert stream.plan is not None
        return (stream.plan.tare.begin_s, stream.plan.tare.end_s)

    batch = a_minute_under_load(unloaded_from_s, 64.0)
    assert outcome(cut(batch, cuts)) == outcome(cut(batch, []))


@pytest.mark.parametrize(
    ("pieces", "tare_s", "says"),
    [
        ([(frames(np.full((400, 2), 40.0)), {})], None, "no interval can be recognised"),
        ([], None, "no frames"),
        ([(frames(np.zeros((100, 2))), {})], (10.0, 11.0), "0 readable frames in the interval"),
    ],
    ids=["never unloaded", "no frames", "an interval after the end"],
)
def test_a_recording_without_a_tare_is_refused(
    pieces: list[Piece], tare_s: tuple[float, float] | None, says: str
) -> None:
    with pytest.raises(TareError, match=says):
        list(EstimateStream(array(), options(tare_s=tare_s)).estimate_batches(pieces))


@pytest.mark.parametrize(
    "changes",
    [
        {"models": ("static", "magic")},
        {"models": ("unwrap",)},
        {"lag_ms": -1.0},
        {"tare_s": (1.0, 1.0)},
        {"tare_s": (2.0, 1.0)},
        {"tare_s": (-1.0, 1.0)},
        {"tare_s": (float("nan"), 1.0)},
        {"tare_s": (0.0, float("nan"))},
    ],
)
def test_options_that_cannot_work_are_refused_before_the_first_frame(
    changes: dict[str, Any],
) -> None:
    with pytest.raises(UsageError):
        EstimateStream(array(), options(**changes))


def test_a_tile_without_calibration_is_refused_before_the_first_frame() -> None:
    with pytest.raises(CalibrationError, match="T02"):
        EstimateStream(array(), options(calibration=calibration("T01", "T03")))


def test_the_plan_is_there_with_the_first_estimates() -> None:
    stream = EstimateStream(array(), options())
    assert stream.plan is None
    next(stream.estimate_batches([(frames(hopping(100, loaded_from=50), lead=50), {})]))
    assert stream.plan is not None


def test_the_notes_are_enough_to_make_the_same_estimates_again() -> None:
    batch = frames(hopping(300, loaded_from=100), lead=100)
    stream, _, columns = run([(batch, {})], lag_ms=9.2, models=("static",))
    assert stream.plan is not None
    notes = json.loads(
        json.dumps(make_estimate_metadata(stream.plan, stream.rounding), allow_nan=False)
    )
    tare = Tare.from_dict(notes["tare"], tiles=2)
    plan = make_plan(
        array(),
        Calibration.model_validate(notes["calibration"]),
        tare,
        models=notes["models"],
        lag_ms=notes["lag_ms"],
    )
    estimator = ModelEstimator(plan)
    first, last = estimator.process_frames(batch), estimator.finish()
    assert last is not None
    again = {
        f.name: np.concatenate([getattr(first, f.name), getattr(last, f.name)])
        for f in fields(Estimates)
        if f.name not in ("seq", "t_ns")
    }
    same(again, columns)


def test_the_notes_say_what_was_used() -> None:
    stream, _, _ = run([(frames(hopping(300, loaded_from=100), lead=100), {})], lag_ms=100.0)
    assert stream.plan is not None
    notes = make_estimate_metadata(stream.plan, stream.rounding)
    assert notes["calibration_id"] == calibration().id
    assert notes["absolute_scale"] == "measured"
    assert notes["models"] == ["unwrap", "static"]
    assert notes["lag_ms"] == 100.0
    tare = notes["tare"]
    assert isinstance(tare, dict)
    assert set(tare) == {
        *("baseline_kpa", "baseline_sigma_kpa", "noise_kpa", "temperature_raw_counts"),
        *("noise_lasting", "noise_lasting_s", "t_ns", "begin_s", "end_s", "frames", "source"),
    }
    assert (tare["source"], tare["frames"], tare["t_ns"]) == ("lead", 100, 10**18 + 198_000_000)


def test_the_notes_have_the_calibration_that_they_name_and_say_if_its_scale_is_assumed() -> None:
    # A bench of eight tiles, a foot of two of them: what is kept must be found by the id stated.
    many = calibration("T07", "T02", "T01", "T05", absolute_scale="assumed")
    stream, _, _ = run([(frames(hopping(99, loaded_from=50), lead=50), {})], calibration=many)
    assert stream.plan is not None
    notes = make_estimate_metadata(stream.plan, stream.rounding)
    assert Calibration.model_validate(notes["calibration"]).id == notes["calibration_id"]
    assert notes["absolute_scale"] == "assumed"


def test_faults_in_the_lead_leave_the_rest_of_it_as_tare() -> None:
    batch = frames(hopping(200, loaded_from=100), lead=100)
    status = batch.tile_flags.copy()
    status[:30, 1] = TileFlag.NO_ANSWER
    stream, _, columns = run(cut(replace(batch, tile_flags=status), [50]))
    assert stream.plan is not None
    assert stream.plan.tare.baseline_kpa == pytest.approx([UNLOADED_KPA] * 2, abs=0.1)
    assert np.isnan(columns["grf_n"]).sum() == 30
