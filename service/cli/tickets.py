"""Tickets and tokens on the command line: addresses, QR codes, token of a data folder."""

from __future__ import annotations

import re
import shutil
import sys
from io import StringIO
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

import typer

from devices.errors import UsageError
from service.cli.options import echo, is_encodable, remark, resolve_data_folder

AdvertiseOption = Annotated[
    str | None,
    typer.Option(
        metavar="HOST",
        help="Address or name to print, for a server behind a reverse proxy or in a container; "
        "default: all interfaces.",
    ),
]
TokenFolderOption = Annotated[
    Path | None,
    typer.Option("--data", help="Take the token from this data folder of the server."),
]
_BORDER = 2
_BLACK_ON_WHITE = "\x1b[38;5;231;48;5;16m"
"""Light blocks on a dark ground in any colour scheme: few phones read an inverted code."""
_WHITE_ON_WHITE = "\x1b[38;5;231;48;5;231m"
_RESET = "\x1b[0m"


def read_data_token(folder: Path | None) -> str | None:
    """Return the token in a server's data folder; None without a folder.

    Raises:
        UsageError: the folder has no token.
    """
    from service.api.address import TOKEN_NAME, read_token

    if folder is None:
        return None
    folder = resolve_data_folder(folder)
    try:
        return read_token(folder)
    except FileNotFoundError as error:
        raise UsageError(
            f"no token in the data folder {str(folder)!r}",
            expected=f"a file `{TOKEN_NAME}`, which a server makes unless FOOTTILE_TOKEN is set",
            remedy="Name the folder of --data of `foottile serve`, or set FOOTTILE_TOKEN",
        ) from error


def get_host(url: str) -> str:
    """Return the name or the address of a server, without port and brackets."""
    return urlsplit(url).hostname or ""


def is_reachable(url: str) -> bool:
    """Return whether other devices can reach the address."""
    from foottile.local_server import is_loopback

    return not is_loopback(get_host(url))


def remark_unreachable(urls: list[str], host: str) -> None:
    """Print why other devices cannot reach a server's addresses.

    Args:
        urls: addresses of the server.
        host: address on which it listens.
    """
    from service.api.address import is_wildcard, list_addresses

    if is_wildcard(host) and not any(is_reachable(url) for url in urls):
        if list_addresses(include_ipv6=True):
            remark("this machine has IPv6 addresses only: start the server with --host ::")
        else:
            remark(
                "this machine has no network, so no phone reaches it: start a hotspot or join a "
                "network; `foottile invite` then shows its address"
            )
    if any("%25" in url for url in urls):
        remark(
            "an address with %25 is for a node or a Python program on the same cable: replace the "
            "interface name after it by the other machine's"
        )


def make_qr_lines(text: str, *, is_ascii: bool = False) -> list[str]:
    """Return a QR code as lines of text that draw its light modules.

    Args:
        text: content of the code.
        is_ascii: draw `##` for a module instead of half blocks with two rows a line.
    """
    import segno

    code = segno.make(text, error="l", micro=False)
    if is_ascii:
        rows = code.matrix_iter(border=_BORDER)
        return ["".join("  " if is_dark else "##" for is_dark in row) for row in rows]
    drawn = StringIO()
    code.terminal(drawn, border=_BORDER, compact=True)
    return drawn.getvalue().splitlines()


def show_qr_code(address: str, *, purpose: str) -> None:
    """Print the QR code of a link and its purpose, only on a terminal, not to a log."""
    if not sys.stdout.isatty():
        return
    lines = make_qr_lines(address, is_ascii=not is_encodable("█▀▄"))
    columns = shutil.get_terminal_size().columns
    if len(lines[0]) > columns:
        remark(f"the QR code needs {len(lines[0])} columns, and this terminal has {columns}")
        return
    for line in lines:
        solid = re.sub("#+", rf"{_WHITE_ON_WHITE}\g<0>{_BLACK_ON_WHITE}", line)
        sys.stdout.write(f"{_BLACK_ON_WHITE}{solid}{_RESET}\n")
    sys.stdout.flush()
    remark(purpose)


def show_login_code(link: str, *, viewer: bool = False) -> None:
    """Print the QR code of a login link, only on a terminal."""
    permissions = "look" if viewer else "tare, record and change"
    purpose = f"for a phone: it may {permissions}; once, for five minutes; more: `foottile invite`"
    show_qr_code(link, purpose=purpose)


def print_ticket(urls: list[str], *, viewer: bool) -> None:
    """Print the login links of a ticket, and the QR code of the first."""
    for url in urls:
        echo(url)
    if is_reachable(urls[0]):
        show_login_code(urls[0], viewer=viewer)
    else:
        remark(
            "a phone does not reach this address: start the server with --host 0.0.0.0. If it "
            "runs so, its machine has no network: start a hotspot or join one, and retry"
        )
