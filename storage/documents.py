"""Documents: JSON files of a typed class, replaced whole, with a SHA-256 of their text as last key.

Every JSON file of ours that can change a number, or the frames that a node retains, is written and
read here. A file without a checksum is damaged. One with the right checksum whose content is not of
the class is of another version, and is not damaged.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from devices.errors import DamagedFileError, FileFormatError
from storage.durable_files import read_small_file, write_atomically

CHECKSUM_KEY = "check"
"""Key of the checksum."""
_BEFORE, _AFTER = b',\n "check": "', b'"\n}'
_END = re.compile(re.escape(_BEFORE) + rb"([0-9a-f]{64})" + re.escape(_AFTER) + rb"\Z")
_TAIL_BYTES = 2 * (len(_BEFORE) + 64 + len(_AFTER))
"""Length of the end in which a damaged checksum is recognised."""

DocumentT = TypeVar("DocumentT", bound=BaseModel)


def write_document(path: Path, document: BaseModel, *, mode: int = 0o666) -> None:
    """Write a document atomically; an existing one is replaced.

    Args:
        path: the file.
        document: its content.
        mode: permissions before the umask.

    Raises:
        StorageError: the disk is full or not writable; raises as `open_for_atomic_write`.
    """
    write_checksummed_json(path, document.model_dump_json(indent=1).encode(), mode=mode)


def read_document(path: Path, kind: type[DocumentT]) -> DocumentT:
    """Read a document and verify its checksum.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: its checksum is wrong or missing, or it is no file.
        FileFormatError: its content is not of this class.
        StorageError: it cannot be read now.
    """
    text = read_checksummed_json(path)
    try:
        return kind.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"])) or "content"
        raise FileFormatError(
            f"written by another version, or edited ({field}: {first['msg']})",
            where=str(path),
            remedy="Update foottile",
        ) from error


def write_checksummed_json(path: Path, text: bytes, *, mode: int = 0o666) -> None:
    """Write a JSON object with its checksum, atomically.

    Args:
        path: the file; an existing one is replaced.
        text: a JSON object with at least one key, and without "check".
        mode: permissions before the umask.

    Raises:
        StorageError: the disk is full or not writable; raises as `open_for_atomic_write`.
    """
    write_atomically(path, append_json_checksum(text), mode=mode)


def read_checksummed_json(path: Path) -> bytes:
    """Read a JSON object and verify its checksum; the caller checks its keys.

    Returns:
        Text without the checksum.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: its checksum is wrong or missing, or it is no file.
        StorageError: it cannot be read now.
    """
    return verify_and_strip_json_checksum(read_small_file(path), where=str(path))


def verify_and_strip_json_checksum(text: bytes, *, where: str) -> bytes:
    """Verify the checksum of JSON text and return the text without it.

    Raises:
        DamagedFileError: its checksum is wrong or missing.
    """
    end = _END.search(text)
    if end is not None and _hash(text[: end.start()]) == end[1]:
        return text[: end.start()] + b"\n}"
    what = (
        "it was changed: its text does not match its hash"
        if b'"check":' in text[-_TAIL_BYTES:]
        else "it has no hash: it was cut off or edited"
        if text.strip()
        else "it is empty"
    )
    raise DamagedFileError(what, where=where, expected="the bytes as they were written")


def append_json_checksum(text: bytes) -> bytes:
    """Return the JSON object with its checksum as the last key.

    Args:
        text: a JSON object with at least one key, and without this one.
    """
    body = text.rstrip().removesuffix(b"}").rstrip()
    return body + _BEFORE + _hash(body) + _AFTER


def _hash(body: bytes) -> bytes:
    return hashlib.sha256(body).hexdigest().encode()
