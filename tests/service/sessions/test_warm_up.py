"""Warm-up frames: what domes bore before a session is kept with it, and is none of its frames."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import service.sessions.sealing as sealing_module
from devices.arrays import Columns
from devices.errors import StorageError
from devices.flags import EstimateFlag
from devices.frames import FrameBatch
from service.estimation import LIVE_LAG_MS, OFFLINE_LAG_MS
from service.estimation.calibration import Calibration
from service.estimation.records import ColumnDict
from service.offline.estimate.preparation import EstimateRequest
from service.offline.estimate.session import (
    estimate_next_chunk,
    estimate_session,
    join_chunks,
)
from service.sessions.estimate_stream import EstimateOptions, EstimateStream
from service.sessions.inputs import SessionInputs
from service.sessions.parts import compute_warm_up
from service.sessions.preview import SessionPreview
from service.sessions.preview_frames import PreviewFrames
from service.sessions.recovery import recover_locked_folder
from service.sessions.tares import TareHistory
from storage.formats.slice import Slice
from storage.intervals import Intervals
from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes
from storage.schema import ESTIMATE_COLUMNS
from storage.sessions.folder import FRAMES_NAME, WARM_UP_NAME, Part
from storage.sessions.reader import SealedFileReader
from storage.verify.data_folder import find_verdict, verify_path
from tests.builders.arrays import make_array
from tests.builders.calibrations import make_calibration, make_effects, make_tare, newton_tile
from tests.builders.frames import loaded_frames
from tests.service.sessions.crashed import BOOT, ID, loaded, outcomes, servers, session
from tests.storage.faulty_disk import flip_bits, refusing

MODELS = ("unwrap", "static", "denoise", "hysteresis", "rubber")
INFO = make_array(2, stream_id=BOOT, models=MODELS)
TARE = make_tare(2, t_ns=INFO.utc_offset_ns)
FRAMES, FIRST = 3000, 1500
"""The session begins three seconds after the stream, and two after the foot was put down."""
WARM_UP = Part(stream_id=BOOT, seq_first=0, seq_last=FIRST - 1)


def calibration() -> Calibration:
    return make_calibration(*(newton_tile(s, effects=make_effects()) for s in INFO.serials))


def options() -> EstimateOptions:
    return EstimateOptions(calibration(), MODELS, OFFLINE_LAG_MS, tares=(TARE,))


def stream_frames() -> FrameBatch:
    """A second in the air, then standing; a count of noise."""
    force_n = np.where(np.arange(FRAMES) < 500, 0.0, 60.0)[:, None] + np.array([0.0, 10.0])
    noise_n = np.random.default_rng(1).integers(-1, 2, (FRAMES, 2))
    return loaded_frames(np.where(force_n > 10.0, force_n, 0.0) + noise_n)


def of_whole_stream(lag_ms: float = OFFLINE_LAG_MS) -> Columns:
    """Estimates of all frames of the stream: what live has seen."""
    stream = EstimateStream(INFO, replace(options(), lag_ms=lag_ms))
    pieces = list(stream.estimate_batches([(stream_frames(), {})]))
    return {name: np.concatenate([c[name] for _, c in pieces]) for name in pieces[0][1]}


def pending(data: Path, *, lacking: tuple[tuple[int, int], ...] = (), **changes: Any) -> Path:
    """A server's folder with a session whose frames are all here; its own folder."""
    folder = servers(data) / "journal" / "bench" / BOOT
    TareHistory(data / "nodes" / "bench" / "tares.json").store_tare_in_force(TARE, INFO)
    journal, frames = Journal(folder, INFO), stream_frames()
    for first, last in Intervals([(0, FRAMES - 1)]) - Intervals(lacking):
        for begin in range(first, last + 1, 100):
            end = min(begin + 100, last + 1)
            journal.append_new_frames(frames.slice_rows(begin, end))
    journal.close()
    StreamNotes(array_info=INFO, next_seq=FRAMES).save(folder)
    part = Part(stream_id=BOOT, seq_first=FIRST, seq_last=FRAMES - 1)
    content: dict[str, Any] = {
        "state": "pending",
        "stopped_t_ns": int(frames.t_ns[-1]),
        "parts": (part,),
        "warm_up": WARM_UP,
        "calibration": calibration().model_dump(mode="json"),
    }
    session(data, **content | changes)
    return data / "sessions" / ID


def sealed(data: Path, **how: Any) -> Path:
    """The folder of such a session once it is sealed."""
    folder = pending(data, **how)
    recovery = recover_locked_folder(data)
    assert (outcomes(recovery), recovery.problems) == (["sealed"], [])
    assert recovery.sessions[0].problem == ""
    return folder


