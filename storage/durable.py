"""Writing so that it stays written: whole files or none, synced, and errors a user can act on.

Here also: reading such files without following links or waiting for pipes; the lock of a folder,
since two processes that write in it would each undo what the other does; and setting aside what is
damaged, since a file that cannot be trusted is still somebody's.
"""

from __future__ import annotations

import errno
import fcntl
import io
import logging
import os
import re
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from itertools import count
from pathlib import Path

from devices.errors import DamagedFileError, FolderGoneError, FootTileError, StorageError
from devices.words import printable

log = logging.getLogger("foottile.storage")

_TEMPORARY = re.compile(
    r"\.(?P<name>.+)\.(?P<process>[0-9]+)\.(?P<started>[0-9]+)\.[0-9a-f]{8}\.tmp"
)
_OLDER_TEMPORARY = re.compile(r"\.(?P<name>.+)\.(?P<process>[0-9]+)(-[0-9a-f]{8})?\.tmp")
_NO_LONGER = {"Z", "X"}
_STARTED_FIELD = 19
"""Field of /proc/PID/stat, counted after the name: when the process started."""


def write_whole(path: Path, content: bytes, *, mode: int = 0o666) -> None:
    """Write a file, whole or not at all; it is on the disk when this returns.

    Args:
        path: the file; one that is there is replaced.
        content: all of it.
        mode: permissions, of which the umask takes its share.

    Raises:
        StorageError: the disk is full or not writable; raises as `whole_file`.
    """
    with whole_file(path, mode=mode) as file:
        file.write(content)


_NO_FILE = (errno.ELOOP, errno.EIO, errno.EBADMSG)
"""What is said of a file that is none, or that its disk has lost; it says so again next time."""
BYTES_MAX = 64 << 20
"""No file that is read at once is longer; what is, is not read into memory."""


def read_whole(path: Path, *, bytes_max: int = BYTES_MAX) -> bytes:
    """Read a file of ours that is small.

    Args:
        path: the file itself: links are not followed, and pipes not waited for.
        bytes_max: a longer one is none of ours.

    Raises:
        FileNotFoundError: there is none.
        DamagedFileError: it is no file, too long for one of ours, or its disk has lost it.
        StorageError: it may be whole and cannot be read now: it is another user's, or memory or
            descriptors are used up. Nobody may set it aside, or write another in its place.
    """
    with open_own(path) as file, read_errors(path):
        size = os.fstat(file.fileno()).st_size
        if size > bytes_max:
            raise DamagedFileError(
                f"it has {size} bytes", where=str(path), expected=f"up to {bytes_max}"
            )
        return file.read()


def open_own(path: Path) -> io.BufferedReader:
    """Open a file of ours for reading, whatever its length; raises as `read_whole`."""
    with read_errors(path):
        # A link may lead anywhere, and a pipe would be waited for.
        if not stat.S_ISREG(path.lstat().st_mode):
            raise DamagedFileError("it is not a file", where=str(path))
        return open(path, "rb", opener=_without_following)


@contextmanager
def read_errors(path: Path) -> Iterator[None]:
    """What opening or reading a file of ours raises, as `read_whole` says it."""
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as error:
        what = f"cannot be read: {error.strerror}"
        if error.errno in _NO_FILE:
            raise DamagedFileError(what, where=str(path)) from error
        raise StorageError(
            what,
            where=str(path),
            remedy="It is left as it is: let this user read it, or try again",
            errno=error.errno,
        ) from error


def _without_following(name: str, flags: int) -> int:
    return os.open(name, flags | os.O_NOFOLLOW | os.O_NONBLOCK)


@contextmanager
def whole_file(path: Path, *, mode: int = 0o666) -> Iterator[io.BufferedWriter]:
    """A file to write that takes its place, whole and on the disk, when the block ends well.

    Raises:
        StorageError: the disk is full or not writable. The old file is still there, unless only the
            folder could not be synced: then the new file is there, and its name may be lost with
            the power.
    """
    temporary = temporary_of(path)
    check_held(path)
    try:
        with storage_errors(path):
            with open(temporary, "wb", opener=partial(os.open, mode=mode)) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
            sync_folder(path.parent)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def temporary_of(path: Path) -> Path:
    """A temporary name beside `path` for a file in writing; it names the process that writes."""
    process = os.getpid()
    name = f".{path.name}.{process}.{_started(process) or 0}.{secrets.token_hex(4)}.tmp"
    return path.with_name(name)


def remove_stale_temporaries(folder: Path) -> list[Path]:
    """Delete files that dead processes left half-written in a folder and below; return their paths.

    Files of living processes stay: they may still be written. If a process number was given to
    another process since, the start time shows it.

    Raises:
        StorageError: the folder cannot be read, or a file not deleted.
    """
    removed = []
    with storage_errors(folder):
        folder.stat()  # fails if the folder is missing, where rglob just finds no files
        for path in sorted(folder.rglob(".*.tmp")):
            if is_stale(path.name) and path.is_file():
                path.unlink(missing_ok=True)
                removed.append(path)
        for parent in {path.parent for path in removed}:
            sync_folder(parent)
    return removed


def is_stale(name: str) -> bool:
    """Is it a temporary name of a process of this machine that has ended?"""
    if match := _TEMPORARY.fullmatch(name):
        return _started(int(match["process"])) != int(match["started"])
    if match := _OLDER_TEMPORARY.fullmatch(name):
        return _started(int(match["process"])) is None
    return False


