"""`foottile invite`: one-time login links."""

from __future__ import annotations

from typing import Annotated

import typer

from devices.errors import require_extra
from service.cli.commands.sessions import SERVER, ServerOption
from service.cli.options import CaOption, JsonOption, print_json
from service.cli.tickets import TokenFolderOption, print_ticket, read_data_token


@require_extra("server", "`foottile invite`")
def invite_command(
    read_only: Annotated[
        bool, typer.Option("--read-only", help="May look; may not tare or record.")
    ] = False,
    server: ServerOption = None,
    ca: CaOption = None,
    data: TokenFolderOption = None,
    as_json: JsonOption = False,
) -> None:
    """Create a one-time login link, and on a terminal its QR code.

    The first browser that opens it within five minutes is logged in for twelve hours. Run it on the
    server's computer. The token comes from the folder of --data, else from FOOTTILE_TOKEN, else
    from a server of this user.
    """
    import foottile

    with foottile.connect(server or SERVER, read_data_token(data), ca=ca) as source:
        ticket = source.create_invite(role="viewer" if read_only else "operator")
    if as_json:
        print_json(ticket)
    else:
        print_ticket(ticket["urls"], viewer=read_only)
