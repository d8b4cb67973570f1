"""The hashes in a sealed file: of what it says, however it is cut, and of every byte of it."""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError
from devices.frames import NO_SERVO_AGE, NOT_READ
from storage.parquet_hash import fill_hash_placeholders_and_sync, read_stated_and_actual_hash
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import make_array
from tests.builders.frames import make_frames
from tests.storage.formats.exports import extra, frames

FORMATS = Path(__file__).resolve().parents[3] / "docs" / "formats.md"


def write(path: Path, rows: int = 200, cuts: Sequence[int] = (), **notes: object) -> Path:
    """Frames over minutes, with everything in them that can be missing."""
    batch, columns = frames(rows, period_ns=1_000_000_000), extra(rows)
    columns["true_grf_n"] = np.where(columns["grf_n"] > 0.0, 1 / 3, np.nan)
    columns["part"] = np.sort(columns["contact"] // 255).astype(np.uint16)
    columns["phase"] = np.array(["rest", "Ärmel"] * rows, object)[:rows]
    columns["grf_n"][1::5], columns["grf_n"][2::5] = -1e-40, -0.0
    batch.temperature_raw[::3] = NOT_READ
    batch.servo_age_us[::4] = NO_SERVO_AGE  # also beside an angle that is known
    batch.reference_force_n[::3], batch.reference_force_n[1::3] = np.nan, -0.0
    batch.reference_force_n[2::3] = 3.25
    with SealedFileWriter(path, make_array(), notes) as writer:
        for begin, end in itertools.pairwise([0, *cuts, rows]):
            piece = {name: values[begin:end] for name, values in columns.items()}
            writer.append_frames(batch.slice_rows(begin, end), piece)
    return path


def metadata_of(path: Path) -> dict[bytes, bytes]:
    said = pq.ParquetFile(path).metadata.metadata
    assert said is not None
    return said


def content(path: Path) -> dict[str, Any]:
    with SealedFileReader(path) as reader:
        assert reader.content is not None
        return reader.content


@pytest.mark.process
def test_the_lines_in_the_documents_make_the_same_hashes(tmp_path: Path) -> None:
    section = FORMATS.read_text("utf-8").split("### Hashes")[1]
    code = section.split("```python")[1].split("```")[0]
    whole = write(tmp_path / "s.parquet", seed=7)
    script = tmp_path / "check.py"
    script.write_text(code)

    def run(path: Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, script, path], capture_output=True, text=True)

    agreed = run(whole)
    assert (agreed.returncode, agreed.stderr) == (0, "")
    digits = content(whole)["columns"]["grf_n"].encode()
    changed = whole.read_bytes().replace(digits, digits[::-1])
    (tmp_path / "other.parquet").write_bytes(changed)
    assert "AssertionError: grf_n" in run(tmp_path / "other.parquet").stderr


@settings(max_examples=20)
@given(st.lists(st.integers(1, 199), max_size=4, unique=True).map(sorted))
def test_content_has_one_hash_however_it_was_cut(
    tmp_path_factory: pytest.TempPathFactory, cuts: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("cut")
    whole = write(folder / "a.parquet")
    cut = write(folder / "b.parquet", 200, cuts)
    assert content(whole) == content(cut)


def test_row_groups_and_encodings_do_not_change_the_hashes_of_columns(tmp_path: Path) -> None:
    path = write(tmp_path / "s.parquet")
    said = content(path)
    other = tmp_path / "other.parquet"
    pq.write_table(pq.read_table(path), other, row_group_size=7, compression="snappy")
    from storage.sessions.footer import ContentDigest

    digest = ContentDigest()
    for group in range(pq.ParquetFile(other).num_row_groups):
        digest.add_table_and_collect_disorder(pq.ParquetFile(other).read_row_group(group))
    assert digest.describe_content() == said


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("reference_force_n", np.float32(np.nan), np.float32(0.0)),
        ("reference_force_n", np.float32(-0.0), np.float32(0.0)),
        ("pressure_raw", 65535, 65534),
        ("servo_age_us", -1, 0),
    ],
)
def test_a_missing_value_has_another_hash_than_a_number(
    tmp_path: Path, name: str, before: Any, after: Any
) -> None:
    found: list[dict[str, str]] = []
    for value in (before, after):
        batch = frames(3)
        getattr(batch, name)[...] = value
        path = tmp_path / f"{len(found)}.parquet"
        with SealedFileWriter(path, make_array(), {}) as writer:
            writer.append_frames(batch, {})
        found.append(content(path)["columns"])
    changed = {column for column in found[0] if found[0][column] != found[1][column]}
    assert {re.sub(r"_\d$", "", column) for column in changed} == {name}


def test_counts_and_parts_are_in_the_metadata(tmp_path: Path) -> None:
    with SealedFileWriter(tmp_path / "s.parquet", make_array(), {}) as writer:
        batch = frames(10)
        writer.append_frames(batch, {"part": np.array([0] * 4 + [1] * 6, np.uint16)})
    said = content(tmp_path / "s.parquet")
    assert said["frames"] == 10
    assert said["parts"] == [
        {"part": 0, "seq_first": 2**60, "seq_last": 2**60 + 3, "frames": 4},
        {"part": 1, "seq_first": 2**60 + 4, "seq_last": 2**60 + 9, "frames": 6},
    ]
    assert json.loads(metadata_of(tmp_path / "s.parquet")[b"foottile.content"]) == said


def test_notes_and_array_are_in_the_content_hash(tmp_path: Path) -> None:
    hashes = set()
    kept: tuple[dict[str, object], ...] = ({"a": 1}, {"a": 2}, {})
    for number, notes in enumerate(kept):
        with SealedFileReader(write(tmp_path / f"{number}.parquet", 200, (), **notes)) as reader:
            hashes.add(reader.content_sha256)
    assert len(hashes) == 3


@pytest.mark.parametrize("size", [0, 3, 11, 12, 100])
def test_a_file_too_short_for_a_hash_states_none(tmp_path: Path, size: int) -> None:
    path = write(tmp_path / "s.parquet", 40)
    path.write_bytes(path.read_bytes()[-size:] if size else b"")
    assert read_stated_and_actual_hash(path) is None
    with pytest.raises(FileFormatError, match="no place"):
        fill_hash_placeholders_and_sync(path)


def test_a_note_that_looks_like_the_hash_is_none(tmp_path: Path) -> None:
    trap = "foottile.file_sha256\x18\x40" + "0" * 64
    path = write(tmp_path / "s.parquet", trap=trap)
    stated, found = read_stated_and_actual_hash(path) or ("", "other")
    assert stated == found


def test_a_footer_with_exchanged_column_names_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    with SealedFileWriter(path, make_array(2), {}) as writer:
        writer.append_frames(make_frames(20, 2), {})
    whole = path.read_bytes()
    # Every page keeps its checksum: only the footer's names are exchanged.
    swapped = whole.replace(b"temperature_raw_0", b"temperature_raw_x").replace(
        b"temperature_raw_1", b"temperature_raw_0"
    )
    for changed in (
        swapped.replace(b"temperature_raw_x", b"temperature_raw_1"),
        whole.replace(b"pressure_raw_1", b"pressure_raw_0"),
    ):
        assert len(changed) == len(whole)
        path.write_bytes(changed)
        with pytest.raises(FileFormatError, match="changed since it was sealed"):
            SealedFileReader(path)
