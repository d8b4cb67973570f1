"""What is downloaded: a file that appears whole or not at all."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path

from foottile.errors import DamagedError
from foottile.http import Http

_CHUNK = 1 << 20


def download(
    http: Http,
    url: str,
    query: Mapping[str, object],
    path: str | os.PathLike[str],
    expected: Callable[[], str | None] | None = None,
) -> Path:
    """Ask for a file and write it, under a name of its own until it is whole.

    Args:
        http: the server.
        url: behind `/api/v1`.
        query: what is asked for.
        path: of the file.
        expected: asked once it is here: the SHA-256 that it should have; None: none is known.

    Raises:
        DamagedError: it has another one.
        OSError: the file cannot be written.
        FootTileError: no answer, or it is refused.
    """
    target = Path(path)
    partial = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    digest = hashlib.sha256()
    try:
        with http.stream(url, query) as answer, partial.open("xb") as file:
            for chunk in answer.iter_bytes(_CHUNK):
                digest.update(chunk)
                file.write(chunk)
            file.flush()
            os.fsync(file.fileno())
        sha256 = None if expected is None else expected()
        if sha256 is not None and digest.hexdigest() != sha256:
            raise DamagedError(f"{url}: what came has not the hash that it has")
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    return target
