"""Where a server is found, and by which token: what a node has to know before the server has begun.

Nothing here needs what the server itself is made of, which takes long to import.
"""

from __future__ import annotations

import logging
import re
import secrets
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from devices.errors import DamagedFileError, LinkError
from foottile.local_server import LocalServer, is_loopback, publish_local_server
from storage.durable import put_aside, read_whole, storage_errors, write_whole

log = logging.getLogger("foottile.serve")

KEPT_IN = "token"
"""File of the data folder with the token that was made."""
_BACKLOG = 128
_UNREAD_MS = 60_000
"""A connection whose other end takes nothing of what is sent for so long is closed by the kernel:
no time-out of ours sees how much of a download has arrived."""


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 is any that is free.

    Raises:
        LinkError: the port is in use, or the address is not this machine's.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listening = socket.socket(family, kind, protocol)
    except (OSError, UnicodeError) as error:
        raise LinkError(f"cannot listen on {host}: {error}") from error
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # those that come to it inherit this
            listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNREAD_MS)
        if family == socket.AF_INET6:  # `::` is every address, whatever the machine's default
            listening.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        listening.bind(address)
        listening.listen(_BACKLOG)
    except OSError as error:
        listening.close()
        raise LinkError(
            f"cannot listen on {host} port {port}: {error.strerror}",
            remedy="Stop what uses the port, or choose another one with --port",
        ) from error
    return listening


def urls_of(listening: socket.socket, host: str) -> list[str]:
    """Addresses under which it is reached, from other machines first if they can."""
    port = listening.getsockname()[1]
    names = [host]
    if host in ("0.0.0.0", "::", ""):  # noqa: S104  # compared only
        names = [*_own_addresses(), "127.0.0.1"]
    return [f"http://[{n}]:{port}" if ":" in n else f"http://{n}:{port}" for n in names]


def own_names() -> tuple[str, ...]:
    """Names that this machine goes by in its own network: its host name, and NAME.local by mDNS.

    No domain is looked up: who serves the domain names of a network could say any. A host name with
    a domain counts as it is and without it.
    """
    name = socket.gethostname().lower().rstrip(".")
    if not _HOST_NAME.fullmatch(name):
        return ()
    short = name.partition(".")[0]
    return tuple(dict.fromkeys((name, short, f"{short}.local")))


_HOST_NAME = re.compile(r"(?!\d+$)[a-z0-9](?:[a-z0-9-]{0,62}[a-z0-9])?(?:\.[a-z0-9-]{1,63}){0,8}")


def _own_addresses() -> list[str]:
    """This machine's address towards other networks, if it is in one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Nothing is sent: connecting a datagram socket only chooses the way out.
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return []
        return [name for name in (probe.getsockname()[0],) if not is_loopback(name)]


def token_for(given: str | None, data: Path) -> str:
    """Return the token to ask for: the one given, else the one that is kept in the data folder.

    There is always one: through a reverse proxy, `ssh -L` or a container's port everybody comes
    from loopback.

    Raises:
        StorageError: it cannot be read or kept.
    """
    if given:
        return given
    path = data / KEPT_IN
    try:
        return kept_token(data)
    except FileNotFoundError:
        pass
    except DamagedFileError as error:
        log.warning("%s, and a new token is made", put_aside(path, error))
    with storage_errors(path):
        data.mkdir(parents=True, exist_ok=True)
        kept = secrets.token_urlsafe(18)
        write_whole(path, kept.encode() + b"\n", mode=0o600)
    return kept


def kept_token(data: Path) -> str:
    """The token that a server has made and keeps in its data folder.

    Raises:
        FileNotFoundError: there is none.
        DamagedFileError: the file holds no token.
        StorageError: it cannot be read: it is its user's alone.
    """
    path = data / KEPT_IN
    kept = read_whole(path).decode("ascii", "replace").strip()
    if not _TOKEN.fullmatch(kept):
        raise DamagedFileError("it holds no token", where=str(path))
    return kept


@contextmanager
def published(listening: socket.socket, token: str) -> Iterator[None]:
    """Let programs of this user on this machine find the token while the block runs.

    Args:
        listening: socket of the server.
        token: of the server.
    """
    url = urls_of(listening, listening.getsockname()[0])[-1]
    with ExitStack() as stack:
        if is_loopback(urlsplit(url).hostname or ""):
            try:
                stack.enter_context(publish_local_server(LocalServer(url, token)))
            except OSError as error:
                log.warning("%s: commands on this machine need FOOTTILE_TOKEN", error)
        yield


_TOKEN = re.compile(r"[!-~]{8,200}")
"""What people may have put there themselves, too."""
