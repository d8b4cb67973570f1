"""Sealed sessions that a server opens often: proven once, their footers kept."""

from __future__ import annotations

from pathlib import Path
from threading import Lock

from storage.sessions.footer import Footer, Stamps, stamps_of
from storage.sessions.reader import SessionReader

_KNOWN_MAX = 1000
_FOOTERS_MAX_BYTES = 4 << 20
"""As they are in their files; parsed they take some eleven times as much."""


class CheckedFiles:
    """Each is held against its hash once, not every time, and its footer is parsed once.

    One whose stamps say that it is another file by now is held against its hash again; checksums
    of pages are looked at whenever they are read. The footers used last are kept, up to a bound of
    their bytes. May be used from several threads.
    """

    def __init__(self) -> None:
        self._whole: dict[Stamps, None] = {}
        self._footers: dict[Stamps, Footer] = {}
        self._lock = Lock()

    def open(self, path: Path, *, only_slices: bool = False) -> SessionReader:
        """Open a sealed session.

        Args:
            path: the file.
            only_slices: as for `SessionReader`.

        Raises:
            FileFormatError: as for `SessionReader`.
        """
        stamps = stamps_of(path)
        with self._lock:
            footer = self._footers.pop(stamps, None)
            if footer is not None:
                self._footers[stamps] = footer  # the newest again
            is_checked = stamps in self._whole
        reader = SessionReader(path, is_checked=is_checked, only_slices=only_slices, footer=footer)
        if stamps and stamps == stamps_of(path):  # not replaced meanwhile
            with self._lock:
                self._keep(stamps, reader.footer)
        elif footer is not None:  # it may be another file's by now
            reader.close()
            return self.open(path, only_slices=only_slices)
        return reader

    def _keep(self, stamps: Stamps, footer: Footer) -> None:
        if footer.is_whole:
            while len(self._whole) >= _KNOWN_MAX and stamps not in self._whole:
                del self._whole[next(iter(self._whole))]
            self._whole[stamps] = None
        self._footers[stamps] = footer
        size_bytes = sum(kept.size_bytes for kept in self._footers.values())
        while size_bytes > _FOOTERS_MAX_BYTES or len(self._footers) > _KNOWN_MAX:
            size_bytes -= self._footers.pop(next(iter(self._footers))).size_bytes