def estimates(path: Path) -> Columns:
    names = [column.name for column in ESTIMATE_COLUMNS]
    with SealedFileReader(path) as reader:
        pieces = list(reader.read_quantities("seq", *names))
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def request(**changes: Any) -> EstimateRequest:
    content: dict[str, Any] = {
        "calibration": None,
        "models": None,
        "lag_ms": OFFLINE_LAG_MS,
        "scene": None,
        "tare_s": None,
    }
    return EstimateRequest(**content | changes)


def estimated(folder: Path, out: Path, **changes: Any) -> tuple[Columns, list[str]]:
    """Estimates of a session's folder by `foottile estimate`, and its remarks."""
    remarks = list[str]()
    estimate_session(
        folder / FRAMES_NAME,
        out,
        request(**changes),
        on_remark=remarks.append,
        with_findings=False,
    )
    return estimates(out), remarks


def assert_same(one: Columns, other: Columns) -> None:
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)


def is_unknown(found: Columns) -> Any:
    return (found["estimate_flags"] & np.uint16(EstimateFlag.HISTORY_UNKNOWN)) != 0


# --- estimates ------------------------------------------------------------------------------------


def test_a_session_has_the_estimates_of_the_stream_that_it_was_cut_from(tmp_path: Path) -> None:
    folder = sealed(tmp_path)
    found, whole = {**estimates(folder / FRAMES_NAME)}, of_whole_stream()
    assert found.pop("seq").tolist() == list(range(FIRST, FRAMES))
    assert not is_unknown(found).any()
    with SealedFileReader(folder / FRAMES_NAME) as reader:
        names = {c.name for c in ESTIMATE_COLUMNS if reader.has_columns(c.name)}
    assert_same({name: found[name] for name in names}, {n: v[FIRST:] for n, v in whole.items()})


def test_every_later_estimate_has_the_bits_of_the_sealed_one(tmp_path: Path) -> None:
    folder = sealed(tmp_path / "data")
    first = estimates(folder / FRAMES_NAME)
    again, remarks = estimated(folder, tmp_path / "again.parquet")
    assert remarks == []
    assert_same(first, again)
    part, _ = estimated(folder, tmp_path / "part.parquet", part=Slice(end_s=1.0))
    assert_same(part, {name: values[: len(part["seq"])] for name, values in first.items()})
    chunks = tmp_path / "chunks"
    chunks.mkdir()
    while estimate_next_chunk(
        folder / FRAMES_NAME, chunks, request(), chunk_frames=400, on_remark=remarks.append
    ):
        pass
    joined = tmp_path / "joined.parquet"
    join_chunks(folder / FRAMES_NAME, chunks, joined, request(), on_remark=remarks.append)
    assert_same(first, estimates(joined))


def test_a_state_is_taken_while_warm_up_frames_wait_for_their_look_ahead() -> None:
    frames, first = stream_frames(), FIRST
    stream, found = EstimateStream(INFO, options()), list[tuple[FrameBatch, ColumnDict]]()
    before: list[tuple[FrameBatch, Columns]] = [(frames.slice_rows(0, first), {})]
    for begin in range(first, first + 70, 7):
        piece: tuple[FrameBatch, Columns] = (frames.slice_rows(begin, begin + 7), {})
        found += list(stream.estimate_batches([piece], warm_up=before, is_final=False))
        state = stream.state_dict()
        stream = EstimateStream(INFO, options())
        stream.load_state(state)
    found += list(stream.estimate_batches([]))
    seq = np.concatenate([batch.seq for batch, _ in found])
    assert seq.tolist() == list(range(first, first + 70))
    grf_n = np.concatenate([columns["grf_n"] for _, columns in found])
    np.testing.assert_array_equal(grf_n[:20], of_whole_stream()["grf_n"][first : first + 20])


def test_without_history_the_frames_say_so(tmp_path: Path) -> None:
    folder = sealed(tmp_path / "data", warm_up=None)
    assert not (folder / WARM_UP_NAME).exists()
    found, whole = estimates(folder / FRAMES_NAME), of_whole_stream()
    assert is_unknown(found)[:200].all()
    assert (found["grf_sigma_n"][:50] > 2.0 * whole["grf_sigma_n"][FIRST : FIRST + 50]).all()
    again, remarks = estimated(folder, tmp_path / "again.parquet")
    assert remarks == []
    assert_same(found, again)


def test_a_preview_has_the_history_that_live_had(tmp_path: Path) -> None:
    pending(tmp_path)
    journal = Journal(tmp_path / "journal" / "bench" / BOOT, INFO)
    inputs = SessionInputs(
        session=loaded(tmp_path),
        info=INFO,
        journals={BOOT: journal},
        calibration=calibration(),
        problem=None,
        tares=(TARE,),
        notes={},
    )
    preview = SessionPreview(inputs, tmp_path)
    for _ in range(2):  # in one run, then from the places that the first has left
        source = PreviewFrames(preview, inputs, Slice()).make_one_pass_source()
        grf_n = np.concatenate([columns["grf_n"] for columns in source.read_columns(["grf_n"])])
        np.testing.assert_array_equal(grf_n, of_whole_stream(LIVE_LAG_MS)["grf_n"][FIRST:])
        preview.advance_within_time_limit(inputs)


