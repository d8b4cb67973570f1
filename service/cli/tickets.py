"""Tickets and tokens on the command line: addresses, QR codes, and the token of a data folder."""

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
from service.cli.options import data_folder, is_shown, remark, say

AdvertiseOption = Annotated[
    str | None,
    typer.Option(
        metavar="HOST",
        help="Address or name to show to people, as behind a reverse proxy or in a container; "
        "default: those of all interfaces.",
    ),
]
TokenFolderOption = Annotated[
    Path | None,
    typer.Option("--data", help="Take the token from this data folder of the server."),
]
_BORDER = 2
_BLACK_ON_WHITE = "\x1b[38;5;231;48;5;16m"
"""Light blocks on a dark ground, whatever colours the terminal has: few phones read it inverted."""
_WHITE_ON_WHITE = "\x1b[38;5;231;48;5;231m"
_USUAL = "\x1b[0m"


def read_data_token(folder: Path | None) -> str | None:
    """Return the token that a server keeps in its data folder; None without a folder.

    Raises:
        UsageError: no token is there.
    """
    from service.api.address import TOKEN_NAME, read_token

    if folder is None:
        return None
    folder = data_folder(folder)
    try:
        return read_token(folder)
    except FileNotFoundError as error:
        raise UsageError(
            f"no token in the data folder {str(folder)!r}",
            expected=f"a file `{TOKEN_NAME}`, which a server makes unless FOOTTILE_TOKEN is set",
            remedy="Name the folder of --data of `foottile serve`, or set FOOTTILE_TOKEN",
        ) from error


def host_of(url: str) -> str:
    """Return the name or the address of a server, without port and brackets."""
    return urlsplit(url).hostname or ""


def reaches_others(url: str) -> bool:
    """Is this an address that a phone could open?"""
    from foottile.local_server import is_loopback

    return not is_loopback(host_of(url))


def remark_reach(urls: list[str], host: str) -> None:
    """Remark what keeps others from a server's addresses.

    Args:
        urls: its addresses.
        host: what it was told to listen on.
    """
    from service.api.address import is_wildcard
    from service.api.interfaces import list_addresses

    if is_wildcard(host) and not any(reaches_others(url) for url in urls):
        if list_addresses(include_ipv6=True):
            remark("this machine has addresses of IPv6 only: start the server with --host ::")
        else:
            remark(
                "this machine is in no network, so no phone reaches it: start a hotspot or join a "
                "network; `foottile invite` then shows its address"
            )
    if any("%25" in url for url in urls):
        remark(
            "an address with %25 is for a node or a Python program at the same cable: behind it "
            "stands this machine's name of the interface; write there the other machine's"
        )


def qr_lines(text: str, *, is_ascii: bool = False) -> list[str]:
    """Return a QR code as lines of text in which the light modules are drawn.

    Args:
        text: its content.
        is_ascii: draw `##` for a module, and not half blocks, two rows a line.
    """
    import segno

    code = segno.make(text, error="l", micro=False)
    if is_ascii:
        rows = code.matrix_iter(border=_BORDER)
        return ["".join("  " if is_dark else "##" for is_dark in row) for row in rows]
    drawn = StringIO()
    code.terminal(drawn, border=_BORDER, compact=True)
    return drawn.getvalue().splitlines()


def show_code(address: str, *, viewer: bool = False) -> None:
    """Show the code of an address that has a ticket; on a terminal only, which no log is."""
    if not sys.stdout.isatty():
        return
    lines = qr_lines(address, is_ascii=not is_shown("█▀▄"))
    columns = shutil.get_terminal_size().columns
    if len(lines[0]) > columns:
        remark(f"the QR code needs {len(lines[0])} columns, and this terminal has {columns}")
        return
    for line in lines:
        solid = re.sub("#+", rf"{_WHITE_ON_WHITE}\g<0>{_BLACK_ON_WHITE}", line)
        sys.stdout.write(f"{_BLACK_ON_WHITE}{solid}{_USUAL}\n")
    sys.stdout.flush()
    may = "look" if viewer else "tare, record and change"
    remark(f"for a phone: it may {may}; good once, for five minutes; more with `foottile invite`")


def say_ticket(urls: list[str], *, viewer: bool) -> None:
    """Say under which addresses a ticket is good, and show the code of the first one."""
    for url in urls:
        say(url)
    if reaches_others(urls[0]):
        show_code(urls[0], viewer=viewer)
    else:
        remark(
            "a phone does not reach this address: start the server with --host 0.0.0.0; if that is "
            "done, its machine is in no network: start a hotspot or join one, and ask again"
        )
