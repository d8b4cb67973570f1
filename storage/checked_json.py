"""JSON files that prove themselves: the last key is a hash of all text before it.

Every file of ours whose content can change a number, or what is asked of a node, is written and
read here. Older versions wrote no hash: such a file is read if it is JSON, called unproven, and has
one when it is next written. A file that lost part of its hash, or all of its end, is damaged, not
old; who edits one by hand deletes the line with the hash.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path

from devices.errors import DamagedFileError
from storage.durable import read_whole, write_whole

CHECK = "check"
_BEFORE, _AFTER = b',\n "check": "', b'"\n}'
_END = re.compile(re.escape(_BEFORE) + rb"([0-9a-f]{64})" + re.escape(_AFTER) + rb"\Z")
_TAIL_BYTES = len(_BEFORE) + 64 + len(_AFTER)
_LAST_COMMA = re.compile(rb",\s*\}\s*\Z")
_DIGITS_AT_END = re.compile(rb'"[0-9a-f]{64}"\s*\}\s*\Z')


@dataclass(frozen=True)
class Checked:
    """What a file holds."""

    text: bytes
    """A JSON object without its hash; of an older version perhaps a list."""
    is_proven: bool
    """False: it states no hash, so it may have changed since an older version wrote it."""


def write_checked(path: Path, text: bytes, *, mode: int = 0o666) -> None:
    """Write a JSON object with its hash, whole or not at all.

    Args:
        path: the file; one that is there is replaced.
        text: a JSON object with at least one key, and without "check".
        mode: permissions, of which the umask takes its share.

    Raises:
        StorageError: the disk is full or not writable; raises as `whole_file`.
    """
    write_whole(path, with_check(text), mode=mode)


def read_checked(path: Path) -> Checked:
    """Read a JSON object. Whether it has the keys that it should is for the caller to say.

    Raises:
        FileNotFoundError: there is none.
        DamagedFileError: its hash is of another text, or it states none and is no JSON, or it is no
            file.
        StorageError: it cannot be read now.
    """
    return checked(read_whole(path), where=str(path))


def checked(text: bytes, *, where: str) -> Checked:
    """The same for a text that was read already.

    Raises:
        DamagedFileError: its hash is of another text, or it states none and is no JSON.
    """
    found = is_unchanged(text)
    if found is False:
        raise DamagedFileError(
            "it was changed: its text is not what its hash is of",
            where=where,
            expected="the bytes as they were written",
        )
    if found is True:
        return Checked(without_check(text), is_proven=True)
    # Who deletes the last line by hand leaves the comma before it.
    text = _LAST_COMMA.sub(b"\n}", text)
    _check_json(text, where=where)
    return Checked(text, is_proven=False)


def _check_json(text: bytes, *, where: str) -> None:
    """A text without its end states no hash, and zeros do not: only JSON may be an old file."""
    if not text.strip():
        raise DamagedFileError("it is empty", where=where, expected="a JSON object")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(
            f"it is not whole: it states no hash and is no JSON ({error})",
            where=where,
            expected="a JSON object",
        ) from error
    if not isinstance(content, dict | list):
        raise DamagedFileError(
            f"it states no hash and holds {text[:40]!r}", where=where, expected="a JSON object"
        )


def with_check(text: bytes) -> bytes:
    """The object with its hash as the last key.

    Args:
        text: a JSON object with at least one key, and without this one.
    """
    body = text.rstrip().removesuffix(b"}").rstrip()
    return body + _BEFORE + hashlib.sha256(body).hexdigest().encode() + _AFTER


def without_check(text: bytes) -> bytes:
    """The object without its hash; the same bytes if it carries none."""
    end = _END.search(text)
    return text if end is None else text[: end.start()] + b"\n}"


def is_unchanged(text: bytes) -> bool | None:
    """Does the text have the hash that it states? None if it never stated one."""
    end = _END.search(text)
    if end is None:
        return False if _had_check(text) else None
    return hashlib.sha256(text[: end.start()]).hexdigest().encode() == end[1]


def _had_check(text: bytes) -> bool:
    """Does it end like a text with a hash, of which a byte is another one, or missing, or more?"""
    return b'"check":' in text[-2 * _TAIL_BYTES :] or _DIGITS_AT_END.search(text) is not None
