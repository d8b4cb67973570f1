"""Hash of a sealed file's content, which the file carries in its footer.

The *content hash* covers the values, whatever the row groups and encodings: every column's numbers,
the array's description and the notes. The *file hash* (`storage.parquet_hash`) covers the bytes.
Both are in the footer, and docs/formats.md has the few lines that compute them.
"""

from __future__ import annotations

import hashlib
import json
import re
from typing import Any

import numpy as np
import pyarrow as pa

from storage.parquet_hash import FILE_HASH_KEY, FOOTER_HASH_KEY, HASH_PLACEHOLDER
from storage.schema import COLUMNS_BY_NAME
from storage.sessions.frame_order import FrameOrderChecker

CONTENT_KEY = b"foottile.content"
CONTENT_HASH_KEY = b"foottile.content_sha256"
_TILE_NUMBER = re.compile(r"_[0-9]+$")


class ContentDigest:
    """Incremental hash of columns, independent of how they are cut into tables."""

    def __init__(self) -> None:
        self.order = FrameOrderChecker()
        self._hashes: dict[str, Any] = {}

    def add_table_and_check_order(self, table: pa.Table) -> None:
        """Hash the next rows and check their order; every table must have the same columns."""
        for name in table.column_names:
            column = column_bytes_for_hash(name, table.column(name))
            self._hashes.setdefault(name, hashlib.sha256()).update(column)
        names = [n for n in ("seq", "t_mono_ns", "t_ns", "part") if n in self._hashes]
        self.order.add_and_check_frames({n: table.column(n).to_numpy() for n in names})

    @property
    def column_hashes(self) -> dict[str, str]:
        """Hash of every column, in hexadecimal digits."""
        return {name: hash_.hexdigest() for name, hash_ in self._hashes.items()}

    def describe_content(self) -> dict[str, Any]:
        """Return the description of the content: counts, and the hash of every column."""
        parts = self.order.parts
        return {
            "frames": sum(part.frames for part in parts),
            "parts": [
                {name: getattr(part, name) for name in ("part", "seq_first", "seq_last", "frames")}
                for part in parts
            ],
            "columns": self.column_hashes,
        }

    def compute_footer_entries(self, array_info: bytes, notes: bytes) -> dict[str, str]:
        """Return the footer's entries, with placeholders for the hashes of footer and file."""
        content = json.dumps(self.describe_content())
        return {
            CONTENT_KEY.decode(): content,
            CONTENT_HASH_KEY.decode(): compute_content_hash(array_info, notes, content.encode()),
            FOOTER_HASH_KEY.decode(): HASH_PLACEHOLDER.decode(),
            FILE_HASH_KEY.decode(): HASH_PLACEHOLDER.decode(),
        }


def column_bytes_for_hash(
    name: str, column: pa.ChunkedArray[Any] | pa.Array[Any]
) -> bytes | memoryview:
    """Return a column's bytes for hashing: little-endian numbers, nulls as missing values.

    A text is its UTF-8 and a zero byte.
    """
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        return b"".join((text or "").encode() + b"\0" for text in column.to_pylist())
    if column.null_count:
        quantity = COLUMNS_BY_NAME.get(_TILE_NUMBER.sub("", name))
        missing = quantity.missing_value if quantity is not None else None
        if pa.types.is_floating(column.type):
            missing = float("nan")  # type: ignore[assignment]  # of this column's own type
        column = column.fill_null(pa.scalar(missing if missing is not None else 0, column.type))
    values = column.to_numpy() if isinstance(column, pa.ChunkedArray) else column.to_numpy(False)
    return np.ascontiguousarray(values).view(np.uint8).data


def compute_content_hash(array_info: bytes, notes: bytes, content: bytes) -> str:
    """Compute the hash over description, notes and column hashes."""
    return hashlib.sha256(b"\n".join((array_info, notes, content))).hexdigest()
