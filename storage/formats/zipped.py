"""Sealed sessions as one zip file, made while it is sent: none of it is kept.

Files go into it as they are, stored and not deflated, since Parquet is compressed already. What a
zip file is opened by, its directory, comes last; if a session turns out to be damaged or gone on
the way, it never comes, and nothing can take what was sent for the whole.
"""

from __future__ import annotations

import hashlib
import io
import time
import zipfile
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from pathlib import Path

from devices.errors import DamagedFileError, StorageError
from storage.clock.file import CLOCK_NAME
from storage.sessions.beside import EVENTS_NAME
from storage.sessions.claims import SESSION_NAME
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.stances import STANCES_NAME

_PIECE = 1 << 20
_DATED_S = (315_619_200, 4_354_732_800)
"""From 2 January 1980 to 30 December 2107, in any time zone: a zip file can state no other dates.

A machine without a clock writes files of 1970; they get the nearest date.
"""
_BESIDE = (EVENTS_NAME, CLOCK_NAME, STANCES_NAME)
"""Each has its own checksum; older sessions lack some."""


@dataclass(frozen=True)
class Sealed:
    """A sealed session to be put into a zip file."""

    folder: Path
    sha256: str
    """Of its frames."""


def zipped(sessions: Iterable[Sealed]) -> Generator[bytes, None, None]:
    """The pieces of a zip file with a folder for each session, as `foottile verify` takes it.

    Raises:
        DamagedFileError: a session's frames are not those that were sealed.
        StorageError: a file cannot be read, or is there no more.
    """
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED, allowZip64=True) as file:
        for session in sessions:
            yield from _put(file, sink, session.folder / FRAMES_NAME, session.sha256)
            for name in _BESIDE:
                if (session.folder / name).is_file():
                    yield from _put(file, sink, session.folder / name)
            # Last: of a session that is taken away meanwhile it is missed, whatever else was there.
            yield from _put(file, sink, session.folder / SESSION_NAME)
    yield sink.taken()


def _put(
    file: zipfile.ZipFile, sink: _Sink, path: Path, sha256: str | None = None
) -> Generator[bytes, None, None]:
    found = hashlib.sha256()
    try:
        dated_s = min(max(int(path.stat().st_mtime), _DATED_S[0]), _DATED_S[1])
        about = zipfile.ZipInfo(f"{path.parent.name}/{path.name}", time.localtime(dated_s)[:6])
        about.external_attr = 0o644 << 16
        with path.open("rb") as source, file.open(about, "w", force_zip64=True) as entry:
            while piece := source.read(_PIECE):
                found.update(piece)
                entry.write(piece)
                yield sink.taken()
    except OSError as error:
        raise StorageError(
            f"cannot be read: {error}", where=str(path), remedy="Leave this session out"
        ) from error
    if sha256 is not None and found.hexdigest() != sha256:
        raise DamagedFileError("its bytes are not those that were sealed", where=str(path))
    yield sink.taken()


class _Sink(io.RawIOBase):
    """Keeps what was written until it is taken; zipfile sees that it cannot go back in it."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def writable(self) -> bool:
        """It is."""
        return True

    def write(self, piece: object) -> int:
        """Keep a piece."""
        content = bytes(piece)  # type: ignore[call-overload]  # whatever has a buffer
        self._pieces.append(content)
        return len(content)

    def taken(self) -> bytes:
        """What was written since the last time."""
        content = b"".join(self._pieces)
        self._pieces.clear()
        return content
