"""Compression of answers: static page files, and numbers of a session as JSON.

Other answers are sent as they are. The length of a compressed answer reveals the rest to an
attacker who chooses a part of the content (BREACH, CVE-2013-3587): page files are the same for
every client, and no part of the numbers comes from a request, while answers with names and notes
stay uncompressed. Parquet is compressed already.
"""

from __future__ import annotations

import gzip
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import ConfigDict, TypeAdapter

from storage.schema import Array

ARROW_STREAM = "application/vnd.apache.arrow.stream"
"""Media type of an Arrow IPC stream."""

_JSON = TypeAdapter(dict[str, Any], config=ConfigDict(ser_json_inf_nan="null"))
_LEVEL = 1
"""Compression level: 1 halves numbers within 10 ms; the best level takes ten times as long."""


def accepts_gzip(accept_encoding: str) -> bool:
    """Return whether a request's Accept-Encoding names gzip with a non-zero weight."""
    for one in accept_encoding.lower().replace(" ", "").split(","):
        coding, _, weight = one.partition(";q=")
        if coding == "gzip":
            return not weight or weight.strip("0.") != ""
    return False


def encode_columns_json(metadata: Mapping[str, object], columns: Mapping[str, Array]) -> bytes:
    """Encode metadata and columns of numbers as a JSON object; NaN becomes null.

    By pydantic, which takes a fifth of the time of Python's `json`.

    Args:
        metadata: metadata by name.
        columns: columns by name; single precision is written to a millionth: micrometres and
            micronewtons.
    """
    return _JSON.dump_json(
        {**metadata, "columns": {name: _to_list(v) for name, v in columns.items()}}
    )


def _to_list(values: Array) -> list[Any]:
    if values.dtype == np.float32:
        values = np.round(values.astype(np.float64), 6)
    plain: list[Any] = values.tolist()
    return plain


def compress_gzip(content: bytes) -> bytes:
    """Compress numbers with gzip at a fast level."""
    return gzip.compress(content, _LEVEL)


def encode_arrow_stream(table: pa.Table) -> bytes:
    """Encode a table as an Arrow IPC stream."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    content: bytes = sink.getvalue().to_pybytes()
    return content
