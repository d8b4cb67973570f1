"""`foottile ticket`: lets somebody in who has no token."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from devices.errors import UsageError, needs_extra
from service.cli.commands.sessions import SERVER, ServerOption
from service.cli.options import CaOption, JsonOption, print_json
from service.cli.tickets import say_ticket


@needs_extra("server", "`foottile ticket`")
def ticket_command(
    viewer: Annotated[bool, typer.Option("--viewer", help="One that may look, not press.")] = False,
    server: ServerOption = None,
    ca: CaOption = None,
    data: Annotated[
        Path | None, typer.Option(help="Take the token from this data folder of the server.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Give a ticket for the live page: an address, and on a terminal its QR code.

    Whoever opens it first is in, for twelve hours; it is good for five minutes. Run it on the
    server's own computer. The token is the one in the folder of --data, else FOOTTILE_TOKEN, else
    that of a server which this user runs.
    """
    import foottile

    with foottile.connect(server or SERVER, _token_in(data), ca=ca) as source:
        ticket = source.ticket(may="look" if viewer else "press")
    if as_json:
        print_json(ticket)
    else:
        say_ticket(ticket["urls"], viewer=viewer)


def _token_in(data: Path | None) -> str | None:
    from service.api.address import KEPT_IN, kept_token

    try:
        return None if data is None else kept_token(data)
    except FileNotFoundError as error:
        raise UsageError(
            f"no token in the data folder {str(data)!r}",
            expected=f"a file `{KEPT_IN}`, which a server makes unless FOOTTILE_TOKEN is set",
            remedy="Name the folder of --data of `foottile serve`, or set FOOTTILE_TOKEN",
        ) from error
