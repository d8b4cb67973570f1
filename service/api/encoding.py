"""Which answers go over the wire compressed: the page's files, and numbers of a session as JSON.

The others do not. The length of a compressed answer tells someone who chooses a part of it about
the rest (BREACH, CVE-2013-3587): files of the page are the same for everyone, and of numbers
no part comes from a request, while answers with names and notes stay as they are. Parquet
is compressed already.
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
"""Of numbers: less than half of the length in a hundredth of a second; the best takes ten times as
long."""


def takes_gzip(accept_encoding: str) -> bool:
    """Whether a request's Accept-Encoding names gzip, and not with a weight of nothing."""
    for one in accept_encoding.lower().replace(" ", "").split(","):
        coding, _, weight = one.partition(";q=")
        if coding == "gzip":
            return not weight or weight.strip("0.") != ""
    return False


def numbers_as_json(about: Mapping[str, object], columns: Mapping[str, Array]) -> bytes:
    """An object with facts, and columns of numbers by name; what is not a number is null.

    By pydantic, which takes a fifth of the time that Python's own writer does.

    Args:
        about: facts by name.
        columns: single precision is written to a millionth: micrometres and micronewtons.
    """
    return _JSON.dump_json({**about, "columns": {name: _plain(v) for name, v in columns.items()}})


def _plain(values: Array) -> list[Any]:
    if values.dtype == np.float32:
        values = np.round(values.astype(np.float64), 6)
    plain: list[Any] = values.tolist()
    return plain


def packed(numbers: bytes) -> bytes:
    """Numbers as gzip, quickly."""
    return gzip.compress(numbers, _LEVEL)


def write_arrow_stream(table: pa.Table) -> bytes:
    """Write a table as an Arrow IPC stream."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    content: bytes = sink.getvalue().to_pybytes()
    return content
