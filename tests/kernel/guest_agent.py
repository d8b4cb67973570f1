"""In the guest: starts commands, and attaches USB devices. Only `guest.py` calls it.

A command `foottile` is a fork of this process, which has imported what a node needs: under an
emulated processor that takes half a minute.
"""

from __future__ import annotations

import os
import socket
import struct
import sys
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Client
from pathlib import Path
from typing import NoReturn

JOBS = Path("/run/jobs")
PRELOADED = (
    "service.cli.commands.doctor",
    "service.cli.commands.node",
    "service.node.running_node",
    "service.offline.doctor",
)
"""What commands import: forks have it."""
_VHCI = Path("/sys/devices/platform/vhci_hcd.0")
_IMPORT = struct.pack(">HHI32s", 0x0111, 0x8003, 0, b"1-1")
"""OP_REQ_IMPORT (Documentation/usb/usbip_protocol.rst)."""
_IMPORTED_BYTES, _PATHS_BYTES = 8 + 312, 8 + 256 + 32


def start(command: tuple[str, ...], user: int, environment: dict[str, str]) -> int:
    """Start a command as a user of no group; return its process."""
    JOBS.mkdir(exist_ok=True)
    process = os.fork()
    if process == 0:
        _run(command, user, environment)
    return process


def _run(command: tuple[str, ...], user: int, environment: dict[str, str]) -> NoReturn:
    code = 70
    with suppress(BaseException):
        os.setsid()
        output = os.open(JOBS / str(os.getpid()), os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(output, 1)
        os.dup2(output, 2)
        home = Path("/run/home", str(user))
        home.mkdir(parents=True, exist_ok=True)
        os.chown(home, user, user)
        if user:
            os.setgroups([])
            os.setgid(user)
            os.setuid(user)
        os.chdir(home)
        os.environ.update(
            {"HOME": str(home), "TMPDIR": str(home), "TERM": "dumb", "COLUMNS": "160"}
        )
        os.environ.update(environment)
        if command[0] != "foottile":
            os.execvp(command[0], command)  # noqa: S606  # no shell
        code = _run_foottile(command)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _run_foottile(command: tuple[str, ...]) -> int:
    import traceback

    from service.cli.main import main

    sys.argv = list(command)
    try:
        main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        return 70
    return 0


def poll(process: int) -> tuple[int | None, str]:
    """Return a process's exit code, or None while it runs, and its output until now."""
    ended, status = os.waitpid(process, os.WNOHANG)
    output = JOBS / str(process)
    text = output.read_text(errors="replace") if output.exists() else ""
    return os.waitstatus_to_exitcode(status) if ended else None, text


def kill(process: int, signal: int) -> None:
    """Send a signal to a process and to those it started."""
    with suppress(ProcessLookupError):
        os.killpg(process, signal)


def write(path: str, text: str) -> None:
    """Write a file."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text)


def read(path: str) -> str:
    """Read a file."""
    return Path(path).read_text(errors="replace")


def glob(folder: str, pattern: str) -> list[str]:
    """Find files."""
    return sorted(str(path) for path in Path(folder).glob(pattern))


def attach(host: str, port: int, place: int) -> None:
    """Attach the USB device that is served at a port of the host; `place` is a port of vhci."""
    with socket.create_connection((host, port), timeout=20.0) as link:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.sendall(_IMPORT)
        answer = b""
        while len(answer) < _IMPORTED_BYTES:
            answer += link.recv(_IMPORTED_BYTES - len(answer))
        bus, device, speed = struct.unpack_from(">III", answer, _PATHS_BYTES)
        link.settimeout(None)
        (_VHCI / "attach").write_text(f"{place} {link.fileno()} {bus << 16 | device} {speed}")


def main() -> None:
    """Serve one host until it ends."""
    host, port, authkey = sys.argv[1:4]
    for folder in (*Path(sys.executable).resolve().parents, *Path.cwd().parents):
        folder.chmod(0o755)  # in the guest's own files: another user may read Python, too
    with Client((host, int(port)), authkey=authkey.encode()) as link:
        for name in PRELOADED:
            import_module(name)

        link.send("ready")
        calls = {call.__name__: call for call in (start, poll, kill, write, read, glob, attach)}
        with suppress(EOFError, ConnectionError):
            while True:
                name, arguments = link.recv()
                try:
                    answer: object = calls[name](*arguments)
                except Exception as error:
                    answer = error
                link.send(answer)


if __name__ == "__main__":
    main()
