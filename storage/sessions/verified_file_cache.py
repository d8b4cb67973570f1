"""Cache of sealed sessions that a server opens often: verified files and parsed footers."""

from __future__ import annotations

from pathlib import Path
from threading import Lock

from storage.sessions.footer import FileStamps, SealedFileFooter, read_file_stamps_or_empty
from storage.sessions.reader import SealedFileReader

_MAX_ENTRIES = 1000
_MAX_FOOTER_BYTES = 4 << 20
"""Most bytes of cached footers as in their files; parsed they take about eleven times as much."""


class VerifiedFileCache:
    """Cache of verified files and parsed footers. Thread-safe.

    Each file is verified against its hash once, and its footer is parsed once. A file whose stamps
    have changed is verified again; page checksums are verified at every read. The footers used last
    are kept, up to a limit of their bytes.
    """

    def __init__(self) -> None:
        self._verified_stamps: dict[FileStamps, None] = {}
        self._footers: dict[FileStamps, SealedFileFooter] = {}
        self._lock = Lock()

    def open_reader(self, path: Path, *, only_slices: bool = False) -> SealedFileReader:
        """Open a sealed session; verify it if it is not in the cache.

        Args:
            path: the file.
            only_slices: as for `SealedFileReader`.

        Raises:
            FileFormatError: as for `SealedFileReader`.
        """
        stamps = read_file_stamps_or_empty(path)
        with self._lock:
            footer = self._footers.pop(stamps, None)
            if footer is not None:
                self._footers[stamps] = footer  # the newest again
            is_checked = stamps in self._verified_stamps
        reader = SealedFileReader(
            path, skip_verification=is_checked, only_slices=only_slices, footer=footer
        )
        if stamps and stamps == read_file_stamps_or_empty(path):  # not replaced meanwhile
            with self._lock:
                self._store(stamps, reader.footer)
        elif footer is not None:  # it may be another file's by now
            reader.close()
            return self.open_reader(path, only_slices=only_slices)
        return reader

    def _store(self, stamps: FileStamps, footer: SealedFileFooter) -> None:
        if footer.is_file_verified:
            while (
                len(self._verified_stamps) >= _MAX_ENTRIES and stamps not in self._verified_stamps
            ):
                del self._verified_stamps[next(iter(self._verified_stamps))]
            self._verified_stamps[stamps] = None
        self._footers[stamps] = footer
        size_bytes = sum(cached.size_bytes for cached in self._footers.values())
        while size_bytes > _MAX_FOOTER_BYTES or len(self._footers) > _MAX_ENTRIES:
            size_bytes -= self._footers.pop(next(iter(self._footers))).size_bytes
