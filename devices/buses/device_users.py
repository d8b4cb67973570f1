"""Search for programs that have a device open, for error messages about busy devices."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

PROC = Path("/proc")


def find_programs_using(device_path: str, proc_folder: Path = PROC) -> tuple[str, ...]:
    """Return the programs that have the file at `path` open, as "NAME (process N)".

    Only processes that this user may inspect: a service's own ones, or all for root.
    """
    device = Path(device_path).resolve()
    found = []
    for process in sorted(proc_folder.glob("[0-9]*"), key=lambda process: int(process.name)):
        with suppress(OSError):  # it ended, or is another user's
            if any(link.resolve() == device for link in (process / "fd").iterdir()):
                name = (process / "comm").read_text().strip()
                found.append(f"{name} (process {process.name})")
    return tuple(found)
