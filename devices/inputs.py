"""Files that a user names: read if they are files, and no longer than they can be meant to be."""

from __future__ import annotations

import os
import stat
from errno import EFBIG, EINVAL
from pathlib import Path

TEXT_BYTES_MAX = 16 << 20
"""No scene, calibration or settings file is longer by far."""


def check_file(path: Path, *, bytes_max: int | None = None) -> None:
    """Refuse what reading would wait for, or never end with.

    Raises:
        OSError: it is not there, a folder, pipe or device, or longer than `bytes_max`.
    """
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise OSError(EINVAL, "not a file that can be read whole", str(path))
    if bytes_max is not None and found.st_size > bytes_max:
        raise OSError(EFBIG, f"{found.st_size} bytes, where {bytes_max} are the most", str(path))


def read_text(path: Path, *, bytes_max: int = TEXT_BYTES_MAX) -> str:
    """All of a text file in UTF-8.

    Raises:
        OSError: as for `check_file`, or it cannot be read.
        UnicodeDecodeError: it is no text.
    """
    check_file(path, bytes_max=bytes_max)
    # It may have become another one since: a pipe is not waited for, and no more is read than fits.
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        return file.read(bytes_max).decode("utf-8")
