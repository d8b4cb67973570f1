"""A folder for results that a command makes, and that is gone again if nothing came of it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from devices.errors import UsageError


@contextmanager
def result_folder(out: Path) -> Iterator[Path]:
    """The folder to write in, made if it is missing, and gone again if nothing came of it.

    Raises:
        UsageError: it cannot be made, or not be written in.
    """
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        _make(out)
        yield out.resolve()
    except BaseException:
        for folder in missing:
            with suppress(OSError):  # not empty, or not made yet
                folder.rmdir()
        raise


def _make(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"no folder {str(out)!r} can be made: {error}") from error
    if not os.access(out, os.W_OK):
        raise UsageError(f"{str(out)!r} cannot be written in")
