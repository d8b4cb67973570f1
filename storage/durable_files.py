"""Crash-safe files: atomic writes, folder locks, and setting damaged files aside.

A file is written whole or not at all, and synced. Reading follows no links and waits for no pipes.
The lock of a folder keeps out a second process, which would undo the first one's work. A damaged
file is renamed, never deleted: its owner may still need it.

A scratch file is for data that would take too much memory and can be made again. Its disk space is
freed when the process ends, in whatever way.
"""

from __future__ import annotations

import errno
import fcntl
import io
import logging
import os
import re
import secrets
import shutil
import stat
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from itertools import count
from pathlib import Path
from typing import IO, NamedTuple

import pyarrow as pa

from devices.errors import (
    DamagedFileError,
    FolderGoneError,
    FootTileError,
    StorageError,
    escape_control_chars,
)

log = logging.getLogger("foottile.storage")

_TEMPORARY = re.compile(
    r"\.(?P<name>.+)\.(?P<process>[0-9]+)\.(?P<started>[0-9]+)\.[0-9a-f]{8}\.tmp"
)
_ENDED_STATES = {"Z", "X"}
_START_TIME_FIELD = 19
"""Index of the start time in /proc/PID/stat, counted after the name."""


def write_atomically(path: Path, content: bytes, *, mode: int = 0o666) -> None:
    """Write a file atomically; it is on the disk when this returns.

    Args:
        path: the file; an existing one is replaced.
        content: the whole content.
        mode: permissions before the umask.

    Raises:
        StorageError: the disk is full or not writable; raises as `open_for_atomic_write`.
    """
    with open_for_atomic_write(path, mode=mode) as file:
        file.write(content)


_PERMANENT_ERRORS = (errno.ELOOP, errno.EIO, errno.EBADMSG)
"""Error numbers that no retry cures: the path is no file, or its disk has lost the content."""
MAX_READ_BYTES = 64 << 20
"""Upper limit of a file that is read into memory at once."""


def read_small_file(path: Path, *, max_bytes: int = MAX_READ_BYTES) -> bytes:
    """Read a small file of ours into memory.

    Args:
        path: the file itself: links are not followed, and pipes not waited for.
        max_bytes: a longer file is rejected as damaged.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: it is no regular file, too long, or its disk has lost it.
        StorageError: it may be whole but cannot be read now: it is another user's, or memory or
            descriptors are used up. Do not set it aside or overwrite it.
    """
    with open_regular_file(path) as file, translate_read_errors_unless_missing(path):
        size = os.fstat(file.fileno()).st_size
        if size > max_bytes:
            raise DamagedFileError(
                f"it has {size} bytes", where=str(path), expected=f"up to {max_bytes}"
            )
        return file.read()


def open_regular_file(path: Path) -> io.BufferedReader:
    """Open a regular file of any length for reading; raises as `read_small_file`."""
    with translate_read_errors_unless_missing(path):
        # A link may lead anywhere, and a pipe would be waited for.
        if not stat.S_ISREG(path.lstat().st_mode):
            raise DamagedFileError("it is not a file", where=str(path))
        return open(path, "rb", opener=_without_following)


@contextmanager
def translate_read_errors_unless_missing(path: Path) -> Iterator[None]:
    """Context manager: turn an OSError into `read_small_file`'s errors."""
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as error:
        what = f"cannot be read: {error.strerror}"
        if error.errno in _PERMANENT_ERRORS:
            raise DamagedFileError(what, where=str(path)) from error
        raise StorageError(
            what,
            where=str(path),
            remedy="The file is unchanged. Let this user read it, or try again",
            errno=error.errno,
        ) from error


def _without_following(name: str, flags: int) -> int:
    return os.open(name, flags | os.O_NOFOLLOW | os.O_NONBLOCK)


@contextmanager
def open_for_atomic_write(path: Path, *, mode: int = 0o666) -> Iterator[io.BufferedWriter]:
    """Context manager: a file to write that replaces `path` when the block ends well.

    It is on the disk then.

    Raises:
        StorageError: the disk is full or not writable. The old file is still there, unless only the
            folder could not be synced: then the new file is there, and its name may be lost in a
            power cut.
    """
    temporary = make_temporary_path(path)
    raise_if_locked_folder_gone(path)
    try:
        with translate_storage_errors(path):
            with open(temporary, "wb", opener=partial(os.open, mode=mode)) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
            sync_folder(path.parent)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def make_temporary_path(path: Path) -> Path:
    """Return a temporary path beside `path` that names the writing process."""
    process = os.getpid()
    name = f".{path.name}.{process}.{_read_start_ticks(process) or 0}.{secrets.token_hex(4)}.tmp"
    return path.with_name(name)


