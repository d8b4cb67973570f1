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

KINDS = ("foxglove", "lsl", "mqtt")
LOOPBACK = "127.0.0.1"
FOXGLOVE_PORT = 8765


def bridge_command(
    kind: Annotated[str, typer.Argument(help=f"{', '.join(KINDS)}.")],
    broker: Annotated[
        str | None, typer.Argument(help="mqtt: mqtt://[USER:PASSWORD@]HOST[:PORT], or mqtts://.")
    ] = None,
    node: Annotated[
        list[str] | None, typer.Option(help="Name of a node (repeat for several); default: all.")
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = LOOPBACK,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="foxglove: port to listen on.")
    ] = FOXGLOVE_PORT,
    rate: Annotated[float, typer.Option(min=1.0, max=60.0, help="mqtt: summaries a second.")] = 1.0,
    public: Annotated[
        bool, typer.Option("--public", help="Also republish a private server.")
    ] = False,
    server: ServerOption = None,
    ca: CaOption = None,
) -> None:
    """Republish live frames and markers for another program, until Ctrl-C.

    foxglove: a websocket for Foxglove. lsl: outlets of the Lab Streaming Layer. mqtt:
    summaries, states and events as JSON; user and password may be in FOOTTILE_MQTT_USER and
    FOOTTILE_MQTT_PASSWORD.
    """
    from foottile import connect
    from service.bridges.follower import Reporter, ServerFollower
    from service.protocol.codec import run_until_first_ends

    if kind not in KINDS:
        raise UsageError(f"bridge {kind!r}", expected=f"one of {', '.join(KINDS)}")
    if (kind == "mqtt") != (broker is not None):
        expected = "the address of a broker behind `mqtt`, and behind no other kind"
        raise UsageError(f"bridge {kind}", expected=expected)

    def open_outlet(reporter: Reporter) -> Outlet:
        if broker is not None:
            from service.bridges.mqtt import MqttOutlet

            return MqttOutlet(broker, rate, reporter, f"{source.url} {sorted(node or ())}", ca)
        if kind == "lsl":
            from service.bridges.lsl import LslOutlet, limit_to_this_machine

            if host == LOOPBACK:
                limit_to_this_machine()
            remark(f"LSL: found {'on this machine' if host == LOOPBACK else 'in the network'}")
            return LslOutlet(reporter)
        from service.bridges.foxglove import FoxgloveOutlet

        outlet = FoxgloveOutlet(host, port)
        remark(f"Foxglove: open connection {outlet.url}")
        return outlet

    async def run() -> None:
        stop, reporter = create_stop_event(), Reporter(remark)
        outlet = open_outlet(reporter)
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
