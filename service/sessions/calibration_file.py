"""Calibration files: parsing and writing."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from devices.errors import CalibrationError, DamagedFileError
from devices.inputs import decode_text
from service.estimation.calibration import EDITED, Calibration
from storage.checked_json import checked, with_check, write_checked


def calibration_of(content: bytes, *, where: str) -> Calibration:
    """Parse a calibration file; the name of a file written by hand is marked as such.

    Raises:
        CalibrationError: it is no calibration, or its hashes do not match.
    """
    with suppress(UnicodeDecodeError):  # `checked` reports this as damage
        content = decode_text(content).encode()  # encodings of editors
    try:
        text = checked(content, where=where).text
    except DamagedFileError as error:
        raise not_one(error.what, where) from error
    try:
        return Calibration.from_json(text.decode("utf-8", "replace"), where=where)
    except RecursionError as error:
        raise not_one("it is nested too deeply", where) from error


def not_one(what: str, where: str) -> CalibrationError:
    """Return the error for a file that is no calibration."""
    return CalibrationError(f"not a calibration: {what}", where=where, remedy=EDITED)


def content_of(calibration: Calibration) -> bytes:
    """Return all bytes of a calibration's file."""
    return with_check(calibration.to_json().encode())


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration file.

    Raises:
        StorageError: the disk is full or not writable; raises as `whole_file`.
    """
    write_checked(path, calibration.to_json().encode())
