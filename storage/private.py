"""Who may read what a process writes: its user, unless the folder's owner lets a group in."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from devices.errors import StorageError
from devices.words import is_utf8
from storage.durable import LOCK_NAME, intended_name, make_folder, storage_errors

_OURS = {
    *(LOCK_NAME, ".writable", "journal", "nodes", "server_id", "sessions", "token", "trash"),
    "demo",  # a data folder of its own, within the user's
    "servers",  # foottile.local_server keeps it beside a node's journal
}
"""All that servers and nodes write in their folder."""
_NO_MODES = {
    *(errno.EPERM, errno.EACCES, errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)
}
"""The folder is another user's, or its file system has no permissions, such as vfat and CIFS."""


def keep_private(folder: Path) -> None:
    """What this process writes from now on is for its user, whatever the umask was.

    A folder that is made here, or is empty, or is ours and every user could read it, is closed to
    others. One that its owner has opened to its group, and to it only, stays so, and what is
    written is the group's to read.

    Args:
        folder: where it will write; made if absent.

    Raises:
        StorageError: it cannot be made, or not be closed to others, or its path is not UTF-8.
    """
    if not is_utf8(str(folder.absolute())):
        raise StorageError(
            "the path is not UTF-8",
            where=str(folder.absolute()),
            expected="a path that JSON can state: it is in messages and in files",
            remedy="Rename the folder, or choose another one",
        )
    os.umask(0o077)
    with storage_errors(folder):
        make_folder(folder)
    mode = stat.S_IMODE(folder.stat().st_mode)
    if mode & 0o050 and not mode & 0o007:
        os.umask(0o027)
    elif mode & 0o077 and _is_ours(folder):
        try:
            folder.chmod(mode & ~0o077)
        except OSError as error:
            if error.errno not in _NO_MODES:
                raise StorageError(
                    f"cannot be closed to other users: {error.strerror}",
                    where=str(folder),
                    remedy="Choose another folder with --data",
                    errno=error.errno,
                ) from error


def _is_ours(folder: Path) -> bool:
    """Is there nothing in it but what we wrote? Somebody's home is not ours to close."""
    return {intended_name(path.name) for path in folder.iterdir()} <= _OURS
