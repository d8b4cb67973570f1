"""Cache of sealed sessions that a server opens often: verified files and parsed footers."""

from __future__ import annotations

from pathlib import Path
from threading import Lock

from storage.sessions.footer import Footer, Stamps, stamps_of
from storage.sessions.reader import SessionReader

_KNOWN_MAX = 1000
_FOOTERS_MAX_BYTES = 4 << 20
"""Most bytes of cached footers as in their files; parsed they take about eleven times as much."""


class CheckedFiles:
    """Cache of verified files and parsed footers. Thread-safe.

    Each file is verified against its hash once, and its footer is parsed once. A file whose stamps
    have changed is verified again; page checksums are verified at every read. The footers used last
    are kept, up to a limit of their bytes.
    """

    def __init__(self) -> None:
        self._whole: dict[Stamps, None] = {}
        self._footers: dict[Stamps, Footer] = {}
        self._lock = Lock()

    def open(self, path: Path, *, only_slices: bool = False) -> SessionReader:
        """Open a sealed session; verify it if it is not in the cache.

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
        size_bytes = sum(cached.size_bytes for cached in self._footers.values())
        while size_bytes > _FOOTERS_MAX_BYTES or len(self._footers) > _KNOWN_MAX:
            size_bytes -= self._footers.pop(next(iter(self._footers))).size_bytes
