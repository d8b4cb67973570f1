"""A long session in pieces: joined, it is to the byte what it is in one go."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from devices.errors import DamagedFileError, FileFormatError, TareError
from devices.frames import FrameBatch
from service.estimation.pipeline.params import MODEL_NAMES
from service.offline.estimate.preparation import EstimateRequest
from service.offline.estimate.session import (
    estimate_next_chunk,
    estimate_session,
    join_chunks,
    needs_chunks,
)
from storage.documents import append_json_checksum
from storage.formats.slice import Slice
from storage.parquet_hash import compute_sha256
from storage.sessions.writer import SealedFileWriter
from tests.builders.calibrations import make_calibration, make_effects, newton_tile
from tests.service.sessions.pieces import array, frames, hopping
from tests.service.sessions.test_estimate_stream_tares import later_part, taken_at

PERIOD_NS = 20_000_000
MINUTE = 3000
"""Frames, and one row group of them."""
WHOLE = tuple(model for model in MODEL_NAMES if model != "ambient")


def ignored(_: str) -> None: ...


def written(path: Path, *batches: FrameBatch, **notes: Any) -> Path:
    known = newton_tile("T01", effects=make_effects()), newton_tile("T02", effects=make_effects())
    notes["calibration"] = make_calibration(*known).model_dump(mode="json")
    with SealedFileWriter(path, array(50.0), notes) as writer:
        for part, batch in enumerate(batches):
            writer.append_frames(batch, {"part": np.full(len(batch), part, np.uint16)})
    return path


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four minutes and a half, then switched on again for two."""
    rng = np.random.default_rng(3)
    first = frames(hopping(13_500, loaded_from=200), lead=200, period_ns=PERIOD_NS)
    first = first.select_rows(rng.random(13_500) > 0.02)  # with gaps
    second = frames(hopping(6000, loaded_from=100, seed=1), period_ns=PERIOD_NS)
    path = tmp_path_factory.mktemp("raw") / "raw.parquet"
    return written(path, first, later_part(second, 3 * 10**11))


def request(**changes: Any) -> EstimateRequest:
    asked: dict[str, Any] = {"models": WHOLE, "lag_ms": 100.0, "scene": None, "tare_s": None}
    return EstimateRequest(calibration=None, **asked | changes)


def in_one_go(source: Path, folder: Path, asked: EstimateRequest) -> bytes:
    out = folder / "frames.parquet"
    estimate_session(source, out, asked, on_remark=ignored, with_findings=False)
    return out.read_bytes() + (folder / "stances.parquet").read_bytes()


def in_pieces(source: Path, folder: Path, asked: EstimateRequest, piece_frames: int) -> bytes:
    (folder / "pieces").mkdir()
    while estimate_next_chunk(
        source, folder / "pieces", asked, chunk_frames=piece_frames, on_remark=ignored
    ):
        pass
    out = folder / "frames.parquet"
    join_chunks(source, folder / "pieces", out, asked, on_remark=ignored)
    return out.read_bytes() + (folder / "stances.parquet").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"models": ("static",), "unquantized": True},
        {"lag_ms": 60_000.0},  # as long as a piece: the first gives nothing, or next to it
        {"tare_s": (70.0, 71.0), "models": ("static", "denoise")},  # not in the first one
    ],
)
def test_joined_pieces_are_the_bytes_that_one_process_makes(
    raw: Path, tmp_path: Path, changes: dict[str, Any]
) -> None:
    asked = request(**changes)
    whole = in_one_go(raw, tmp_path, asked)
    for piece_frames, count in ((1, 6 if "tare_s" in changes else 7), (6000, 4), (15_000, 2)):
        folder = tmp_path / str(piece_frames)
        folder.mkdir()
        assert in_pieces(raw, folder, asked, piece_frames) == whole, piece_frames
        assert len(list((folder / "pieces").glob("*.json"))) == count


def test_a_tare_that_is_taken_on_the_way_is_in_force_in_the_pieces_after_it(tmp_path: Path) -> None:
    tares = [taken_at(0, 0.0), taken_at(100 * 10**9, 5.0), taken_at(170 * 10**9, 2.0)]
    batch = frames(hopping(12_000, loaded_from=200), period_ns=PERIOD_NS)
    source = written(tmp_path / "raw.parquet", batch, tares=[tare.as_dict() for tare in tares])
    whole = in_one_go(source, tmp_path, request())
    (folder := tmp_path / "in pieces").mkdir()
    assert in_pieces(source, folder, request(), 1) == whole


