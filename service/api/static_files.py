"""Static files of the pages, compression of answers, and HEAD on every route.

Other answers are sent as they are. The length of a compressed answer reveals the rest to an
attacker who chooses a part of the content (BREACH, CVE-2013-3587): page files are the same for
every client, and no part of the numbers comes from a request, while answers with names and notes
stay uncompressed. Parquet is compressed already.

Clients use it to check that something exists; some proxies and watchdogs use nothing else.
"""

from __future__ import annotations

import gzip
import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import ConfigDict, TypeAdapter
from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.staticfiles import NotModifiedResponse, PathLike, StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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


_MAX_GZIP_RATIO = 0.9
"""Greatest ratio of lengths for which a file is sent compressed."""

_MEDIA_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".webmanifest": "application/manifest+json",
}
"""Media types, the same on every machine: `mimetypes` would read the machine's own tables."""


@dataclass(frozen=True)
class _CachedFile:
    file_stamp: tuple[int, int]
    """Modification time in ns, and size: a change means another file."""
    plain: bytes
    gzipped: bytes | None
    tag: str


class PageFiles(StaticFiles):
    """Folder of static files, the same for every client."""

    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder)
        self._cache: dict[str, _CachedFile] = {}

    def file_response(
        self,
        full_path: PathLike,
        stat_result: os.stat_result,
        scope: Scope,
        status_code: int = 200,
    ) -> Response:
        """Answer with a file, compressed if the client accepts gzip; each form has its own ETag."""
        request_headers = Headers(scope=scope)
        file = self._file(Path(full_path), stat_result)
        packed = file.gzipped is not None and accepts_gzip(
            request_headers.get("accept-encoding", "")
        )
        answer = Response(
            file.gzipped if packed else file.plain,
            status_code=status_code,
            headers={"ETag": f'"{file.tag}{"-gzip" if packed else ""}"', "Vary": "Accept-Encoding"},
            media_type=_MEDIA_TYPES.get(Path(full_path).suffix),
        )
        if packed:
            answer.headers["Content-Encoding"] = "gzip"
        if self.is_not_modified(answer.headers, request_headers):
            return NotModifiedResponse(answer.headers)
        return answer

    def _file(self, path: Path, stat: os.stat_result) -> _CachedFile:
        written = (stat.st_mtime_ns, stat.st_size)
        cached = self._cache.get(str(path))
        if cached is None or cached.file_stamp != written:
            plain = path.read_bytes()
            packed = gzip.compress(plain, 9, mtime=0)
            cached = self._cache[str(path)] = _CachedFile(
                written,
                plain,
                packed if len(packed) < _MAX_GZIP_RATIO * len(plain) else None,
                hashlib.sha256(plain).hexdigest(),
            )
        return cached


class HeadFromGet:
    """ASGI middleware that answers HEAD on every route of GET.

    Args:
        app: application that answers GET.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        is_complete = False

        async def send_head(message: Message) -> None:
            nonlocal is_complete
            if message["type"] == "http.response.start":
                await send(message)
            elif not is_complete:
                # Once the answer is complete, `receive` reports a disconnect: files and exports
                # that are streamed are closed after their first piece.
                is_complete = True
                await send({"type": "http.response.body"})

        await self._app({**scope, "method": "GET"}, receive, send_head)
