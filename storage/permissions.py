"""Permissions of the files that a process writes, and files of secrets.

A server keeps a file of secrets in the folder of each node, a node one in its own folder. No other
user may read them.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from devices.errors import StorageError, is_utf8_encodable
from storage.documents import read_document, write_document
from storage.durable_files import (
    LOCK_NAME,
    make_synced_folder,
    strip_damaged_or_temporary_marks,
    translate_storage_errors,
)

_OUR_NAMES = {
    *(LOCK_NAME, ".writable", "journal", "nodes", "server.json", "sessions", "token", "trash"),
    "tls",  # certificates
    "demo",  # a data folder of its own, within the user's
    "servers",  # foottile.local_server keeps it beside a node's journal
}
"""All names that servers and nodes write in their folder."""
_CHMOD_UNSUPPORTED = {
    *(errno.EPERM, errno.EACCES, errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)
}
"""Errors of `chmod` on another user's folder, or without permissions, such as vfat and CIFS."""


def set_umask_and_create_private_folder(folder: Path) -> None:
    """Set the umask, create the folder, and close it to other users if it is only ours.

    A folder is closed to others if it is created here, is empty, or holds only files of ours. One
    that its owner has opened to its group only stays so, and the group can read new files.

    Args:
        folder: where the process will write; created if absent.

    Raises:
        StorageError: it cannot be created or closed to others, or its path is not UTF-8.
    """
    if not is_utf8_encodable(str(folder.absolute())):
        raise StorageError(
            "the path is not UTF-8",
            where=str(folder.absolute()),
            expected="a path that JSON can state: it is in messages and in files",
            remedy="Rename the folder, or choose another one",
        )
    os.umask(0o077)
    with translate_storage_errors(folder):
        make_synced_folder(folder)
    mode = stat.S_IMODE(folder.stat().st_mode)
    if mode & 0o050 and not mode & 0o007:
        os.umask(0o027)
    elif mode & 0o077 and _has_only_our_files(folder):
        try:
            folder.chmod(mode & ~0o077)
        except OSError as error:
            if error.errno not in _CHMOD_UNSUPPORTED:
                raise StorageError(
                    f"cannot be closed to other users: {error.strerror}",
                    where=str(folder),
                    remedy="Choose another folder with --data",
                    errno=error.errno,
                ) from error


def _has_only_our_files(folder: Path) -> bool:
    """Return whether the folder holds only files of ours; a home folder must stay as it is."""
    return {strip_damaged_or_temporary_marks(path.name) for path in folder.iterdir()} <= _OUR_NAMES


SECRETS_NAME = "secrets.json"
_OWNER_ONLY = 0o600
"""File permissions, also in a folder that its owner has opened to a group."""


class _Secrets(BaseModel):
    # An error must not show a secret.
    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True)

    secrets: dict[str, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]]


def read_secrets_or_empty(path: Path) -> dict[str, str]:
    """Return the secrets by name, 64 hex digits each; empty if there is no file.

    Raises:
        FileFormatError: it is damaged, or holds no secrets.
        StorageError: it cannot be read now.
    """
    try:
        return read_document(path, _Secrets).secrets
    except FileNotFoundError:
        return {}


def write_secrets(path: Path, secrets: Mapping[str, str]) -> None:
    """Write the secrets atomically; they are on the disk when this returns.

    Raises:
        StorageError: the disk is full or not writable; the old file is unchanged.
    """
    with translate_storage_errors(path.parent):
        make_synced_folder(path.parent)
    write_document(path, _Secrets(secrets=dict(secrets)), mode=_OWNER_ONLY)
