"""Calibration files: parsing and writing."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from devices.errors import CalibrationError, DamagedFileError
from devices.input_files import decode_text
from service.estimation.calibration import EDITED_REMEDY, Calibration
from storage.documents import (
    CHECKSUM_KEY,
    append_json_checksum,
    verify_and_strip_json_checksum,
    write_checksummed_json,
)

_LAST_COMMA = re.compile(rb",\s*\}\s*\Z")


def parse_calibration(content: bytes, *, where: str) -> Calibration:
    """Parse a calibration file; the name of a file written by hand is marked as such.

    Raises:
        CalibrationError: it is no calibration, or its hashes do not match.
    """
    with suppress(UnicodeDecodeError):  # the parsers report this as damage
        content = decode_text(content).encode()  # encodings of editors
    try:
        if f'"{CHECKSUM_KEY}"'.encode() in content:
            content = verify_and_strip_json_checksum(content, where=where)
        else:  # by hand; a deleted line leaves the comma before it
            content = _LAST_COMMA.sub(b"\n}", content)
    except DamagedFileError as error:
        raise make_not_a_calibration_error(error.what, where) from error
    try:
        return Calibration.from_json_verifying_id(content.decode("utf-8", "replace"), where=where)
    except RecursionError as error:
        raise make_not_a_calibration_error("it is nested too deeply", where) from error


def make_not_a_calibration_error(what: str, where: str) -> CalibrationError:
    """Return the error for a file that is no calibration."""
    return CalibrationError(f"not a calibration: {what}", where=where, remedy=EDITED_REMEDY)


def encode_calibration(calibration: Calibration) -> bytes:
    """Return all bytes of a calibration's file."""
    return append_json_checksum(calibration.to_json().encode())


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration file.

    Raises:
        StorageError: the disk is full or not writable; raises as `open_for_atomic_write`.
    """
    write_checksummed_json(path, calibration.to_json().encode())
