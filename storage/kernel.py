"""Which start of this machine it is: what a killed process left in memory is lost by a new one."""

from __future__ import annotations

from pathlib import Path

BOOT_ID_FILE = Path("/proc/sys/kernel/random/boot_id")


def kernel_boot_id() -> str | None:
    """The kernel's name of its present start; None where there is no such thing."""
    try:
        return BOOT_ID_FILE.read_text(encoding="ascii").strip() or None
    except (OSError, ValueError):
        return None
