"""MATLAB files, read by scipy, and by Octave where it is installed."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat

from devices.flags import CONTACT_UNKNOWN
from devices.frames import NO_SERVO_COUNTS, NOT_READ
from storage.formats.export import make_sealed_export
from storage.formats.slice import NO_OPTIONS, Slice
from storage.formats.writers import matlab
from storage.formats.writers.matlab import MATLAB
from storage.sessions import reader as reader_module
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import make_array
from tests.storage.formats.exports import ROWS, extra, frames
from tests.storage.formats.walks import DOCUMENT
from tests.storage.formats.writers.test_mcap import LABEL, markers

SCRIPT = """
s = load("{path}");
assert(isa(s.t_ns, "int64") && isequal(size(s.force_n), [{rows} 2]));
fprintf("%d %s %.3f %d %s\\n", ...
  s.t_ns(3), s.units.grf_n, s.time_s(3), s.markers.row, s.about.session);
fprintf("%s\\n", datestr(double(s.t_ns(1)) / 86400e9 + 719529, "yyyy-mm-dd HH:MM:SS"));
p = load("{path}", "grf_n");
assert(isequal(fieldnames(p), {{"grf_n"}}));
"""


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("matlab") / "frames.parquet"
    with SealedFileWriter(path, make_array(), {"session": {"id": "s"}}) as writer:
        writer.append_frames(frames(), extra())
    return path


def written(path: Path, part: Slice | None = None) -> bytes:
    with SealedFileReader(path) as reader:
        export = make_sealed_export(reader, part or Slice(), markers=markers(), options=NO_OPTIONS)
        return b"".join(MATLAB.encode(export))


def loaded(content: bytes) -> dict[str, Any]:
    file: Any = io.BytesIO(content)  # its stubs know names of files only
    found: dict[str, Any] = loadmat(file, simplify_cells=True)
    return found


def test_every_quantity_is_a_variable_and_of_tiles_a_matrix(sealed: Path) -> None:
    batch, columns, found = frames(), extra(), loaded(written(sealed))
    assert found["t_ns"].dtype == np.int64
    assert found["t_ns"].tolist() == batch.t_ns.tolist()
    assert found["seq"].tolist() == batch.seq.tolist()
    np.testing.assert_allclose(found["time_s"], (batch.t_ns - batch.t_ns[0]) * 1e-9, rtol=1e-15)
    np.testing.assert_array_equal(found["force_n"], columns["force_n"].astype(np.float32))
    np.testing.assert_array_equal(found["grf_n"], columns["grf_n"].astype(np.float32))
    assert found["estimate_flags"].tolist() == columns["estimate_flags"].tolist()
    kinds = found["phase_kinds"][found["phase"] - 1]
    assert kinds.tolist() == columns["phase"].tolist()


def test_what_is_not_known_is_nan_and_no_number(sealed: Path) -> None:
    batch, columns, found = frames(), extra(), loaded(written(sealed))
    assert np.array_equal(np.isnan(found["pressure_raw"]), batch.pressure_raw == NOT_READ)
    assert np.array_equal(np.isnan(found["servo_counts"]), batch.servo_counts == NO_SERVO_COUNTS)
    assert np.array_equal(np.isnan(found["contact"]), columns["contact"] == CONTACT_UNKNOWN)
    known = batch.servo_counts != NO_SERVO_COUNTS
    assert found["servo_counts"][known].tolist() == batch.servo_counts[known].tolist()


def test_units_tiles_marks_and_facts_are_structs(sealed: Path) -> None:
    found = loaded(written(sealed))
    assert (found["units"]["force_n"], found["units"]["t_ns"]) == ("N", "ns")
    assert found["meaning"]["cop_x_m" if "cop_x_m" in found else "grf_n"]
    assert found["tiles"]["serial"].tolist() == [tile.serial for tile in make_array().tiles]
    places = [[tile.x_m, tile.y_m, tile.z_m] for tile in make_array().tiles]
    assert found["tiles"]["position_m"].tolist() == places
    assert (found["markers"]["label"], found["markers"]["row"]) == (LABEL, 13)
    about = found["about"]
    assert (about["session"], about["resampled"], about["complete"]) == ("s", "nothing", "null")
    assert json.loads(about["array_info"])["node"] == make_array().node
    assert about["begin_t_ns"] == frames().t_ns[0]


def test_a_slice_has_its_frames_and_columns_and_seconds_of_the_session(sealed: Path) -> None:
    found = loaded(written(sealed, Slice(0.02, 0.04, ("time_s", "force_n_1"))))
    assert [name for name in found if not name.startswith("__")] == [
        *("about", "units", "meaning", "tiles", "markers", "time_s", "force_n")
    ]
    np.testing.assert_allclose(found["time_s"], 0.02 + 0.002 * np.arange(10), atol=1e-12)
    assert found["markers"]["row"] == 3
    assert loaded(written(sealed, Slice(0.051, 0.0515)))["t_ns"].size == 0


def test_a_matrix_is_given_away_piece_by_piece_and_is_the_same(
    sealed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = written(sealed)
    monkeypatch.setattr(reader_module, "_PIECE_VALUES", 1)
    monkeypatch.setattr(reader_module, "_MIN_PIECE_ROWS", 7)
    with SealedFileReader(sealed) as reader:
        export = make_sealed_export(reader, Slice(None, None, ("force_n",)), options=NO_OPTIONS)
        assert 7 * 4 in {len(chunk) for chunk in MATLAB.encode(export)}
    assert written(sealed) == whole


def test_a_matrix_of_another_length_than_its_head_states_is_no_file(
    sealed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matlab, "_read_instants", lambda _: {"t_ns": np.zeros(ROWS - 1)})
    with pytest.raises(RuntimeError, match="its head states"):
        written(sealed)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("octave-cli") is None, reason="Octave is not installed")
def test_octave_reads_it(sealed: Path, tmp_path: Path) -> None:
    path = tmp_path / "session.mat"
    path.write_bytes(written(sealed))
    document = DOCUMENT.read_text("utf-8").split("```matlab\n")[1].split("```")[0]
    lines = [line for line in document.splitlines() if "% MATLAB" not in line]
    example = "\n".join(line for line in lines if "plot" not in line)  # there is no screen
    script = SCRIPT.format(path=path, rows=ROWS) + example
    done = subprocess.run(
        ["octave-cli", "--quiet", "--no-init-file", "--eval", script],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()
    t_ns = frames().t_ns
    assert first.split() == [str(t_ns[2]), "N", "0.004", "13", "s"]
    assert second == "2001-09-09 01:46:40"
