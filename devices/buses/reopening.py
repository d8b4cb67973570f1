"""Opens a device file again that went away: a USB adapter, a driver that was unbound."""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread
from typing import Generic, Protocol, TypeVar

from devices.errors import FootTileError

PERIOD_NS = 1_000_000_000
"""From the begin of one attempt to that of the next."""


class Closable(Protocol):
    """A device that was opened."""

    def close(self) -> None:
        """Release it."""


Device = TypeVar("Device", bound=Closable)


class Reopener(Generic[Device]):
    """Attempts to open a device, one a second, none of which makes the caller wait.

    An attempt may block: some drivers ask a USB adapter over its cable when it is opened, and wait
    seconds for an answer. So each attempt runs in a thread of its own.

    Args:
        open_device: opens it by its path, or raises a `FootTileError`.
        at_once: run attempts in the caller's thread: for emulated devices, which never block, and
            whose time stands still meanwhile.
    """

    def __init__(self, open_device: Callable[[], Device], *, at_once: bool = False) -> None:
        self.problem = ""
        """Why the last attempt failed; empty before the first and after success."""
        self._open_device = open_device
        self._at_once = at_once
        self._attempt: Thread | None = None
        self._opened: Device | None = None
        self._due_ns = 0

    def poll(self, now_ns: int) -> Device | None:
        """Return the device if an attempt has opened it; else begin an attempt if one is due."""
        if self._attempt is None and now_ns >= self._due_ns:
            self._due_ns = now_ns + PERIOD_NS
            if self._at_once:
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
        """Close what an attempt may have opened since."""
        if self._attempt is None and self._opened is not None:
            self._opened.close()
            self._opened = None

    def _open(self) -> None:
        try:
            self._opened = self._open_device()
        except FootTileError as error:
            self.problem = str(error)
        else:
            self.problem = ""
