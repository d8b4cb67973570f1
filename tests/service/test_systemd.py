"""What node and server tell systemd (sd_notify(3))."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.service.process import Start
from tests.waiting import PATIENCE_S

COMMANDS: dict[str, Callable[[Path], tuple[str, ...]]] = {
    "serve": lambda folder: ("serve", "--port=0", f"--data={folder / 'data'}"),
    "node": lambda folder: ("node", "--scene=standing", f"--journal={folder / 'node'}"),
}


@pytest.mark.process
@pytest.mark.parametrize("command", COMMANDS)
def test_a_service_tells_begin_life_and_end(command: str, foottile: Start, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(f"\0foottile-{tmp_path.name}-{command}")
        systemd.settimeout(PATIENCE_S)
        service = foottile(
            *COMMANDS[command](tmp_path),
            NOTIFY_SOCKET=f"@foottile-{tmp_path.name}-{command}",
            WATCHDOG_USEC="200000",
        )
        assert systemd.recv(100) == b"READY=1"
        assert [systemd.recv(100) for _ in range(3)] == [b"WATCHDOG=1"] * 3
        service.process.terminate()
        while (state := systemd.recv(100)) == b"WATCHDOG=1":
            pass
        assert state == b"STOPPING=1"
        assert service.ended() == 0