# --- files ----------------------------------------------------------------------------------------


def test_warm_up_frames_are_no_frames_of_the_session(tmp_path: Path) -> None:
    folder = sealed(tmp_path)
    done = loaded(tmp_path)
    assert done.ledger is not None
    assert (done.frames, done.ledger.recorded) == (FRAMES - FIRST, FRAMES - FIRST)
    report = verify_path(folder)
    assert (report.problems, find_verdict(report)) == ([], "complete")
    with SealedFileReader(folder / WARM_UP_NAME) as reader:
        assert reader.read_frames().seq.tolist() == list(range(FIRST))


def test_a_lost_file_is_a_note_and_a_damaged_one_a_problem(tmp_path: Path) -> None:
    folder = sealed(tmp_path / "data")
    flip_bits(folder / WARM_UP_NAME, 40)
    (problem,) = verify_path(folder).to_json_dict()["problems"]
    assert problem.startswith(f"{WARM_UP_NAME}: it is damaged")
    found, remarks = estimated(folder, tmp_path / "damaged.parquet")
    assert [WARM_UP_NAME in remark for remark in remarks] == [True]
    assert is_unknown(found)[:200].all()
    (folder / WARM_UP_NAME).unlink()
    report = verify_path(folder)
    assert (find_verdict(report), report.problems) == ("unproven", [])
    assert [WARM_UP_NAME in each for each in report.to_json_dict()["unproven"]] == [True]
    lacking, remarks = estimated(folder, tmp_path / "lacking.parquet")
    assert ["is missing" in remark for remark in remarks] == [True]
    assert_same(found, lacking)


@pytest.mark.parametrize("lacking", [(700, 799), (0, FIRST - 1)])
def test_a_session_is_whole_without_them(tmp_path: Path, lacking: tuple[int, int]) -> None:
    folder = sealed(tmp_path, lacking=(lacking,))
    assert find_verdict(verify_path(folder)) == "complete"
    found = estimates(folder / FRAMES_NAME)
    assert len(found["seq"]) == FRAMES - FIRST
    assert is_unknown(found)[:200].all() == (lacking == (0, FIRST - 1))


def test_warm_up_frames_that_are_damaged_are_left_out(tmp_path: Path) -> None:
    folder = pending(tmp_path)
    (segment,) = (tmp_path / "journal" / "bench" / BOOT).glob("*.arrows")
    content = bytearray(segment.read_bytes())
    content[len(content) // 4] ^= 1
    segment.write_bytes(content)
    (one,) = recover_locked_folder(tmp_path).sessions
    assert one.outcome == "sealed"
    with SealedFileReader(folder / WARM_UP_NAME) as reader:
        left = reader.read_frames().seq
    assert len(left) == FIRST - 100
    assert find_verdict(verify_path(folder)) == "complete"


@pytest.mark.parametrize("step", ["StancesWriter", "write_markers", "write_sha256_sums"])
def test_a_sealing_that_was_cut_short_is_repeated_with_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    shutil.copytree(sealed(tmp_path / "whole"), tmp_path / "first")
    folder = pending(tmp_path / "data")
    with monkeypatch.context() as patch:
        patch.setattr(sealing_module, step, refusing(StorageError, "no room"))
        (one,) = recover_locked_folder(tmp_path / "data").sessions
    assert one.outcome == "failed"
    (again,) = recover_locked_folder(tmp_path / "data").sessions
    assert again.outcome == "sealed"
    for name in (WARM_UP_NAME, FRAMES_NAME):
        assert (folder / name).read_bytes() == (tmp_path / "first" / name).read_bytes()


def test_a_file_of_a_sealing_with_warm_up_frames_does_not_outlive_them(tmp_path: Path) -> None:
    folder = pending(tmp_path, warm_up=None)
    (folder / WARM_UP_NAME).write_bytes(b"of a sealing before")
    recover_locked_folder(tmp_path)
    assert not (folder / WARM_UP_NAME).exists()


# --- numbers --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("seq_first", "unloaded_seq", "expected"),
    [
        (0, None, None),  # the stream begins with the session
        (3, None, (0, 2)),
        (20_000, None, (15_000, 19_999)),  # ten seconds
        (20_000, 19_990, (15_000, 19_999)),
        (20_000, 9_000, (8_950, 19_999)),  # from before the load
        (900_000, 9_000, (600_000, 899_999)),  # the ring of ten minutes
    ],
)
def test_warm_up_frames_settle_the_models_and_reach_back_to_the_air(
    seq_first: int, unloaded_seq: int | None, expected: tuple[int, int] | None
) -> None:
    found = compute_warm_up(INFO, seq_first, 10.0, unloaded_seq)
    assert (None if found is None else (found.seq_first, found.seq_last)) == expected