@pytest.fixture(scope="module")
def static(raw: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return in_one_go(raw, tmp_path_factory.mktemp("whole"), request(models=("static",)))


@pytest.mark.slow
@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(lost=st.lists(st.tuples(st.integers(0, 6), st.sampled_from(["json", "npz", "parquet"]))))
def test_a_kill_at_any_time_costs_the_piece_that_was_not_finished(
    raw: Path, static: bytes, tmp_path_factory: pytest.TempPathFactory, lost: list[tuple[int, str]]
) -> None:
    # Files of a piece appear in this order: parquet, npz, json.
    folder, asked = tmp_path_factory.mktemp("killed"), request(models=("static",))
    broken = dict(lost)
    made = 0
    while estimate_next_chunk(raw, folder, asked, chunk_frames=1, on_remark=ignored):
        number = made % 7
        if (last := broken.pop(number, None)) is not None:
            for ending in ("json", "npz", "parquet")[: ["json", "npz", "parquet"].index(last) + 1]:
                (folder / f"{number:04}.{ending}").unlink()
        else:
            made += 1
    assert made == 7
    out = folder / "frames.parquet"
    join_chunks(raw, folder, out, asked, on_remark=ignored)
    assert out.read_bytes() + (folder / "stances.parquet").read_bytes() == static


@pytest.mark.parametrize("ending", ["npz", "parquet", "json"])
def test_a_damaged_piece_is_refused_and_says_what_to_do(
    raw: Path, tmp_path: Path, ending: str
) -> None:
    asked = request(models=("static",))
    pieces = tmp_path / "pieces"
    pieces.mkdir()
    estimate_next_chunk(raw, pieces, asked, chunk_frames=9 * MINUTE, on_remark=ignored)
    path = pieces / f"0000.{ending}"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(DamagedFileError):
        join_chunks(raw, pieces, tmp_path / "out.parquet", asked, on_remark=ignored)
    assert [path.name for path in tmp_path.iterdir()] == ["pieces"]


def test_a_state_of_another_array_is_refused(raw: Path, tmp_path: Path) -> None:
    asked = request(models=("static",))
    estimate_next_chunk(raw, tmp_path, asked, chunk_frames=1, on_remark=ignored)
    with np.load(tmp_path / "0000.npz") as kept:
        columns = dict(kept)
    columns["run/tile_states"] = columns["run/tile_states"][:1]
    np.savez(tmp_path / "0000.npz", **columns)
    said = json.loads((tmp_path / "0000.json").read_text())
    said = {name: said[name] for name in ("number", "groups", "frames", "sha256")}
    said["sha256"]["npz"] = compute_sha256(tmp_path / "0000.npz")
    (tmp_path / "0000.json").write_bytes(append_json_checksum(json.dumps(said).encode()))
    with pytest.raises(DamagedFileError, match="another session"):
        estimate_next_chunk(raw, tmp_path, asked, chunk_frames=1, on_remark=ignored)


def test_frames_out_of_order_across_pieces_are_refused_as_in_one_go(tmp_path: Path) -> None:
    batch = frames(hopping(6000, loaded_from=200), lead=200, period_ns=PERIOD_NS)
    seq = np.concatenate([batch.seq[:3000], batch.seq[2000:5000]])
    source = written(tmp_path / "raw.parquet", replace(batch, seq=seq))
    asked = request(models=("static",))
    with pytest.raises(FileFormatError, match="frame 2000 follows frame 2999") as in_one:
        estimate_session(source, tmp_path / "a.parquet", asked, on_remark=ignored)
    with pytest.raises(FileFormatError) as joined:
        in_pieces(source, tmp_path, asked, 1)
    assert str(joined.value) == str(in_one.value)


def test_only_a_long_session_that_is_wanted_whole_has_pieces(raw: Path) -> None:
    assert needs_chunks(raw, request(), 3 * MINUTE)
    assert not needs_chunks(raw, request(), 10 * MINUTE)
    assert not needs_chunks(raw, request(part=Slice(1.0, 200.0)), 1)


def test_a_session_without_a_tare_is_read_to_its_end_and_refused(tmp_path: Path) -> None:
    n = np.random.default_rng(1).normal(30.0, 9.0, (9000, 2))
    source = written(tmp_path / "raw.parquet", frames(n, period_ns=PERIOD_NS))
    with pytest.raises(TareError):
        estimate_next_chunk(source, tmp_path, request(), chunk_frames=1, on_remark=ignored)
    assert {path.name for path in tmp_path.iterdir()} == {"raw.parquet"}
