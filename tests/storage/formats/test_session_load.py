"""Sessions of ours as recorded loads: sealed or exported, what was pressed is pressed again."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from devices.emulation.ground.load_trace import LoadTrace
from devices.errors import LoadTraceError
from storage.formats.export import make_one_pass_frame_source
from storage.formats.load_trace import read_load_to_emulate
from storage.formats.readers.registry import read_table
from storage.formats.slice import FormatOptions, Slice
from storage.schema import Array
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import PERIOD_NS, make_array, make_tile
from tests.builders.frames import make_frames
from tests.storage.formats.exports import export

ROWS = 20
ARRAY = make_array([make_tile(0), make_tile(1, reference=True), make_tile(2)])
RNG = np.random.default_rng(3)
ESTIMATE_N = RNG.uniform(1.0, 20.0, (ROWS, 3)).astype(np.float32).astype(np.float64)
ESTIMATE_N[:, 1] = np.nan
TRUE_N = np.where(np.isnan(ESTIMATE_N), 0.0, ESTIMATE_N + 1.0)

ESTIMATES = {
    "force_n": ESTIMATE_N,
    "grf_n": np.nansum(ESTIMATE_N, axis=1),
    "cop_x_m": np.where(np.arange(ROWS) % 4, 0.01, np.nan),
    "cop_y_m": np.full(ROWS, -0.01),
    "angle_rad": np.where(np.arange(ROWS) < 2, np.nan, 0.1),  # before the servo's first answer
}
TRUTH = {
    "true_force_n": TRUE_N,
    "true_grf_n": TRUE_N.sum(axis=1),
    "true_cop_x_m": np.full(ROWS, 0.02),
    "true_cop_y_m": np.full(ROWS, 0.03),
    "true_angle_rad": np.full(ROWS, 0.2),
}


def written(path: Path, columns: dict[str, Array]) -> Path:
    with SealedFileWriter(path, ARRAY, {}) as file:
        file.append_frames(make_frames(ROWS, 3), columns)
    return path


def exported(folder: Path, to: str, columns: dict[str, Array], *names: str) -> Path:
    path = folder / f"out.{to}"
    pieces = [(make_frames(ROWS, 3), columns)]
    content = make_one_pass_frame_source(pieces)
    path.write_bytes(b"".join(export(content, ARRAY, {}, to, Slice(columns=names))))
    return path


def cells(trace: LoadTrace) -> Array:
    assert trace.cells_n is not None
    return trace.cells_n


def test_a_sealed_session_presses_its_estimates_on_loaded_tiles(tmp_path: Path) -> None:
    trace = read_load_to_emulate(written(tmp_path / "s.parquet", ESTIMATES))
    np.testing.assert_array_equal(cells(trace), ESTIMATE_N[2:, [0, 2]])  # from the first angle on
    np.testing.assert_allclose(trace.time_s, np.arange(2, ROWS) * PERIOD_NS * 1e-9, rtol=1e-12)
    assert trace.angle_rad is not None
    np.testing.assert_allclose(trace.angle_rad, 0.1, rtol=1e-6)


@pytest.mark.parametrize("to", ["parquet", "csv"])
def test_true_forces_go_before_estimates(tmp_path: Path, to: str) -> None:
    trace = read_load_to_emulate(exported(tmp_path, to, ESTIMATES | TRUTH))
    np.testing.assert_allclose(cells(trace), TRUE_N[:, [0, 2]], rtol=1e-15)
    assert trace.angle_rad is not None
    np.testing.assert_allclose(trace.angle_rad, 0.2)
    assert len(trace.time_s) == ROWS


@pytest.mark.parametrize("to", ["parquet", "csv"])
def test_a_grf_with_its_cop_is_a_load(tmp_path: Path, to: str) -> None:
    names = ("t_ns", "grf_n", "cop_x_m", "cop_y_m")
    trace = read_load_to_emulate(exported(tmp_path, to, ESTIMATES, *names))
    assert trace.cells_n is None
    assert trace.fz_n is not None
    assert trace.cop_m is not None
    np.testing.assert_allclose(trace.fz_n, ESTIMATES["grf_n"], rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(trace.cop_m[:, 0]), np.arange(ROWS) % 4 == 0)


@pytest.mark.parametrize("to", ["parquet", "csv"])
def test_a_grf_of_one_row_of_tiles_has_a_constant_across_it(tmp_path: Path, to: str) -> None:
    names = ("t_ns", "grf_n", "cop_x_m", "cop_y_m")
    row = ESTIMATES | {"cop_y_m": np.full(ROWS, np.nan)}
    trace = read_load_to_emulate(exported(tmp_path, to, row, *names))
    assert trace.cop_m is not None
    np.testing.assert_array_equal(np.isnan(trace.cop_m[:, 0]), np.arange(ROWS) % 4 == 0)
    np.testing.assert_array_equal(trace.cop_m[:, 1], 0.0)
    neither = read_load_to_emulate(
        exported(tmp_path, to, row | {"cop_x_m": row["cop_y_m"]}, *names)
    )
    assert neither.cop_m is not None
    assert np.isnan(neither.cop_m).all()


def test_rows_without_forces_are_left_out_at_the_ends_only(tmp_path: Path) -> None:
    columns = {"force_n": ESTIMATE_N.copy()}
    columns["force_n"][:3, 0] = np.nan
    columns["force_n"][-2:, 2] = np.nan
    trace = read_load_to_emulate(written(tmp_path / "s.parquet", columns))
    np.testing.assert_array_equal(cells(trace), ESTIMATE_N[3:-2, [0, 2]])
    columns["force_n"][10, 0] = np.nan
    with pytest.raises(LoadTraceError, match=r"cell1_n is nan at row 8"):
        read_load_to_emulate(written(tmp_path / "s.parquet", columns))


def test_raw_frames_are_refused_with_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(LoadTraceError, match=re.escape("Estimate it first")):
        read_load_to_emulate(written(tmp_path / "s.parquet", {}))


def test_a_session_without_known_forces_is_refused(tmp_path: Path) -> None:
    nothing = {"force_n": np.full((ROWS, 3), np.nan)}
    with pytest.raises(LoadTraceError, match="no row of it has a load"):
        read_load_to_emulate(written(tmp_path / "s.parquet", nothing))


def test_forces_of_some_tiles_only_are_refused(tmp_path: Path) -> None:
    path = exported(tmp_path, "csv", ESTIMATES, "t_ns", "force_n_2")
    with pytest.raises(LoadTraceError, match=re.escape("forces of tiles 2 only")):
        read_load_to_emulate(path)


def test_an_export_for_excel_is_read_again_with_its_umlauts(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    info = make_array([make_tile(0, serial="Größe"), make_tile(1)])
    content = make_one_pass_frame_source(
        [(make_frames(ROWS, 2), {"force_n": ESTIMATE_N[:, [0, 2]]})]
    )
    options = FormatOptions(names="serial", times=True, decimal="comma", about=True)
    path.write_bytes(b"".join(export(content, info, {}, "csv", Slice(), options=options)))
    assert path.read_bytes().startswith(codecs.BOM_UTF8)
    table = read_table(path, lambda name: name.startswith("force_n"))
    found = table.columns["force_n_Größe"].astype(np.float32)
    np.testing.assert_array_equal(found, ESTIMATE_N[:, 0])


def test_a_session_rewritten_by_another_program_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "s.parquet", ESTIMATES)
    pq.write_table(pq.read_table(path), path)
    with pytest.raises(LoadTraceError, match="another program has rewritten it"):
        read_load_to_emulate(path)


def test_an_arrow_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LoadTraceError, match=r"ends in \.parquet"):
        read_load_to_emulate(exported(tmp_path, "arrow", ESTIMATES))
