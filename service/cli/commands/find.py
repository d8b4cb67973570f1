"""`foottile find`: servers and nodes in the local network."""

from __future__ import annotations

import asyncio
from dataclasses import asdict

import typer
from rich.table import Table

from devices.errors import escape_control_chars, require_extra
from service.cli.options import JsonOption, print_json, remark, show_progress, stdout

_SEARCH_S = 2.0


@require_extra("discovery", "`foottile find`")
def find_command(as_json: JsonOption = False) -> None:
    """List servers and nodes in the local network, with their addresses.

    It takes 3 s. A server on loopback alone, and one behind a router, are not found.

    Exit code 1: none is found.
    """
    import zeroconf  # noqa: F401  # the error names its extra

    from service.discovery import NODES, SERVERS, search_once

    with show_progress("looking for servers and nodes"):
        found = asyncio.run(search_once((SERVERS, NODES), _SEARCH_S, remark))
    servers, nodes = found[SERVERS], found[NODES]
    if as_json:
        print_json(
            {
                "servers": [{**asdict(each), "urls": each.urls} for each in servers],
                "nodes": [asdict(each) for each in nodes],
            }
        )
    elif servers or nodes:
        table = Table(box=None, pad_edge=False)
        for title in ("kind", "name", "addresses", "machine", "version"):
            table.add_column(title)
        for kind, services in (("server", servers), ("node", nodes)):
            for each in services:
                cells = (
                    *(kind, each.host if kind == "server" else each.name),
                    " ".join(each.urls if kind == "server" else each.addresses),
                    *(each.texts.get("machine", ""), each.texts.get("version", "")),
                )
                table.add_row(*map(escape_control_chars, cells))
        stdout.print(table, markup=False)
    else:
        remark("no server and no node announces itself in this network")
    if not (servers or nodes):
        raise typer.Exit(1)
