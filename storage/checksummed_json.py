"""JSON files with a checksum: the last key is a SHA-256 of all text before it.

Every JSON file of ours that can change a number, or what a node must retain, is written and read
here. Older versions wrote no checksum: such a file is read if it is JSON, is reported as unproven,
and gets a checksum when it is next written. A file that lost part of its checksum, or all of its
end, is damaged, not old. To edit a file by hand, delete the line with the checksum.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path

from devices.errors import DamagedFileError
from storage.durable_files import read_small_file, write_atomically

CHECKSUM_KEY = "check"
"""Key of the checksum."""
_BEFORE, _AFTER = b',\n "check": "', b'"\n}'
_END = re.compile(re.escape(_BEFORE) + rb"([0-9a-f]{64})" + re.escape(_AFTER) + rb"\Z")
_TAIL_BYTES = len(_BEFORE) + 64 + len(_AFTER)
_LAST_COMMA = re.compile(rb",\s*\}\s*\Z")
_DIGITS_AT_END = re.compile(rb'"[0-9a-f]{64}"\s*\}\s*\Z')


@dataclass(frozen=True)
class ChecksummedJson:
    """Content of a JSON file, and whether a checksum proves it."""

    text: bytes
    """JSON object without its checksum; of an older version perhaps a list."""
    has_checksum: bool
    """False: an older version wrote it without a checksum, so a change cannot be seen."""


def write_checksummed_json(path: Path, text: bytes, *, mode: int = 0o666) -> None:
    """Write a JSON object with its checksum, atomically.

    Args:
        path: the file; an existing one is replaced.
        text: a JSON object with at least one key, and without "check".
        mode: permissions before the umask.

    Raises:
        StorageError: the disk is full or not writable; raises as `open_for_atomic_write`.
    """
    write_atomically(path, append_checksum(text), mode=mode)


def read_checksummed_json(path: Path) -> ChecksummedJson:
    """Read a JSON file and verify its checksum; the caller checks its keys.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: its checksum is wrong, or it has none and is no JSON, or it is no file.
        StorageError: it cannot be read now.
    """
    return parse_checksummed_json(read_small_file(path), where=str(path))


def parse_checksummed_json(text: bytes, *, where: str) -> ChecksummedJson:
    """Verify the checksum of JSON text and return the text without it.

    Raises:
        DamagedFileError: its checksum is wrong, or it has none and is no JSON.
    """
    found = is_checksum_right(text)
    if found is False:
        raise DamagedFileError(
            "it was changed: its text does not match its hash",
            where=where,
            expected="the bytes as they were written",
        )
    if found is True:
        return ChecksummedJson(strip_checksum(text), has_checksum=True)
    # Deleting the last line by hand leaves the comma before it.
    text = _LAST_COMMA.sub(b"\n}", text)
    _check_json(text, where=where)
    return ChecksummedJson(text, has_checksum=False)


def _check_json(text: bytes, *, where: str) -> None:
    """Refuse a text without a checksum that is no JSON: it was cut off or zeroed."""
    if not text.strip():
        raise DamagedFileError("it is empty", where=where, expected="a JSON object")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(
            f"it is not whole: it has no hash and is no JSON ({error})",
            where=where,
            expected="a JSON object",
        ) from error
    if not isinstance(content, dict | list):
        raise DamagedFileError(
            f"it has no hash and holds {text[:40]!r}", where=where, expected="a JSON object"
        )


def append_checksum(text: bytes) -> bytes:
    """Return the JSON object with its checksum as the last key.

    Args:
        text: a JSON object with at least one key, and without this one.
    """
    body = text.rstrip().removesuffix(b"}").rstrip()
    return body + _BEFORE + hashlib.sha256(body).hexdigest().encode() + _AFTER


def strip_checksum(text: bytes) -> bytes:
    """Return the JSON object without its checksum; the same bytes if it has none."""
    end = _END.search(text)
    return text if end is None else text[: end.start()] + b"\n}"


def is_checksum_right(text: bytes) -> bool | None:
    """Return whether the text's checksum is right; None if it never had one."""
    end = _END.search(text)
    if end is None:
        return False if _has_checksum_remains(text) else None
    return hashlib.sha256(text[: end.start()]).hexdigest().encode() == end[1]


def _has_checksum_remains(text: bytes) -> bool:
    """Return whether the end looks like a checksum with a byte changed, missing or added."""
    return b'"check":' in text[-2 * _TAIL_BYTES :] or _DIGITS_AT_END.search(text) is not None
