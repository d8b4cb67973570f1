"""Folders in which a worker works: what a killed one has left is taken away by the next.

They are named after machine and process, since several machines may work in one folder.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from storage.durable import is_stale, storage_errors, temporary_of

_MACHINE = re.sub(r"[^\w-]", "-", socket.gethostname())
SYSTEM = Path(tempfile.gettempdir()) / f"foottile-{os.getuid()}"
"""For what comes from a store, and goes to one."""


@contextmanager
def workspace(parent: Path) -> Iterator[Path]:
    """An empty folder in `parent`, which is made if it is missing; gone when the block ends.

    Raises:
        StorageError: it cannot be made.
    """
    with storage_errors(parent, "Name a folder that can be written to"):
        parent.mkdir(0o700, parents=True, exist_ok=True)
        folder = temporary_of(parent / _MACHINE)
        folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_stale_workspaces(parent: Path) -> None:
    """Take away what processes of this machine have left that were killed."""
    for folder in parent.glob(f".{_MACHINE}.*.tmp"):
        if is_stale(folder.name):
            shutil.rmtree(folder, ignore_errors=True)
