"""Store of job results: a folder per session, with a note of the input of each result.

Files are written first, atomically, then the note with their hashes. Files without a note do not
count, so an interrupted job runs again. Object stores write objects atomically.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from devices.errors import FileFormatError
from service.offline.archive.pieces import PIECES_NAME
from service.offline.archive.places import is_remote, opened, read_bytes, sizes_in, storing, upload
from service.offline.archive.workspace import SYSTEM, remove_stale_workspaces, workspace
from storage.checked_json import checked, with_check
from storage.durable import (
    make_folder,
    remove_stale_temporaries,
    storage_errors,
    sync_folder,
    temporary_of,
)
from storage.file_hash import sha256_of

_WORK = ".work"


@dataclass(frozen=True)
class Note:
    """Provenance of a result.

    Attributes:
        command: command that made it.
        software: version that made it.
        place: location of the session.
        input_sha256: hash of the session, see `identity`.
        options: options of the command.
        files: hash and length of every file, by name.
        facts: the task's report.
    """

    command: str
    software: str
    place: str
    input_sha256: str
    options: Mapping[str, Any]
    files: Mapping[str, Mapping[str, Any]]
    facts: Mapping[str, Any]

    @property
    def key(self) -> str:
        """Hash of version, input and options: equal for equal results."""
        content = json.dumps([self.command, self.software, self.input_sha256, self.options])
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def is_of(self, other: Note) -> bool:
        """Return whether both were made from the same input by the same version and options."""
        return (self.software, self.input_sha256, self.options) == (
            other.software,
            other.input_sha256,
            other.options,
        )


class Results:
    """Results folder, local or in a store."""

    def __init__(self, out: str) -> None:
        self.out = out.rstrip("/")
        self.is_remote = is_remote(out)

    def note(self, name: str, command: str) -> Note | None:
        """Read the note of a command's result for a session; None unless all its files exist.

        Raises:
            StorageError: it cannot be read now.
        """
        note = self._read(name, command)
        if note is None:
            return None
        filesystem, path = opened(f"{self.out}/{name}")
        with storing(self.out):
            infos = filesystem.get_file_info([f"{path}/{file}" for file in note.files])
        sizes = [file["bytes"] for file in note.files.values()]
        return note if [info.size for info in infos] == sizes else None

    @contextmanager
    def made(self, name: str, command: str) -> Iterator[Path]:
        """Provide an empty folder; move its files into the results if the block succeeds.

        Raises:
            StorageError: it cannot be written.
        """
        with workspace(SYSTEM if self.is_remote else Path(self.out) / _WORK) as work:
            yield work
            self._put(work, name, command)

    def keep(self, name: str, note: Note) -> None:
        """Write the note last, without fsync: if it is lost, the job runs again.

        Raises:
            StorageError: it cannot be written.
        """
        text = with_check(json.dumps(vars(note), indent=1).encode())
        where = f"{self.out}/{name}/{_note_name(note.command)}"
        if self.is_remote:
            upload(where, text)
            return
        with storage_errors(Path(where)):
            temporary = temporary_of(Path(where))
            temporary.write_bytes(text)
            temporary.replace(where)

    def begin(self) -> None:
        """Create the folder, and delete work folders left by killed workers of this machine.

        Raises:
            StorageError: it cannot be made.
        """
        remove_stale_workspaces(SYSTEM)
        if not self.is_remote:
            with storage_errors(Path(self.out)):
                make_folder(Path(self.out).absolute())
            remove_stale_workspaces(Path(self.out) / _WORK)

    def end(self) -> None:
        """Delete the folder for work in progress, after all workers have ended."""
        if not self.is_remote:
            remove_stale_workspaces(Path(self.out) / _WORK)
            for name in (_WORK, PIECES_NAME):
                with suppress(OSError):
                    (Path(self.out) / name).rmdir()

    def put_file(self, name: str, path: Path) -> None:
        """Write a file beside the results."""
        if self.is_remote:
            upload(f"{self.out}/{name}", path)

    def _read(self, name: str, command: str) -> Note | None:
        where = f"{self.out}/{name}/{_note_name(command)}"
        try:
            return Note(**json.loads(checked(read_bytes(where), where=where).text))
        except (FileFormatError, TypeError, ValueError):
            return None

    def _put(self, work: Path, name: str, command: str) -> None:
        target = f"{self.out}/{name}"
        self._forget(name, command)
        files = sorted(path for path in work.iterdir() if path.is_file())
        if self.is_remote:
            for path in files:
                upload(f"{target}/{path.name}", path)
            return
        with storage_errors(Path(target)):
            Path(target).mkdir(parents=True, exist_ok=True)
            remove_stale_temporaries(Path(target))
            for path in files:
                with path.open("rb") as file:
                    os.fsync(file.fileno())
                path.replace(Path(target) / path.name)
            sync_folder(Path(target))  # before the note that names them

    def _forget(self, name: str, command: str) -> None:
        """Delete a result; the note first, so that it never describes other files."""
        there = set(sizes_in(f"{self.out}/{name}"))
        if _note_name(command) not in there:
            return
        old = self._read(name, command)
        filesystem, path = opened(f"{self.out}/{name}")
        with storing(f"{self.out}/{name}"):
            filesystem.delete_file(f"{path}/{_note_name(command)}")
            for file in there.intersection(old.files if old is not None else ()):
                filesystem.delete_file(f"{path}/{file}")


def files_in(work: Path) -> dict[str, dict[str, Any]]:
    """Return hash and length of every file in a folder, by name."""
    return {
        path.name: {"bytes": path.stat().st_size, "sha256": sha256_of(path)}
        for path in sorted(work.iterdir())
        if path.is_file()
    }


def _note_name(command: str) -> str:
    return f"{command}.made.json"
