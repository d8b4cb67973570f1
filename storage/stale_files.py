"""What a killed process left half written: `.NAME.PID.tmp`, which nobody will ever finish."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

_TEMPORARY = re.compile(r"\..+\.([0-9]{1,10})(?:-[0-9a-f]+)?\.tmp")


def remove_stale(folder: Path) -> list[Path]:
    """Delete such files of processes that are gone, in this folder and all below it.

    Called before this process writes there: a file with its own number is of another one, which had
    the same number before a restart.

    Returns:
        Which they were. One that cannot be deleted is left.
    """
    removed = []
    for path in folder.rglob(".*.tmp"):
        found = _TEMPORARY.fullmatch(path.name)
        if found is None or path.is_symlink() or not path.is_file():
            continue
        pid = int(found[1])
        if pid != os.getpid() and _runs(pid):
            continue
        with suppress(OSError):
            path.unlink()
            removed.append(path)
    return removed


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # somebody else's
        return True
    return True
