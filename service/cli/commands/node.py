"""`foottile node`: acquisition on a robot."""

from __future__ import annotations

import asyncio
import os
import re
import socket
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click
import typer

from devices.errors import StorageError, UsageError
from devices.types import check_user_name
from service.cli.options import (
    EXIT_INCOMPLETE,
    BusOption,
    CaOption,
    ChipOption,
    FootOptions,
    ServoOption,
    add_options,
    create_stop_event,
    echo,
    format_not_sampled,
    load_adapted_scene,
    remark,
)
from service.discovery import SERVERS
from service.node.server_finder import LOCAL_URL
from service.version import SOFTWARE_VERSION

if TYPE_CHECKING:
    from service.node.running_node import NodeOptions, NodeOutcome

_SEARCH_S = 1.5
"""Duration of the search for servers before a person is asked; answers take a fifth of a second."""


@add_options
def node_command(
    scene: Annotated[str, typer.Option(help="Scene file, or a built-in scene.")],
    server: Annotated[
        str | None,
        typer.Option(
            help="Address of the server; default: one on this machine, else one found in the "
            "network; with --record: none."
        ),
    ] = None,
    bus: BusOption = None,
    servo: ServoOption = None,
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
    A server found in the network may be started later, and elsewhere; `foottile find` lists all.
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
    searches = server is None and record is None
    if server is not None:
        make_ingest_url(server)  # refuse a wrong address before anything else
    if ca is not None:
        if not searches and not (server or "").startswith(("https:", "wss:")):
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
    chosen_id = _ask_for_server(folder / "journal" / rig.node_name, ca) if searches else None
    outcome = asyncio.run(
        _run_node(
            NodeOptions(
                rig_options=rig,
                node_folder=folder,
                server_url=LOCAL_URL if searches else server,
                session_name=record,
                calibration=calibration,
                calibration_problem=problem,
                token=read_token(),
                ca_path=ca,
            ),
            chosen_id,
        )
    )
    if outcome.recorded_session_id is not None:
        echo(
            f"session {outcome.recorded_session_id}"
            + (" is lossy" if outcome.is_lossy else " is complete")
            + format_not_sampled(outcome.not_sampled_share)
        )
    if outcome.lost_frames:
        remark(f"{outcome.lost_frames} frames of sessions are lost")
    if outcome.undelivered_frames:
        remark(
            f"{outcome.undelivered_frames} frames wait on this disk: the server gets them when "
            "this node runs again"
        )
    if outcome.lost_frames or outcome.undelivered_frames or outcome.is_lossy:
        raise typer.Exit(EXIT_INCOMPLETE)


async def _run_node(options: NodeOptions, chosen_id: str | None) -> NodeOutcome:
    """Run a node that other machines can find.

    Args:
        options: options of the node.
        chosen_id: id of a chosen server, empty: any; None: it looks for no server.
    """
    from devices.realtime import freeze_garbage_collector
    from service.discovery import NODES, Announcement, Discovery, list_interface_addresses
    from service.node.running_node import run_node
    from service.node.server_finder import ServerFinder
    from service.systemd import report_to_systemd

    freeze_garbage_collector()
    stop = create_stop_event()
    name = options.rig_options.node_name
    host = f"foottile-node-{re.sub(r'[^A-Za-z0-9]', '-', name)}"
    texts = {"machine": socket.gethostname(), "version": SOFTWARE_VERSION}
    announced = Announcement(NODES, name, host, 0, texts, list_interface_addresses)
    browsed = (SERVERS,) if chosen_id is not None else ()
    discovery = Discovery(browsed, announced, report=remark)
    async with report_to_systemd(stop), discovery:
        if chosen_id is not None:
            finder = ServerFinder(discovery, remark, chosen_id=chosen_id, ca_path=options.ca_path)
            options = replace(options, find_server=finder.find)
        return await run_node(options, stop=stop, report=remark)


def _ask_for_server(folder: Path, ca: Path | None) -> str:
    """Return the id of a server that a person chooses on a terminal; empty: there is no choice."""
    from foottile.local_server import find_local_server
    from service.discovery import search_once
    from service.node.server_finder import describe_candidates, list_candidates
    from service.node.server_secrets import ServerSecrets

    if not sys.stdin.isatty() or find_local_server(LOCAL_URL) is not None:
        return ""
    found = asyncio.run(search_once((SERVERS,), _SEARCH_S, lambda _: None))[SERVERS]
    known_ids = ServerSecrets(folder, remark).list_server_ids()
    candidates = list_candidates(found, known_ids, needs_tls=ca is not None)
    if len(candidates) < 2:  # nothing to choose
        return ""
    for number, line in enumerate(describe_candidates(candidates), 1):
        remark(f"{number}: {line}")
    chosen: int = typer.prompt("server", type=click.IntRange(1, len(candidates)), err=True)
    return candidates[chosen - 1].server_id


def _choose_name(name: str | None) -> str:
    name = name if name is not None else re.sub(r"[^A-Za-z0-9._-]", "-", socket.gethostname())
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,63}", name):
        raise UsageError(
            f"--name {name!r}", expected="1 to 64 letters, digits, '.', '_' or '-', no '.' first"
        )
    return name
