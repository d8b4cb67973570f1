"""`foottile invite` and `foottile accept-node`: login links, and nodes on another machine."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import quote

import typer

from devices.errors import StateError, require_extra
from service.cli.commands.sessions import SERVER, ServerOption
from service.cli.options import CaOption, JsonOption, echo, print_json
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


@require_extra("server", "`foottile accept-node`")
def accept_node_command(
    node: Annotated[str, typer.Argument(help="Name of the node.")],
    fingerprint: Annotated[
        str | None,
        typer.Option(help="Fingerprint of the machine; default: the last one that connected."),
    ] = None,
    server: ServerOption = None,
    ca: CaOption = None,
    data: TokenFolderOption = None,
) -> None:
    """Accept another machine under the name of a node.

    A server rejects a machine without the node's secret, for example after a change of its storage.
    The accepted machine becomes the node; the previous one is disconnected and rejected. Compare
    the fingerprint with the machine's output first. Run this on the server's computer.
    """
    import foottile

    path = f"/nodes/{quote(node, safe='')}"
    with foottile.connect(server or SERVER, read_data_token(data), ca=ca) as source:
        replacement = source.http.get(path)["replacement"]
        if replacement is None:
            raise StateError(
                f"no other machine asks to connect as {node!r}",
                remedy="Start the machine; it retries every few seconds",
            )
        accepted = fingerprint or replacement["fingerprint"]
        source.http.send("POST", f"{path}/accept-replacement", {"fingerprint": accepted})
    echo(f"{node} is now the machine {accepted}")
