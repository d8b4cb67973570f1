"""`foottile node`: acquisition on a robot."""

from __future__ import annotations

import asyncio
import os
import re
import socket
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import StorageError, UsageError
from devices.types import check_user_name
from service.cli.options import (
    CaOption,
    ChipOption,
    FootOptions,
    add_options,
    create_stop_event,
    echo,
    load_adapted_scene,
    remark,
)

if TYPE_CHECKING:
    from service.node.running_node import NodeOptions, NodeOutcome

SERVER = "http://127.0.0.1:8000"


@add_options
def node_command(
    scene: Annotated[str, typer.Option(help="Scene file, or a built-in scene.")],
    server: Annotated[
        str | None,
        typer.Option(help=f"Address of the server; default {SERVER}, with --record: none."),
    ] = None,
    bus: Annotated[
        str | None,
        typer.Option(help="I2C bus: /dev/i2c-1, usb:1c40:0534 or emulated; default: the scene's."),
    ] = None,
    servo: Annotated[
        str | None,
        typer.Option(help="Serial port, emulated, or none; default: the scene's."),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of this node; default: this machine's.")
    ] = None,
    journal: Annotated[
        Path | None,
        typer.Option(help="Folder for the journal and for local sessions."),
    ] = None,
    record: Annotated[
        str | None,
        typer.Option(help="Record a local session of this name, without a server."),
    ] = None,
    ca: CaOption = None,
    chip: ChipOption = None,
    end_with_parent: Annotated[
        bool, typer.Option("--end-with-parent", hidden=True, help="End with the parent process.")
    ] = False,
    *,
    options: FootOptions,
) -> None:
    """Read an array, keep its frames on disk and send them to a server.

    Every frame is journaled. Frames of sessions stay until the server has stored them, others for
    ten minutes. It reconnects by itself: frames follow after an interrupted link or a restart.
    With --record it needs no server: at Ctrl-C the session is sealed in the folder of --journal.
    The server's token is FOOTTILE_TOKEN, or that of a server of this user on this machine. Options
    from --load on are for emulated tiles.

    Exit code 3: frames of a session are lost, or still wait on this disk for their server.
    """
    from foottile.connection import make_context
    from foottile.environment import read_token
    from service.node.running_node import NodeOptions
    from service.node.server_connection import make_ingest_url
    from service.offline.calibration_lookup import find_scene_calibration
    from service.rig.emulated_foot import RigOptions
    from service.user_folders import resolve_user_folder
    from storage.permissions import set_umask_and_create_private_folder

    if end_with_parent:
        from devices import realtime

        realtime.terminate_with_parent()
    if server is None and record is None:
        server = SERVER
    if server is not None:
        make_ingest_url(server)  # refuse a wrong address before anything else
    if ca is not None:
        if server is None or not server.startswith(("https:", "wss:")):
            raise UsageError("--ca is for a --server with https://")
        make_context(ca)  # and what is no certificate
    folder = resolve_user_folder("state", journal, "--journal")
    if os.path.lexists(folder) and not folder.is_dir():
        raise UsageError(f"--journal {str(folder)!r} is no folder", remedy="Choose another one")
    if record is not None and not record.strip():
        raise UsageError("--record without a name", expected="the name of the session")
    if record is not None:
        try:
            check_user_name(record)
        except ValueError as error:
            raise UsageError(f"--record {record!r} {error}", expected="one line of text") from error
    the_scene = load_adapted_scene(scene, bus=bus, servo=servo, chip=chip)
    rig = RigOptions(the_scene, _choose_name(name), options.make_foot(the_scene))
    calibration, problem = find_scene_calibration(rig, remark)
    with suppress(StorageError):  # an unwritable card is reported later
        set_umask_and_create_private_folder(folder)
    outcome = asyncio.run(
        _run_node(
            NodeOptions(
                rig_options=rig,
                node_folder=folder,
                server_url=server,
                session_name=record,
                calibration=calibration,
                calibration_problem=problem,
                token=read_token(),
                ca_path=ca,
            )
        )
    )
    if outcome.recorded_session_id is not None:
        echo(
            f"session {outcome.recorded_session_id}"
            + (" is lossy" if outcome.is_lossy else " is complete")
        )
    if outcome.lost_frames:
        remark(f"{outcome.lost_frames} frames of sessions are lost")
    if outcome.undelivered_frames:
        remark(
            f"{outcome.undelivered_frames} frames wait on this disk: the server gets them when "
            "this node runs again"
        )
    if outcome.lost_frames or outcome.undelivered_frames or outcome.is_lossy:
        raise typer.Exit(3)


async def _run_node(options: NodeOptions) -> NodeOutcome:
    from devices.realtime import freeze_garbage_collector
    from service.node.running_node import run_node
    from service.systemd import report_to_systemd

    freeze_garbage_collector()
    stop = create_stop_event()
    async with report_to_systemd(stop):
        return await run_node(options, stop=stop, report=remark)


def _choose_name(name: str | None) -> str:
    name = name if name is not None else re.sub(r"[^A-Za-z0-9._-]", "-", socket.gethostname())
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,63}", name):
        raise UsageError(
            f"--name {name!r}", expected="1 to 64 letters, digits, '.', '_' or '-', no '.' first"
        )
    return name
