"""Pieces of a result that is not finished: beside the results, where every worker finds them.

They are in a folder of what they are made from, so those of another version, input or options are
never taken for them; it is deleted when the result is there.
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
    """Pieces of a session's result.

    Args:
        out: where results are put, as a path or URI.
        name: of the session.
        key: of what they are made from.
    """

    def __init__(self, out: str, name: str, key: str) -> None:
        self._all = f"{out.rstrip('/')}/{PIECES_NAME}/{name}"
        self._where = f"{self._all}/{key}"

    @contextmanager
    def folder(self, endings: Sequence[str] | None = None) -> Iterator[Path]:
        """Their folder; what is put into it is there for others when the block has ended well.

        Args:
            endings: of files that are needed; None: all.

        Raises:
            StorageError: they cannot be read, or written.
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
        """Delete them, and others of this session; the result is there."""
        filesystem, path = opened(self._all)
        with storing(self._all):
            filesystem.delete_dir(path)


def _names_others(file: Path) -> bool:
    """What names the other files goes last: without it they are nothing."""
    return file.suffix == ".json"
