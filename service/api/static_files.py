"""Static files of the pages, compressed once and cached while unchanged."""

from __future__ import annotations

import gzip
import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.staticfiles import NotModifiedResponse, PathLike, StaticFiles
from starlette.types import Scope

from service.api.compression import accepts_gzip

_MAX_GZIP_RATIO = 0.9
"""Greatest ratio of lengths for which a file is sent compressed."""

_MEDIA_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
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
