"""`foottile ticket`: lets somebody in who has no token."""

from __future__ import annotations

from typing import Annotated

import typer

from devices.errors import needs_extra
from service.cli.commands.sessions import SERVER, ServerOption
from service.cli.options import (
    CaOption,
    JsonOption,
    print_json,
)
from service.cli.tickets import TokenFolderOption, read_data_token, say_ticket


@needs_extra("server", "`foottile ticket`")
def ticket_command(
    viewer: Annotated[bool, typer.Option("--viewer", help="One that may look, not press.")] = False,
    server: ServerOption = None,
    ca: CaOption = None,
    data: TokenFolderOption = None,
    as_json: JsonOption = False,
) -> None:
    """Give a ticket for the live page: an address, and on a terminal its QR code.

    Whoever opens it first is in, for twelve hours; it is good for five minutes. Run it on the
    server's own computer. The token is the one in the folder of --data, else FOOTTILE_TOKEN, else
    that of a server which this user runs.
    """
    import foottile

    with foottile.connect(server or SERVER, read_data_token(data), ca=ca) as source:
        ticket = source.ticket(may="look" if viewer else "press")
    if as_json:
        print_json(ticket)
    else:
        say_ticket(ticket["urls"], viewer=viewer)
