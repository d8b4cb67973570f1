"""Reading of files that a user names: regular files of bounded size only."""

from __future__ import annotations

import codecs
import os
import stat
from errno import EFBIG, EINVAL
from pathlib import Path

TEXT_BYTES_MAX = 16 << 20
"""Size limit of text files; scenes, calibrations and settings are far shorter."""


def check_regular_file(path: Path, *, bytes_max: int | None = None) -> None:
    """Check that a path is a regular file, whose reading neither blocks nor goes on for ever.

    Raises:
        OSError: it is missing, a folder, pipe or device, or longer than `max_bytes`.
    """
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise OSError(EINVAL, "not a file that can be read whole", str(path))
    if bytes_max is not None and found.st_size > bytes_max:
        raise OSError(EFBIG, f"{found.st_size} bytes, where {bytes_max} are the most", str(path))


def read_bytes(path: Path, *, bytes_max: int) -> bytes:
    """Read all of a file.

    Raises:
        OSError: as for `check_regular_file`, or it cannot be read.
    """
    check_regular_file(path, bytes_max=bytes_max)
    # The path may have been replaced since: O_NONBLOCK for a pipe, and a bounded read.
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        return file.read(bytes_max)


def read_text(path: Path) -> str:
    """Read all of a text file (`decode_text`).

    Raises:
        OSError: as for `check_regular_file`, or it cannot be read.
        UnicodeDecodeError: it is no text.
    """
    return decode_text(read_bytes(path, bytes_max=TEXT_BYTES_MAX))


def decode_text(content: bytes) -> str:
    """Decode UTF-8 or UTF-16, with or without a byte order mark, as Windows editors write it.

    Raises:
        UnicodeDecodeError: it is no text.
    """
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16")
    head = content[:1000]
    if b"\0" in head:  # UTF-16 without a mark: every second byte of plain text is zero
        even, odd = head[::2].count(0), head[1::2].count(0)
        if odd > 9 * even and 4 * odd > len(head):
            return content.decode("utf-16-le")
        if even > 9 * odd and 4 * even > len(head):
            return content.decode("utf-16-be")
    return content.decode("utf-8-sig")
