"""Folder for results, removed again after a failure."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from devices.errors import UsageError


@contextmanager
def open_result_folder(out: Path) -> Iterator[Path]:
    """Yield a folder, created if missing and removed again after an error if empty.

    Raises:
        UsageError: the folder cannot be created or written.
    """
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        _make_folder(out)
        yield out.resolve()
    except BaseException:
        for folder in missing:
            with suppress(OSError):  # not empty, or not created yet
                folder.rmdir()
        raise


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"folder {str(out)!r} cannot be created: {error}") from error
    if not os.access(out, os.W_OK):
        raise UsageError(f"folder {str(out)!r} is not writable")
