"""`foottile demo`: a server and an emulated node, to try everything without hardware."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import FootTileError, require_extra
from service.cli.commands.node import calibration_of
from service.cli.commands.serve import announce
from service.cli.options import (
    SECONDS_MAX,
    FootOptions,
    check_emulated,
    data_folder,
    remark,
    scene_with,
    stop_on_signals,
    with_foot_options,
)
from service.cli.tickets import AdvertiseOption, host_of, remark_reach

if TYPE_CHECKING:
    import socket

    from service.api.logins import Logins
    from service.server.server import Server

NODE = "demo"
_SEAL_S = 20.0
_END_S = 8.0


@require_extra("server", "`foottile demo`")
@with_foot_options
def demo_command(
    options: FootOptions,
    scene: Annotated[str, typer.Option(help="Built-in scene, or a scene file.")] = "rolling",
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0: any.")] = 8000,
    advertise: AdvertiseOption = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder for sessions; default: one for demos.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.0, max=SECONDS_MAX, help="End after so long; default: at Ctrl-C."),
    ] = None,
) -> None:
    """Run a server and an emulated node, and print a link to the live page.

    The scene never ends; a recorded load is pressed over and over again. Ctrl-C stops what is
    being recorded, seals it, and ends both.
    """
    import uvloop

    from service.api.connection_limits import raise_open_files_limit
    from service.rig.options import RigOptions

    raise_open_files_limit()
    the_scene = scene_with(scene, bus=None, servo=None)
    check_emulated(the_scene)
    # The node finds it in the cache.
    calibration_of(RigOptions(the_scene, NODE, options.foot(the_scene)))
    arguments = [f"--scene={scene}", *options.as_arguments()]
    folder = data_folder(data)
    if data is None:
        folder /= "demo"
    arguments.append(f"--journal={folder / 'node'}")
    uvloop.run(_demo(host, port, advertise, folder, seconds, arguments))


async def _demo(
    host: str,
    port: int,
    advertise: str | None,
    data: Path,
    seconds: float | None,
    node_arguments: list[str],
) -> None:
    from foottile.environment import read_token
    from service.api.address import (
        list_urls,
        load_or_create_token,
        open_listening_socket,
        publish_token,
    )
    from service.api.logins import Logins
    from storage.permissions import restrict_to_owner

    stop = stop_on_signals()
    restrict_to_owner(data)
    with open_listening_socket(host, port) as listening, ExitStack() as stack:
        given = read_token()
        token = load_or_create_token(given, data)
        stack.enter_context(publish_token(listening, token))
        logins = Logins(token)
        find_urls = partial(list_urls, listening, host, advertise)
        urls = find_urls()
        # First: while the server is imported and prepared, the tiles are found and measured.
        node = await _start_node(urls[-1], token, node_arguments)
        try:
            async with _server(listening, data, logins, find_urls) as server:
                announce(urls, data, logins, is_kept=not given, is_demo=True)
                remark_reach(urls, host)
                remark(f"what was recorded: foottile sessions --server {urls[-1]}")
                ended = asyncio.create_task(node.wait())
                stopped = asyncio.create_task(stop.wait())
                done, _ = await asyncio.wait(
                    {ended, stopped}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED
                )
                stopped.cancel()
                if ended in done:
                    raise FootTileError(
                        f"the node ended with code {node.returncode}",
                        remedy="What it said stands above",
                    )
                await _stop_recording(server)
                await _end(node)  # before its server, which it would miss
                if not stop.is_set():
                    remark(f"ended after {seconds:g} s; data in {data}")
        finally:
            await _end(node)


@asynccontextmanager
async def _server(
    listening: socket.socket, data: Path, logins: Logins, find_urls: Callable[[], list[str]]
) -> AsyncIterator[Server]:
    """A server that answers, while the block runs."""
    from devices.realtime import freeze_garbage_collector
    from service.api.address import list_own_names
    from service.api.app import make_app
    from service.api.runner import serve_app
    from service.server.server import Server

    server = Server(data)
    hosts = (*list_own_names(), host_of(find_urls()[0]))
    app = make_app(server, hosts=hosts, logins=logins, find_urls=find_urls)
    async with serve_app(app, listening):
        freeze_garbage_collector()
        yield server


async def _start_node(url: str, token: str, arguments: list[str]) -> asyncio.subprocess.Process:
    code = "from service.cli.main import main; main()"
    environment = {**os.environ, "FOOTTILE_TOKEN": token}
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", code, "node", f"--server={url}", f"--name={NODE}"),
        "--end-with-parent",
        *arguments,
        env=environment,
        stdin=asyncio.subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for us, who end it when the recording is stopped
    )


async def _stop_recording(server: Server) -> None:
    for session in server.recorder.list_recording(NODE):
        server.recorder.stop_session(session.id)
        sealed = await server.sealer.wait_until_sealed(session.id, _SEAL_S)
        remark(f"session {sealed.id} ({sealed.name}) is {sealed.state}")


async def _end(node: asyncio.subprocess.Process) -> None:
    """End the node, if it has not ended."""
    if node.returncode is not None:
        return
    with suppress(ProcessLookupError):
        node.terminate()
    try:
        await asyncio.wait_for(node.wait(), _END_S)
    except TimeoutError:
        with suppress(ProcessLookupError):
            node.kill()
        await node.wait()
