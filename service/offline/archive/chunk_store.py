"""Store of the finished chunks of an unfinished result, beside the results, shared by all workers.

The folder's name contains the hash of version, input and options, so chunks made from other input
are never used. It is deleted once the result is written.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from service.offline.archive.local_copies import download_and_hash
from service.offline.archive.locations import (
    convert_write_errors,
    is_remote,
    list_file_sizes,
    open_filesystem,
    upload,
)
from service.offline.archive.temporary_folders import SYSTEM_TEMP_FOLDER, create_workspace
from storage.durable_files import make_synced_folder, translate_storage_errors

CHUNKS_NAME = ".pieces"


class ChunkStore:
    """Store of the chunks of one session's result.

    Args:
        out: results folder, as a path or URI.
        name: session id.
        key: hash of version, input and options.
    """

    def __init__(self, out: str, name: str, key: str) -> None:
        self._all = f"{out.rstrip('/')}/{CHUNKS_NAME}/{name}"
        self._where = f"{self._all}/{key}"

    @contextmanager
    def open_folder(self, suffixes: Sequence[str] | None = None) -> Iterator[Path]:
        """Open the folder of the chunks; files added to it are published when the block succeeds.

        Args:
            suffixes: suffixes of the files to load; None: all.

        Raises:
            StorageError: chunks cannot be read or written.
        """
        if not is_remote(self._where):
            path = Path(self._where)
            with translate_storage_errors(path):
                make_synced_folder(path)
            yield path
            return
        with create_workspace(SYSTEM_TEMP_FOLDER) as path:
            there = set(list_file_sizes(self._where))
            for name in there:
                if suffixes is None or name.rpartition(".")[2] in suffixes:
                    download_and_hash(f"{self._where}/{name}", path / name)
            yield path
            made = [file for file in path.iterdir() if file.name not in there]
            for file in sorted(made, key=_is_chunk_index):
                upload(f"{self._where}/{file.name}", file)

    def delete(self) -> None:
        """Delete all chunks of this session, once its result is written."""
        filesystem, path = open_filesystem(self._all)
        with convert_write_errors(self._all):
            filesystem.delete_dir(path)


def _is_chunk_index(file: Path) -> bool:
    """Return whether a file names the other files of its chunk; it must be published last."""
    return file.suffix == ".json"
