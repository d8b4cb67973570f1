"""`foottile ticket`: lets somebody in who has no token."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from devices.errors import needs_extra
from service.cli.commands.sessions import SERVER, ServerOption
from service.cli.options import JsonOption, data_folder, print_json
from service.cli.tickets import say_ticket


@needs_extra("server", "`foottile ticket`")
def ticket_command(
    viewer: Annotated[bool, typer.Option("--viewer", help="One that may look, not press.")] = False,
    server: ServerOption = None,
    data: Annotated[Path | None, typer.Option(help="Its data folder, which has its token.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Give a ticket for the live page: an address, and on a terminal its QR code.

    Whoever opens it first is in, for twelve hours; it is good for five minutes. Run it on the
    server's own computer; the token is FOOTTILE_TOKEN, or the one that the server keeps.
    """
    import foottile
    from service.api.address import known_token

    with foottile.connect(server or SERVER, known_token(data_folder(data))) as source:
        ticket = source.ticket(may="look" if viewer else "press")
    if as_json:
        print_json(ticket)
    else:
        say_ticket(ticket["urls"], viewer=viewer)