def _started(process: int) -> int | None:
    """When a process started, in ticks after the machine's start; None if no such process runs.

    A zombie has ended, though its parent has not waited for it: None as well.
    """
    try:
        fields = Path(f"/proc/{process}/stat").read_text("utf-8", "replace").rsplit(") ", 1)[1]
        state, *rest = fields.split()
        return None if state in _NO_LONGER else int(rest[_STARTED_FIELD - 1])
    except (FileNotFoundError, ProcessLookupError):
        return None


def make_folder(folder: Path) -> None:
    """Make a folder and those above it; their names are on the disk when this returns.

    Another process may have made the last folder and not synced its name: it is synced in any case.

    Raises:
        OSError: it cannot be made.
        FolderGoneError: it would be in a folder whose lock we hold, and that one is gone.
    """
    check_held(folder)
    missing = [folder]
    while not missing[-1].parent.is_dir():
        missing.append(missing[-1].parent)
    for each in reversed(missing):
        each.mkdir(exist_ok=True)
        sync_folder(each.parent)


_CANNOT_SYNC_FOLDERS = {*(errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF)}
"""Answers of file systems that sync files only, such as CIFS, vboxsf, WSL's and some of FUSE.

PostgreSQL and SQLite go on after them, too: no program can do more there.
"""
_warned_devices: set[int] = set()
"""File systems (`st_dev`) that cannot sync folders, and that were warned of."""


def sync_folder(folder: Path) -> None:
    """Put the names in a folder on the disk: a rename is not there until its folder is synced.

    A file system that cannot do so is warned of once; the files themselves are synced there, too.

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
                printable(str(folder)),
                error.strerror,
            )
    finally:
        os.close(descriptor)


@contextmanager
def storage_errors(path: Path, remedy: str = "") -> Iterator[None]:
    """Turn an OSError of the block into a StorageError that names `path`.

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
def locked(
    folder: Path,
    *,
    is_shared: bool = False,
    refusal: str = "a foottile server or node uses this folder",
    remedy: str = "Stop it first: while it runs, it completes sessions by itself",
) -> Iterator[None]:
    """Hold the folder's lock; a running server or node holds it as long as it runs.

    Args:
        folder: must be there.
        is_shared: others that hold it shared do not matter.
        refusal: what is said if another process holds it.
        remedy: what to do then.

    Raises:
        StorageError: another process holds it (`errno` is None), it cannot be opened, or the file
            system has no locks.
    """
    path = folder / LOCK_NAME
    with storage_errors(folder):
        if path.is_symlink() or (path.exists() and not path.is_file()):
            set_aside(path)
        # Opening for reading is enough for a lock, and works on a disk that takes no more writes.
        flags = os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        descriptor = os.open(path, flags, 0o666)
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise StorageError(refusal, where=str(folder), remedy=remedy) from error
    except OSError as error:
        os.close(descriptor)
        raise StorageError(
            f"its file system gives no lock: {error.strerror}",
            where=str(folder),
            expected="a folder that can be locked, so that two processes do not write in it",
            remedy=_NO_LOCKS,
            errno=error.errno,
        ) from error
    with suppress(OSError):  # to warn at the start; a disk that fails is an error where it matters
        sync_folder(folder)
    if not is_shared:
        _held[folder] = descriptor
    try:
        yield
    finally:
        if _held.get(folder) == descriptor:
            del _held[folder]
        os.close(descriptor)


_held: dict[Path, int] = {}
"""Folders whose lock this process holds alone, and the locks' descriptors."""


def is_held(folder: Path) -> bool:
    """Is the folder under this name the one whose lock we hold?

    It is not if it was moved, deleted or unmounted meanwhile: files that are open then still take
    what is written, and nobody will find it there.
    """
    try:
        there, ours = os.stat(folder / LOCK_NAME), os.fstat(_held[folder])
    except OSError:  # also of a lock that another thread has just changed for the new folder's
        return False
    return (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)


def check_held(path: Path) -> None:
    """Nothing is written where a folder was whose lock we hold: not into an empty mount point.

    Raises:
        FolderGoneError: `path` is in such a folder, and that one is not there any more.
    """
    for folder in list(_held):
        if path.is_relative_to(folder) and not is_held(folder):
            raise FolderGoneError(
                "this is not the folder that was opened: it was moved, deleted or unmounted",
                where=str(folder),
                remedy="Move it back or mount it: it is then used again by itself",
                errno=errno.ENOENT,
            )


ASIDE = ".damaged"


def intended_name(name: str) -> str:
    """The name that a file had before it was set aside, or has once it is written."""
    if match := _TEMPORARY.fullmatch(name) or _OLDER_TEMPORARY.fullmatch(name):
        return match["name"]
    return name.partition(ASIDE)[0]


def set_aside(path: Path) -> Path:
    """Rename what is damaged, a file, folder or link, so that nobody reads it as what it was.

    Returns:
        Where it is now: beside its place, with `.damaged` and a number behind its name.

    Raises:
        StorageError: it cannot be renamed; it is where it was then.
    """
    with storage_errors(path, "Move it away by hand"):
        taken = {each.name for each in path.parent.iterdir()}
        free = (f"{path.name}{ASIDE}-{number}" for number in count(1))
        aside = path.with_name(next(name for name in free if name not in taken))
        path.rename(aside)
        sync_folder(path.parent)
    return aside


def put_aside(path: Path, why: FootTileError) -> str:
    """Set aside what turned out to be damaged, if that can be; what happened, in words."""
    try:
        return printable(f"{why}; it is kept as {set_aside(path).name}")
    except StorageError as error:
        return f"{why}; it cannot be set aside: {error.what}"
