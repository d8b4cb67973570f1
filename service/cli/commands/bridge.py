"""`foottile bridge`: live outlets for other programs."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import UsageError, require_extra
from service.cli.commands.sessions import SERVER, ServerOption
from service.cli.options import CaOption, create_stop_event, remark

if TYPE_CHECKING:
    from service.bridges.follower import Outlet, Reporter

KINDS = ("foxglove", "lsl")
LOOPBACK = "127.0.0.1"
FOXGLOVE_PORT = 8765


def bridge_command(
    kind: Annotated[str, typer.Argument(help=f"{', '.join(KINDS)}.")],
    node: Annotated[
        list[str] | None, typer.Option(help="Name of a node (repeat for several); default: all.")
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = LOOPBACK,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="foxglove: port to listen on.")
    ] = FOXGLOVE_PORT,
    public: Annotated[
        bool, typer.Option("--public", help="Also republish a private server.")
    ] = False,
    server: ServerOption = None,
    ca: CaOption = None,
) -> None:
    """Republish live frames and markers for another program, until Ctrl-C.

    foxglove: a websocket for Foxglove. lsl: outlets of the Lab Streaming Layer.
    """
    from foottile import connect
    from service.bridges.follower import Reporter, ServerFollower
    from service.protocol.codec import run_until_first_ends

    if kind not in KINDS:
        raise UsageError(f"bridge {kind!r}", expected=f"one of {', '.join(KINDS)}")

    async def run() -> None:
        stop, reporter = create_stop_event(), Reporter(remark)
        outlet = open_outlet(kind, host, port, reporter)
        try:
            follower = ServerFollower(source, outlet, reporter, node or (), is_public=public)
            await run_until_first_ends(follower.run(), outlet.run(), stop.wait())
        finally:
            outlet.close()

    with (
        require_extra("bridges", f"`foottile bridge {kind}`"),
        connect(server or SERVER, ca=ca) as source,
    ):
        asyncio.run(run())


def open_outlet(kind: str, host: str, port: int, reporter: Reporter) -> Outlet:
    """Open the outlet of a kind, and print where it is.

    Raises:
        UsageError: the address cannot be listened on.
    """
    if kind == "lsl":
        from service.bridges.lsl import LslOutlet, limit_to_this_machine

        if host == LOOPBACK:
            limit_to_this_machine()
        remark(f"LSL: found {'on this machine' if host == LOOPBACK else 'in the network'}")
        return LslOutlet(reporter)

    from service.bridges.foxglove import FoxgloveOutlet

    try:
        outlet = FoxgloveOutlet(host, port)
    except RuntimeError as error:
        raise UsageError(
            f"cannot listen on {host}:{port}: {error}", remedy="Name another --host or --port"
        ) from error
    remark(f"Foxglove: open connection {outlet.url}")
    return outlet
