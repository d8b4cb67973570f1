"""Report of a service to systemd: it has started, is alive, ends (sd_notify(3))."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress


@asynccontextmanager
async def report_to_systemd(stop: asyncio.Event) -> AsyncIterator[None]:
    """Context manager: tell systemd that a block has begun, runs, and ends, or is to: `stop`.

    An event loop that hangs tells nothing, and systemd restarts the service after `WatchdogSec`.
    Does nothing outside systemd.
    """
    _notify("READY=1")
    tasks = [asyncio.create_task(_feed_watchdog()), asyncio.create_task(_report_end(stop))]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        _notify("STOPPING=1")


async def _report_end(stop: asyncio.Event) -> None:
    """Tell systemd that the service ends: it may deliver and seal for a while."""
    await stop.wait()
    _notify("STOPPING=1")


async def _feed_watchdog() -> None:
    """Tell systemd twice within its interval that this process lives."""
    interval_us = os.environ.get("WATCHDOG_USEC", "")
    is_for_us = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
    if not is_for_us or not interval_us.isdecimal() or not int(interval_us):
        return
    while True:
        _notify("WATCHDOG=1")
        await asyncio.sleep(int(interval_us) / 2e6)


def _notify(state: str) -> None:
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.setblocking(False)  # a systemd that does not read must not hold the event loop
        link.sendto(state.encode(), "\0" + address[1:] if address[0] == "@" else address)
