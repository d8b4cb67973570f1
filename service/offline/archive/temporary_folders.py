"""Temporary folders of workers; leftovers of a killed worker are deleted by the next one.

They are named by machine and process, because several machines may share the parent folder.
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

from storage.durable_files import (
    is_dead_process_temporary,
    make_temporary_path,
    translate_storage_errors,
)

_MACHINE = re.sub(r"[^\w-]", "-", socket.gethostname())
SYSTEM_TEMP_FOLDER = Path(tempfile.gettempdir()) / f"foottile-{os.getuid()}"
"""Parent of the temporary folders for downloads and uploads."""


@contextmanager
def create_workspace(parent: Path) -> Iterator[Path]:
    """Provide an empty folder in `parent`, created if missing; delete it when the block ends.

    Raises:
        StorageError: it cannot be created.
    """
    with translate_storage_errors(parent, "Name a folder that can be written to"):
        parent.mkdir(0o700, parents=True, exist_ok=True)
        folder = make_temporary_path(parent / _MACHINE)
        folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_stale_workspaces(parent: Path) -> None:
    """Delete folders left by killed processes of this machine."""
    for folder in parent.glob(f".{_MACHINE}.*.tmp"):
        if is_dead_process_temporary(folder.name):
            shutil.rmtree(folder, ignore_errors=True)
