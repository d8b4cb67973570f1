"""Another boot of the kernel, as far as this process can see: what a power cut is to the next one.

FAULTS_BOOT_ID names a file that stands for /proc/sys/kernel/random/boot_id, whoever opens it here
by `open`, `io.open` (so `Path.read_text`) or `os.open`.
"""

from __future__ import annotations

import builtins
import io
import os
from typing import Any

BOOT_ID_ENV = "FAULTS_BOOT_ID"
KERNEL_BOOT_ID = "/proc/sys/kernel/random/boot_id"


def install_from_environment() -> None:
    """Have the stand-in opened if the environment names one."""
    if path := os.environ.get(BOOT_ID_ENV):
        _stand_in_for_boot_id(path)


def _stand_in_for_boot_id(path: str) -> None:
    real_open, real_os_open = io.open, os.open

    def named(file: Any) -> Any:
        is_path = isinstance(file, str | os.PathLike)
        return path if is_path and os.fspath(file) == KERNEL_BOOT_ID else file

    def stand_in(file: Any, *arguments: Any, **options: Any) -> Any:
        return real_open(named(file), *arguments, **options)

    def os_stand_in(file: Any, *arguments: Any, **options: Any) -> int:
        return real_os_open(named(file), *arguments, **options)

    builtins.open = io.open = stand_in
    if real_os_open in os.supports_dir_fd:
        os.supports_dir_fd.add(os_stand_in)
    os.open = os_stand_in  # type: ignore[assignment]  # of its overloads one is enough
