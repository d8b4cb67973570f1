"""`foottile find`: servers and nodes in the local network."""

from __future__ import annotations

import asyncio
from dataclasses import asdict

import typer

from devices.errors import require_extra
from service.cli.options import JsonOption, echo, print_json, remark, show_progress

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
    servers = [{**asdict(each), "urls": each.urls} for each in found[SERVERS]]
    nodes = [asdict(each) for each in found[NODES]]
    if as_json:
        print_json({"servers": servers, "nodes": nodes})
    else:
        for each in [*servers, *nodes]:
            name = each["host"] if "urls" in each else f"node {each['name']}"
            where = " ".join(each.get("urls") or each["addresses"])
            echo(f"{name}: {where} ({', '.join(each['texts'].get(k, '') for k in _SHOWN)})")
    if not (servers or nodes):
        remark("no server and no node announces itself in this network")
        raise typer.Exit(1)


_SHOWN = ("machine", "version")
