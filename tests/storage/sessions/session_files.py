"""Session files to be read, changed and refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from devices.errors import FileFormatError
from devices.frames import FrameBatch
from storage.parquet_hash import (
    FILE_HASH_KEY,
    FOOTER_HASH_KEY,
    HASH_PLACEHOLDER,
    fill_hash_placeholders_and_sync,
)
from storage.schema import ARRAY_INFO_KEY
from storage.sessions.footer import CONTENT_HASH_KEY, CONTENT_KEY, NOTES_KEY, compute_content_hash
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import PERIOD_NS, make_array
from tests.builders.frames import make_frames


def frames(rows: int, tiles: int = 2, *, seed: int = 0, period_ns: int = PERIOD_NS) -> FrameBatch:
    rng = np.random.default_rng(seed)
    shape = (rows, tiles)
    return make_frames(
        rows,
        tiles,
        period_ns=period_ns,
        pressure_raw=rng.integers(250, 420, shape),
        temperature_raw=rng.integers(470, 490, shape),
        sample_offset_us=rng.integers(-100, 3000, shape),
        servo_counts=rng.integers(-5000, 5000, rows),
        servo_age_us=rng.integers(0, 20000, rows),
        tile_flags=rng.integers(0, 64, shape),
        frame_flags=rng.integers(0, 32, rows),
        reference_force_n=rng.normal(0, 30, rows),
    )


def write(
    path: Path, batch: FrameBatch, notes: dict[str, object] | None = None, **extra: np.ndarray
) -> Path:
    with SealedFileWriter(path, make_array(batch.tile_count), notes or {}) as writer:
        writer.append_frames(batch, extra)
    return path


def read(path: Path) -> FrameBatch:
    with SealedFileReader(path) as session:
        return session.read_frames()


def rewritten(path: Path, table: pa.Table, **metadata: bytes | None) -> Path:
    """The table with these metadata changed and right hashes; None takes an entry out."""
    said = {f"foottile.{key}".encode(): value for key, value in metadata.items()}
    merged = {**table.schema.metadata, **said}
    kept = {key: value for key, value in merged.items() if value is not None}
    info, notes = kept.get(ARRAY_INFO_KEY, b""), kept.get(NOTES_KEY, b"")
    content_hash = compute_content_hash(info, notes, b"{}")
    hashes = {CONTENT_KEY: b"{}", CONTENT_HASH_KEY: content_hash.encode()}
    hashes |= dict.fromkeys((FOOTER_HASH_KEY, FILE_HASH_KEY), HASH_PLACEHOLDER)
    table = table.replace_schema_metadata(kept)
    with pq.ParquetWriter(path, table.schema, write_page_checksum=True) as file:
        file.write_table(table)
        file.add_key_value_metadata({key.decode(): text.decode() for key, text in hashes.items()})
    fill_hash_placeholders_and_sync(path)
    return path


def refused(path: Path, match: str | None = None) -> None:
    with pytest.raises(FileFormatError, match=match) as caught:
        read(path)
    assert str(path) in str(caught.value)
