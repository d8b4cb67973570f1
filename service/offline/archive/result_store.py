"""Store of job results: a folder per session, with a note of the input of each result.

Files are written first, atomically, then the note with their hashes. Files without a note do not
count, so an interrupted job runs again. Object stores write objects atomically.

The name of the folder of chunks contains the hash of version, input and options, so chunks made
from other input are never used. It is deleted once the result is written.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from devices.errors import FileFormatError
from service.offline.archive.local_copies import (
    SYSTEM_TEMP_FOLDER,
    create_workspace,
    download_and_hash,
    remove_stale_workspaces,
)
from service.offline.archive.locations import (
    convert_write_errors,
    is_remote,
    list_file_sizes,
    open_filesystem,
    read_bytes,
    upload,
)
from storage.documents import append_json_checksum, verify_and_strip_json_checksum
from storage.durable_files import (
    make_synced_folder,
    make_temporary_path,
    remove_dead_process_temporaries,
    sync_folder,
    translate_storage_errors,
)
from storage.parquet_hash import compute_sha256

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
        """Open the folder of the chunks; of a remote store, a copy.

        New files of a copy are uploaded at the end, unless the block fails; local ones stay.

        Args:
            suffixes: suffixes of the files to load from a store; None: all.

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
            # Last the index of a chunk, which names its other files.
            for file in sorted(made, key=lambda file: file.suffix == ".json"):
                upload(f"{self._where}/{file.name}", file)

    def delete(self) -> None:
        """Delete all chunks of this session, once its result is written."""
        filesystem, path = open_filesystem(self._all)
        with convert_write_errors(self._all):
            filesystem.delete_dir(path)


_WORK_FOLDER_NAME = ".work"


@dataclass(frozen=True)
class ResultNote:
    """Provenance of a result.

    Attributes:
        command: command that made it.
        software: version that made it.
        place: location of the session.
        input_sha256: hash of the session, see `hash_session`.
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
    def input_key(self) -> str:
        """Hash of version, input and options: equal for equal results."""
        content = json.dumps([self.command, self.software, self.input_sha256, self.options])
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def has_same_inputs(self, other: ResultNote) -> bool:
        """Return whether both were made from the same input by the same version and options."""
        return (self.software, self.input_sha256, self.options) == (
            other.software,
            other.input_sha256,
            other.options,
        )


class ResultStore:
    """Results folder, local or in a store."""

    def __init__(self, results_location: str) -> None:
        self.out = results_location.rstrip("/")
        self.is_remote = is_remote(results_location)

    def read_complete_note(self, session_id: str, command: str) -> ResultNote | None:
        """Read the note of a command's result for a session; None unless all its files exist.

        Raises:
            StorageError: it cannot be read now.
        """
        note = self._read_note(session_id, command)
        if note is None:
            return None
        filesystem, path = open_filesystem(f"{self.out}/{session_id}")
        with convert_write_errors(self.out):
            infos = filesystem.get_file_info([f"{path}/{file}" for file in note.files])
        sizes = [file["bytes"] for file in note.files.values()]
        return note if [info.size for info in infos] == sizes else None

    @contextmanager
    def open_result_folder(self, session_id: str, command: str) -> Iterator[Path]:
        """Provide an empty folder; move its files into the results if the block succeeds.

        Raises:
            StorageError: it cannot be written.
        """
        with create_workspace(
            SYSTEM_TEMP_FOLDER if self.is_remote else Path(self.out) / _WORK_FOLDER_NAME
        ) as work:
            yield work
            self._store_files(work, session_id, command)

    def write_note(self, session_id: str, note: ResultNote) -> None:
        """Write the note last, without fsync: if it is lost, the job runs again.

        Raises:
            StorageError: it cannot be written.
        """
        text = append_json_checksum(json.dumps(vars(note), indent=1).encode())
        where = f"{self.out}/{session_id}/{_note_name(note.command)}"
        if self.is_remote:
            upload(where, text)
            return
        with translate_storage_errors(Path(where)):
            temporary = make_temporary_path(Path(where))
            temporary.write_bytes(text)
            temporary.replace(where)

    def prepare_folder(self) -> None:
        """Create a local folder, and delete work folders left by killed workers of this machine.

        Raises:
            StorageError: it cannot be made.
        """
        remove_stale_workspaces(SYSTEM_TEMP_FOLDER)
        if not self.is_remote:
            with translate_storage_errors(Path(self.out)):
                make_synced_folder(Path(self.out).absolute())
            remove_stale_workspaces(Path(self.out) / _WORK_FOLDER_NAME)

    def remove_work_folder(self) -> None:
        """Delete a local folder for work in progress, after all workers have ended."""
        if not self.is_remote:
            remove_stale_workspaces(Path(self.out) / _WORK_FOLDER_NAME)
            for name in (_WORK_FOLDER_NAME, CHUNKS_NAME):
                with suppress(OSError):
                    (Path(self.out) / name).rmdir()

    @contextmanager
    def open_text(self, name: str) -> Iterator[IO[str]]:
        """Open a text file beside the results, to write; a remote store receives it at the end.

        Raises:
            StorageError: it cannot be written.
        """
        where = f"{self.out}/{name}"
        if not self.is_remote:
            with translate_storage_errors(Path(where)):
                made = open(where, "w", encoding="utf-8")  # noqa: SIM115  # closed below
            with made as file:
                yield file
            return
        with tempfile.NamedTemporaryFile("w", encoding="utf-8") as file:
            try:
                yield file
            finally:
                file.flush()
                upload(where, Path(file.name))

    def _read_note(self, name: str, command: str) -> ResultNote | None:
        where = f"{self.out}/{name}/{_note_name(command)}"
        try:
            return ResultNote(
                **json.loads(verify_and_strip_json_checksum(read_bytes(where), where=where))
            )
        except (FileFormatError, TypeError, ValueError):
            return None

    def _store_files(self, work: Path, name: str, command: str) -> None:
        target = f"{self.out}/{name}"
        self._delete_result(name, command)
        files = sorted(path for path in work.iterdir() if path.is_file())
        if self.is_remote:
            for path in files:
                upload(f"{target}/{path.name}", path)
            return
        with translate_storage_errors(Path(target)):
            Path(target).mkdir(parents=True, exist_ok=True)
            remove_dead_process_temporaries(Path(target))
            for path in files:
                with path.open("rb") as file:
                    os.fsync(file.fileno())
                path.replace(Path(target) / path.name)
            sync_folder(Path(target))  # before the note that names them

    def _delete_result(self, name: str, command: str) -> None:
        """Delete a result; the note first, so that it never describes other files."""
        there = set(list_file_sizes(f"{self.out}/{name}"))
        if _note_name(command) not in there:
            return
        old = self._read_note(name, command)
        filesystem, path = open_filesystem(f"{self.out}/{name}")
        with convert_write_errors(f"{self.out}/{name}"):
            filesystem.delete_file(f"{path}/{_note_name(command)}")
            for file in there.intersection(old.files if old is not None else ()):
                filesystem.delete_file(f"{path}/{file}")


def hash_files(folder: Path) -> dict[str, dict[str, Any]]:
    """Return hash and length of every file in a folder, by name."""
    return {
        path.name: {"bytes": path.stat().st_size, "sha256": compute_sha256(path)}
        for path in sorted(folder.iterdir())
        if path.is_file()
    }


def _note_name(command: str) -> str:
    return f"{command}.made.json"