def remove_dead_process_temporaries(folder_tree: Path) -> list[Path]:
    """Delete half-written files and folders of dead processes in a tree; return their paths.

    Those of living processes stay: they may still be written. If a process number was given to
    another process since, the start time shows it.

    Raises:
        StorageError: the folder cannot be read, or a file not deleted.
    """
    removed = []
    with translate_storage_errors(folder_tree):
        folder_tree.stat()  # fails if the folder is missing, where rglob just finds no files
        for path in sorted(folder_tree.rglob(".*.tmp")):
            if not is_dead_process_temporary(path.name):
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            elif path.is_file():
                path.unlink(missing_ok=True)
            else:
                continue
            removed.append(path)
        for parent in {path.parent for path in removed}:
            sync_folder(parent)
    return removed


def is_dead_process_temporary(name: str) -> bool:
    """Return whether `name` is a temporary file of a process of this machine that has ended."""
    if match := _TEMPORARY.fullmatch(name):
        return _read_start_ticks(int(match["process"])) != int(match["started"])
    return False


def _read_start_ticks(process: int) -> int | None:
    """Return a process's start time in ticks after boot; None if it does not run.

    A zombie has ended, though its parent has not waited for it: None as well.
    """
    try:
        fields = Path(f"/proc/{process}/stat").read_text("utf-8", "replace").rsplit(") ", 1)[1]
        state, *rest = fields.split()
        return None if state in _ENDED_STATES else int(rest[_START_TIME_FIELD - 1])
    except (FileNotFoundError, ProcessLookupError):
        return None


def make_synced_folder(folder: Path) -> None:
    """Create a folder and its parents; their names are on the disk when this returns.

    Another process may have created the last folder and not synced its name: it is synced in any
    case.

    Raises:
        OSError: it cannot be created.
        FolderGoneError: its parent is a folder whose lock this process holds, and that one is gone.
    """
    raise_if_locked_folder_gone(folder)
    missing = [folder]
    while not missing[-1].parent.is_dir():
        missing.append(missing[-1].parent)
    for each in reversed(missing):
        each.mkdir(exist_ok=True)
        sync_folder(each.parent)


_CANNOT_SYNC_FOLDERS = {*(errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF)}
"""Errors of file systems that sync files only, such as CIFS, vboxsf, WSL's and some of FUSE.

PostgreSQL and SQLite ignore them, too: no program can do more there.
"""
_warned_devices: set[int] = set()
"""File systems (`st_dev`) without folder sync that a warning was logged for."""


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that new names and renames in it survive a power cut.

    A file system that cannot do so gets one warning; the files themselves are synced there, too.

    Raises:
        OSError: the disk failed.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _CANNOT_SYNC_FOLDERS:
            raise
        device = os.fstat(descriptor).st_dev
        if device not in _warned_devices:
            _warned_devices.add(device)
            log.warning(
                "%s: this file system cannot sync folders (%s). Files are synced, but the name of "
                "a new file may be lost if the power fails. Use a local disk where that matters",
                escape_control_chars(str(folder)),
                error.strerror,
            )
    finally:
        os.close(descriptor)


@contextmanager
def translate_storage_errors(path: Path, remedy: str = "") -> Iterator[None]:
    """Context manager: turn an OSError into a StorageError that names `path`.

    Raises:
        StorageError: in place of any other OSError.
    """
    try:
        yield
    except StorageError:
        raise
    except OSError as error:
        raise StorageError(
            f"cannot be written: {error}",
            where=str(path),
            remedy=remedy or "Free space on the disk, or write elsewhere",
            errno=error.errno,
        ) from error


LOCK_NAME = ".lock"
_NO_LOCKS = (
    "Use a folder on a local disk, or mount it with locks (NFS: start rpc.statd, or the mount "
    "option local_lock=flock if no other machine writes there)"
)


@contextmanager
def lock_folder(
    folder: Path,
    *,
    is_shared: bool = False,
    refusal_text: str = "a foottile server or node uses this folder",
    remedy: str = "Stop it first: while it runs, it completes sessions by itself",
) -> Iterator[None]:
    """Context manager: hold the lock of a folder, as a running server or node does.

    Args:
        folder: an existing folder.
        is_shared: take a shared lock, which other shared locks do not exclude.
        refusal_text: error text if another process holds the lock.
        remedy: what to do then.

    Raises:
        StorageError: another process holds the lock (`errno` is None), the lock file cannot be
            opened, or the file system has no locks.
    """
    path = folder / LOCK_NAME
    with translate_storage_errors(folder):
        if path.is_symlink() or (path.exists() and not path.is_file()):
            set_aside_damaged(path)
        # Opening for reading is enough for a lock, and works on a read-only disk.
        flags = os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        descriptor = os.open(path, flags, 0o666)
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise StorageError(refusal_text, where=str(folder), remedy=remedy) from error
    except OSError as error:
        os.close(descriptor)
        raise StorageError(
            f"its file system has no locks: {error.strerror}",
            where=str(folder),
            expected="a folder that can be locked, so that two processes do not write in it",
            remedy=_NO_LOCKS,
            errno=error.errno,
        ) from error
    with suppress(OSError):  # warns at the start; a failing disk raises at the first write
        sync_folder(folder)
    if not is_shared:
        _exclusive_locks[folder] = descriptor
    try:
        yield
    finally:
        if _exclusive_locks.get(folder) == descriptor:
            del _exclusive_locks[folder]
        os.close(descriptor)


