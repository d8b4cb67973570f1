"""Record of a running server: its address and token, for programs of the same user on this machine.

A server writes its record into its user's home and holds a lock on the file as long as it runs. The
lock tells a running server from one that was killed, and a process id could belong to another
process by then. The folder does not depend on a login: a runtime folder (XDG_RUNTIME_DIR) is
removed at logout, while a server in tmux runs on, and a service has none.
"""

from __future__ import annotations

import errno
import ipaddress
import json
import os
import socket
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import SplitResult, urlsplit

from platformdirs import user_state_path

_RECORD_BYTES_MAX = 4096


@dataclass(frozen=True)
class LocalServer:
    """Address and token of a server that runs on this machine as this user."""

    url: str
    token: str
    ca: str = ""
    """File of its CA or its certificate; empty without TLS."""


def find_local_server(url: str) -> LocalServer | None:
    """Return the server of this user that listens at a loopback address now, if there is one.

    The token goes only where that server listens: `localhost` may stand for 127.0.0.1 and ::1, and
    another user of the machine may listen at the other one. So a client connects to the address of
    the record.

    Args:
        url: `http://` or `ws://`, with 127.0.0.1, another loopback address, or localhost; for a
            server with TLS also `https://` or `wss://`.
    """
    try:
        parts = urlsplit(url)
        is_tls = parts.scheme in ("https", "wss")
        port = parts.port or (443 if is_tls else 80)
    except ValueError:
        return None
    if os.name != "posix":  # a client may run there, a server does not
        return None
    if not (is_tls or parts.scheme in ("http", "ws")) or not is_loopback(parts.hostname or ""):
        return None
    path = _record_path(port)
    record = None if path is None else _read_record(path)
    if record is None or not _is_same_address(parts, urlsplit(record.url)):
        return None
    if is_tls and not record.ca:
        return None
    return record


@contextmanager
def publish_local_server(server: LocalServer) -> Iterator[None]:
    """Keep the record of this process's server while the block runs.

    Raises:
        OSError: the record cannot be written, or its folder is open to other users.
    """
    import fcntl

    path = _record_path(urlsplit(server.url).port or (443 if server.ca else 80))
    if path is None:
        raise FileNotFoundError(errno.ENOENT, "no home folder", f"user {os.getuid()}")
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _is_private(path.parent.lstat()):
        path.parent.chmod(0o700)
    content = {**asdict(server), "pid": os.getpid()}
    # The rename comes last, so a reader finds the file complete and locked.
    with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX)
            json.dump(content, file)
            file.flush()
            os.replace(file.name, path)
        except BaseException:
            os.unlink(file.name)
            raise
        try:
            yield
        finally:
            _remove_own(path, file.fileno())


def is_loopback(host: str) -> bool:
    """Return whether an address reaches only this machine."""
    if host == "localhost":
        return True
    try:
        return _ip_address(host).is_loopback
    except ValueError:
        return False


def _record_path(port: int) -> Path | None:
    try:
        folder = user_state_path("foottile")
    except RuntimeError:  # a user without a home
        return None
    # A home may be shared by several machines.
    path = folder / "servers" / f"{socket.gethostname()}-{port}.json"
    return path if path.is_absolute() else None


def _read_record(path: Path) -> LocalServer | None:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    with open(descriptor, "rb") as file:
        if not (_is_private(os.fstat(descriptor)) and _is_private(path.parent.lstat())):
            return None
        if not _is_locked(descriptor):
            return None  # the server was killed
        try:
            content = json.loads(file.read(_RECORD_BYTES_MAX))
            return LocalServer(str(content["url"]), str(content["token"]), str(content["ca"]))
        except (ValueError, TypeError, KeyError):
            return None


def _is_private(status: os.stat_result) -> bool:
    """Return whether only this user may read and write it."""
    return status.st_uid == os.geteuid() and not stat.S_IMODE(status.st_mode) & 0o077


def _is_locked(descriptor: int) -> bool:
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a file system without locks
        return False
    return False


def _is_same_address(requested: SplitResult, listening: SplitResult) -> bool:
    if requested.path.strip("/") or not (requested.hostname and listening.hostname):
        return False
    if requested.hostname == "localhost":
        return True
    return _ip_address(requested.hostname) == _ip_address(listening.hostname)


def _ip_address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    address = ipaddress.ip_address(host)
    return getattr(address, "ipv4_mapped", None) or address


def _remove_own(path: Path, descriptor: int) -> None:
    """Remove a record, unless a later server has put its own in its place."""
    try:
        if os.path.samestat(os.fstat(descriptor), path.lstat()):
            path.unlink()
    except OSError:
        pass  # it is gone already
