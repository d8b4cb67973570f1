"""Store of the finished chunks of an unfinished result, beside the results, shared by all workers.

The folder's name contains the hash of version, input and options, so chunks made from other input
are never used. It is deleted once the result is written.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from service.offline.archive.places import is_remote, opened, sizes_in, storing, upload
from service.offline.archive.staging import copied
from service.offline.archive.workspace import SYSTEM, workspace
from storage.durable import make_folder, storage_errors

PIECES_NAME = ".pieces"


class Pieces:
    """Store of the chunks of one session's result.

    Args:
        out: results folder, as a path or URI.
        name: session id.
        key: hash of version, input and options.
    """

    def __init__(self, out: str, name: str, key: str) -> None:
        self._all = f"{out.rstrip('/')}/{PIECES_NAME}/{name}"
        self._where = f"{self._all}/{key}"

    @contextmanager
    def folder(self, endings: Sequence[str] | None = None) -> Iterator[Path]:
        """Open the folder of the chunks; files added to it are published when the block succeeds.

        Args:
            suffixes: suffixes of the files to load; None: all.

        Raises:
            StorageError: chunks cannot be read or written.
        """
        if not is_remote(self._where):
            path = Path(self._where)
            with storage_errors(path):
                make_folder(path)
            yield path
            return
        with workspace(SYSTEM) as path:
            there = set(sizes_in(self._where))
            for name in there:
                if endings is None or name.rpartition(".")[2] in endings:
                    copied(f"{self._where}/{name}", path / name)
            yield path
            made = [file for file in path.iterdir() if file.name not in there]
            for file in sorted(made, key=_names_others):
                upload(f"{self._where}/{file.name}", file)

    def forget(self) -> None:
        """Delete all chunks of this session, once its result is written."""
        filesystem, path = opened(self._all)
        with storing(self._all):
            filesystem.delete_dir(path)


def _names_others(file: Path) -> bool:
    """Return whether a file names the other files of its chunk; it must be published last."""
    return file.suffix == ".json"
