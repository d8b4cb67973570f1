"""`foottile accept-node`: accepts another machine under the name of a node."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import quote

import typer

from devices.errors import StateError, require_extra
from service.cli.commands.sessions import SERVER, ServerOption
from service.cli.options import CaOption, say
from service.cli.tickets import TokenFolderOption, read_data_token


@require_extra("server", "`foottile accept-node`")
def accept_node_command(
    node: Annotated[str, typer.Argument(help="Name of the node.")],
    fingerprint: Annotated[
        str | None,
        typer.Option(help="Only the machine with this one; default: the one that asked last."),
    ] = None,
    server: ServerOption = None,
    ca: CaOption = None,
    data: TokenFolderOption = None,
) -> None:
    """Accept another machine under the name of a node.

    A server refuses a machine that lacks the node's secret, as after its storage was replaced. Once
    accepted, the machine is the node; the one before is disconnected and refused. Compare the
    fingerprint with the one that the machine prints. Run it on the server's own computer.
    """
    import foottile

    path = f"/nodes/{quote(node, safe='')}"
    with foottile.connect(server or SERVER, read_data_token(data), ca=ca) as source:
        asking = source.http.get(path)["replacement"]
        if asking is None:
            raise StateError(
                f"no other machine asks to connect as {node!r}",
                remedy="Start it; it asks again by itself every few seconds",
            )
        chosen = fingerprint or asking["fingerprint"]
        source.http.send("POST", f"{path}/accept-replacement", {"fingerprint": chosen})
    say(f"{node} is the machine {chosen} from now on")
