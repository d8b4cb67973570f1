"""Atomic downloads: a file appears complete or not at all."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path

from foottile.errors import DamagedError
from foottile.http import HttpClient

_CHUNK_BYTES = 1 << 20


def download(
    http: HttpClient,
    url: str,
    query: Mapping[str, object],
    path: str | os.PathLike[str],
    expected: Callable[[], str | None] | None = None,
) -> Path:
    """Download a file to a temporary name and rename it when it is complete.

    Args:
        http: client of the server.
        url: path below `/api/v1`.
        query: parameters of the request.
        path: file to write.
        expected: returns the expected SHA-256 after the download; None: unknown.

    Raises:
        DamagedError: the hash differs.
        OSError: the file cannot be written.
        FootTileError: no response, or a problem response.
    """
    target = Path(path)
    partial = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    digest = hashlib.sha256()
    try:
        with http.stream(url, query) as response, partial.open("xb") as file:
            for chunk in response.iter_bytes(_CHUNK_BYTES):
                digest.update(chunk)
                file.write(chunk)
            file.flush()
            os.fsync(file.fileno())
        sha256 = None if expected is None else expected()
        if sha256 is not None and digest.hexdigest() != sha256:
            raise DamagedError(f"{url}: the download differs from the server's hash. Retry")
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    return target
