"""A part of a session estimated: what it would be in the whole, from no more than it needs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.errors import FileFormatError, TareError, UsageError
from service.estimation.pipeline.plan import (
    SETTLING_MIN_S,
    SETTLING_TIME_CONSTANTS,
    compute_settling_time_s,
)
from service.offline.estimate.preparation import EstimateRequest, select_tares_in_force
from service.offline.estimate.session import EstimateResult, estimate_session
from storage.formats.slice import Slice
from storage.schema import ESTIMATE_COLUMNS
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter
from storage.verify.sealed_file import verify_sealed_file
from tests.builders.calibrations import make_calibration, make_effects, make_tare, newton_tile
from tests.builders.estimates import newton_plan
from tests.service.sessions.pieces import array, calibration, frames, hopping

RATE_HZ = 50.0
PERIOD_NS = 20_000_000
SECONDS = 200
NAMES = [column.name for column in ESTIMATE_COLUMNS]
STATIC = ("static", "denoise")


def write(path: Path, **notes: Any) -> Path:
    """Two hundred seconds of hops, unloaded for the first four."""
    n = int(SECONDS * RATE_HZ)
    batch = frames(hopping(n, loaded_from=200), lead=200, period_ns=PERIOD_NS)
    with SealedFileWriter(path, array(RATE_HZ), notes) as writer:
        writer.append_frames(batch, {})
    return path


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    known = calibration().model_dump(mode="json")
    session = {"id": "whole"}
    return write(
        tmp_path_factory.mktemp("raw") / "raw.parquet",
        calibration=known,
        session=session,
        ledger={},
    )


def estimated(source: Path, out: Path, part: Slice, **changes: Any) -> EstimateResult:
    asked: dict[str, Any] = {
        "calibration": None,
        "models": STATIC,
        "lag_ms": 100.0,
        "scene": None,
        "tare_s": None,
        "unquantized": True,
    }
    request = EstimateRequest(part=part, **asked | changes)
    return estimate_session(source, out, request, on_remark=lambda _: None)


def columns_of(path: Path) -> dict[str, np.ndarray]:
    with SealedFileReader(path) as reader:
        pieces = list(reader.read_quantities("t_ns", "seq", *NAMES))
    return {name: np.concatenate([p[name] for p in pieces]) for name in ("t_ns", "seq", *NAMES)}


def rows_of(whole: dict[str, np.ndarray], start_s: float, end_s: float) -> dict[str, np.ndarray]:
    since_ns = whole["t_ns"] - whole["t_ns"][0]
    inside = (since_ns >= start_s * 1e9) & (since_ns < end_s * 1e9)
    return {name: values[inside] for name, values in whole.items()}


def test_a_part_has_the_bits_of_the_whole_if_its_models_forget(raw: Path, tmp_path: Path) -> None:
    estimated(raw, tmp_path / "whole.parquet", Slice())
    whole = columns_of(tmp_path / "whole.parquet")
    for begin_s, end_s in ((0.0, 2.0), (59.99, 60.01), (118.0, 125.0), (199.0, 500.0)):
        result = estimated(raw, tmp_path / "part.parquet", Slice(begin_s, end_s))
        part, expected = columns_of(tmp_path / "part.parquet"), rows_of(whole, begin_s, end_s)
        assert result.frame_count == len(part["seq"]) == len(expected["seq"]) > 0
        for name in part:
            np.testing.assert_array_equal(part[name], expected[name], err_msg=name)


def test_a_part_differs_by_less_than_its_sigma_if_its_models_remember(tmp_path: Path) -> None:
    known = make_calibration(
        *(newton_tile(serial, effects=make_effects()) for serial in ("T01", "T02"))
    )
    raw = write(tmp_path / "raw.parquet", calibration=known.model_dump(mode="json"))
    models = ("static", "gas", "rubber")
    estimated(raw, tmp_path / "whole.parquet", Slice(), models=models)
    estimated(raw, tmp_path / "part.parquet", Slice(150.0, 160.0), models=models)
    part = columns_of(tmp_path / "part.parquet")
    expected = rows_of(columns_of(tmp_path / "whole.parquet"), 150.0, 160.0)
    off_n = np.abs(part["grf_n"] - expected["grf_n"]).max()
    assert 0.0 < off_n < 0.1 * expected["grf_sigma_n"].min()


def test_a_file_of_a_part_says_so_and_proves_itself(raw: Path, tmp_path: Path) -> None:
    estimated(raw, tmp_path / "part.parquet", Slice(100.0, 110.0))
    with SealedFileReader(raw) as whole, SealedFileReader(tmp_path / "part.parquet") as part:
        assert part.notes["part_of"] == {
            **whole.session_id_and_hashes,
            "start_s": 100.0,
            "end_s": 110.0,
            "warm_up_s": SETTLING_MIN_S,
        }
        assert "session" not in part.notes
        assert "ledger" not in part.notes
    assert verify_sealed_file(tmp_path / "part.parquet").problems == []


def test_a_part_can_be_estimated_again_by_itself(raw: Path, tmp_path: Path) -> None:
    estimated(raw, tmp_path / "part.parquet", Slice(100.0, 110.0))
    estimated(tmp_path / "part.parquet", tmp_path / "again.parquet", Slice())
    part, again = columns_of(tmp_path / "part.parquet"), columns_of(tmp_path / "again.parquet")
    # Once what was before is forgotten, and as long as what comes after is there.
    known = slice(int(2 * RATE_HZ), -int(0.1 * RATE_HZ) - 1)
    np.testing.assert_array_equal(part["grf_n"][known], again["grf_n"][known])


def test_only_row_groups_that_are_needed_are_read(
    raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[int]] = []
    columns = SealedFileReader.read_quantities

    def noting(reader: SealedFileReader, *wanted: str, row_groups: Any = None) -> Any:
        asked.append(row_groups)
        return columns(reader, *wanted, row_groups=row_groups)

    monkeypatch.setattr(SealedFileReader, "read_quantities", noting)
    estimated(raw, tmp_path / "part.parquet", Slice(150.0, 160.0), tare_s=(0.5, 3.5))
    looking_for_a_tare, reading = [groups for groups in asked if groups != []]
    assert looking_for_a_tare is None  # of which only the beginning is read
    assert reading == (2,)


def test_the_tares_of_a_part_are_those_in_force_in_it() -> None:
    tares = [make_tare(t_ns=t_ns) for t_ns in (0, 100, 200)]
    assert select_tares_in_force(tares, None) == tuple(tares)
    assert select_tares_in_force(tares, 100) == tuple(tares)
    assert select_tares_in_force(tares, 101) == tuple(tares[1:])
    assert select_tares_in_force(tares, 1000) == tuple(tares[2:])


def test_models_run_before_a_part_for_five_times_what_they_remember() -> None:
    effects = make_effects()
    assert effects.rubber is not None
    tiles = [newton_tile(serial, effects=effects) for serial in ("T01", "T02")]
    longest_s = max(tau.value for tau in effects.rubber.tau_s)
    plan = newton_plan(array(), models=("static", "gas", "rubber"), tiles=tiles)
    assert compute_settling_time_s(plan) == max(SETTLING_MIN_S, SETTLING_TIME_CONSTANTS * longest_s)
    assert (
        compute_settling_time_s(newton_plan(array(), models=STATIC, tiles=tiles)) == SETTLING_MIN_S
    )


def test_a_part_that_is_not_there_is_refused_and_nothing_is_written(
    raw: Path, tmp_path: Path
) -> None:
    out = tmp_path / "part.parquet"
    with pytest.raises(UsageError, match=r"ends at 199\.98"):
        estimated(raw, out, Slice(201.0, 210.0))
    with pytest.raises(FileFormatError, match="no frames in that time"):
        estimated(raw, out, Slice(10.001, 10.002))
    with pytest.raises(UsageError, match="the session itself"):
        estimated(raw, raw, Slice(1.0, 2.0))
    assert not out.exists()


def test_a_part_has_no_tare_if_its_session_does_not_begin_unloaded(tmp_path: Path) -> None:
    path = tmp_path / "loaded.parquet"
    known = calibration().model_dump(mode="json")
    with SealedFileWriter(path, array(RATE_HZ), {"calibration": known}) as writer:
        writer.append_frames(frames(np.full((5000, 2), 20.0) + hopping(5000, loaded_from=0)), {})
    with pytest.raises(TareError):
        estimated(path, tmp_path / "part.parquet", Slice(2.0, 3.0))
