"""Device files: reopening after they went away, and the programs that have one open."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Generic, Protocol, TypeVar

from devices.errors import FootTileError

ATTEMPT_INTERVAL_NS = 1_000_000_000
"""Interval between the begins of two attempts."""


class Closable(Protocol):
    """Open device."""

    def close(self) -> None:
        """Release the device."""


Device = TypeVar("Device", bound=Closable)


class DeviceReopener(Generic[Device]):
    """Non-blocking retries, one a second, to open a device.

    Opening may block: some drivers query a USB adapter over its cable and wait seconds for an
    answer. So each attempt runs in a separate thread.

    Args:
        open_device: opens the device by its path, or raises a `FootTileError`.
        is_synchronous: run attempts in the caller's thread: for emulated devices, which never
            block, and whose time stands still meanwhile.
    """

    def __init__(self, open_device: Callable[[], Device], *, is_synchronous: bool = False) -> None:
        self.last_error = ""
        """Reason why the last attempt failed; empty before the first and after success."""
        self._open_device = open_device
        self._is_synchronous = is_synchronous
        self._attempt: Thread | None = None
        self._opened: Device | None = None
        self._due_ns = 0

    def poll_opened_device(self, now_ns: int) -> Device | None:
        """Return the device if an attempt has opened it; else start an attempt if due."""
        if self._attempt is None and now_ns >= self._due_ns:
            self._due_ns = now_ns + ATTEMPT_INTERVAL_NS
            if self._is_synchronous:
                self._open()
            else:
                self._attempt = Thread(target=self._open, name="reopen a device", daemon=True)
                self._attempt.start()
        if self._attempt is not None:
            if self._attempt.is_alive():
                return None
            self._attempt = None
        opened, self._opened = self._opened, None
        return opened

    def close(self) -> None:
        """Close a device that an attempt opened and `poll` did not return."""
        if self._attempt is None and self._opened is not None:
            self._opened.close()
            self._opened = None

    def _open(self) -> None:
        try:
            self._opened = self._open_device()
        except FootTileError as error:
            self.last_error = str(error)
        else:
            self.last_error = ""


PROC = Path("/proc")


def find_programs_using(device_path: str) -> tuple[str, ...]:
    """Return the programs that have the file at `device_path` open, as "NAME (process N)".

    Only processes that this user may inspect: a service's own ones, or all for root.
    """
    device = Path(device_path).resolve()
    found = []
    for process in sorted(PROC.glob("[0-9]*"), key=lambda process: int(process.name)):
        with suppress(OSError):  # it ended, or is another user's
            if any(link.resolve() == device for link in (process / "fd").iterdir()):
                name = (process / "comm").read_text().strip()
                found.append(f"{name} (process {process.name})")
    return tuple(found)