_exclusive_locks: dict[Path, int] = {}
"""Folders that this process has locked exclusively, with the locks' descriptors."""


def is_locked_folder_in_place(folder: Path) -> bool:
    """Return whether the folder that this process has locked is still at this path.

    It is not if it was moved, deleted or unmounted: files that are open then still accept writes,
    but under another name or none.
    """
    try:
        there, ours = os.stat(folder / LOCK_NAME), os.fstat(_exclusive_locks[folder])
    except (KeyError, OSError):  # another thread has just ended or replaced the lock
        return False
    return (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)


def raise_if_locked_folder_gone(path: Path) -> None:
    """Refuse to write where a locked folder has gone, such as into an empty mount point.

    Raises:
        FolderGoneError: `path` is in a folder that this process has locked, and the folder is gone.
    """
    for folder in list(_exclusive_locks):
        if path.is_relative_to(folder) and not is_locked_folder_in_place(folder):
            raise FolderGoneError(
                "this is not the folder that was opened: it was moved, deleted or unmounted",
                where=str(folder),
                remedy="Move it back or mount it: it is then used again automatically",
                errno=errno.ENOENT,
            )


ASIDE_SUFFIX = ".damaged"
"""Suffix, before a number, of a file that was set aside."""


def strip_damaged_or_temporary_marks(name: str) -> str:
    """Return a file's name without the marks of a set-aside or temporary one, if any."""
    if match := _TEMPORARY.fullmatch(name):
        return match["name"]
    return name.partition(ASIDE_SUFFIX)[0]


def set_aside_damaged(path: Path) -> Path:
    """Rename a damaged file, folder or link, so that it is not read as the original.

    Returns:
        Its new path: in the same folder, with `.damaged` and a number behind its name.

    Raises:
        StorageError: it cannot be renamed, and has its old name.
    """
    with translate_storage_errors(path, "Move it away by hand"):
        existing = {each.name for each in path.parent.iterdir()}
        free = (f"{path.name}{ASIDE_SUFFIX}-{number}" for number in count(1))
        aside = path.with_name(next(name for name in free if name not in existing))
        path.rename(aside)
        sync_folder(path.parent)
    return aside


def try_set_aside_and_describe(path: Path, damage: FootTileError) -> str:
    """Set a damaged file aside if possible; return a message of what happened."""
    try:
        return escape_control_chars(f"{damage}; it is kept as {set_aside_damaged(path).name}")
    except StorageError as error:
        return f"{damage}; it cannot be set aside: {error.what}"


class ScratchBlock(NamedTuple):
    """Position and sizes of a block in a scratch file."""

    offset: int
    """Offset in bytes."""
    stored_bytes: int
    """Length in the file, compressed."""
    size_bytes: int
    """Length after decompression."""


class ScratchFile:
    """Scratch file of compressed blocks. One thread appends; any may read.

    Args:
        folder: a folder on the disk to use.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file: IO[bytes] | None = None
        self._end = 0

    def append(self, content: bytes) -> ScratchBlock:
        """Compress and append a block.

        Raises:
            StorageError: the disk is full or not writable; earlier blocks are still there.
        """
        stored = pa.compress(content, codec="zstd", asbytes=True)
        try:
            if self._file is None:
                # Open as long as this object lives.
                self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            descriptor, written = self._file.fileno(), 0
            while written < len(stored):
                written += os.pwrite(descriptor, stored[written:], self._end + written)
        except OSError as error:
            raise StorageError(
                f"cannot be written: {error.strerror}", where=str(self._folder), errno=error.errno
            ) from error
        block = ScratchBlock(self._end, len(stored), len(content))
        self._end += len(stored)
        return block

    def read(self, block: ScratchBlock) -> bytes:
        """Read and decompress a block.

        Raises:
            DamagedFileError: it cannot be read any more.
        """
        where = str(self._folder)
        if self._file is None:
            raise DamagedFileError("the scratch file holds no block", where=where)
        try:
            stored = os.pread(self._file.fileno(), block.stored_bytes, block.offset)
            return pa.decompress(stored, block.size_bytes, "zstd", asbytes=True)
        except (OSError, ValueError, pa.ArrowException) as error:
            raise DamagedFileError(f"cannot be read: {error}", where=where) from error
