"""`foottile demo`: a server with an emulated node, without hardware."""

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
from service.cli.commands.node import find_scene_calibration
from service.cli.commands.serve import print_addresses
from service.cli.options import (
    SECONDS_MAX,
    FootOptions,
    add_foot_options,
    check_emulated,
    create_stop_event,
    load_adapted_scene,
    remark,
    resolve_data_folder,
)
from service.cli.tickets import AdvertiseOption, get_host, remark_unreachable

if TYPE_CHECKING:
    import socket

    from service.api.logins import Logins
    from service.server.server import Server

NODE = "demo"
_SEAL_TIMEOUT_S = 20.0
_STOP_TIMEOUT_S = 8.0


@require_extra("server", "`foottile demo`")
@add_foot_options
def demo_command(
    options: FootOptions,
    scene: Annotated[str, typer.Option(help="Built-in scene, or a scene file.")] = "rolling",
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0: any.")] = 8000,
    advertise: AdvertiseOption = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder for sessions; default: the user's demo folder.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.0, max=SECONDS_MAX, help="Run time; default: until Ctrl-C."),
    ] = None,
) -> None:
    """Run a server and an emulated node, and print a link to the live page.

    The scene never ends; a recorded load repeats. Ctrl-C stops and seals running recordings, and
    ends both.
    """
    import uvloop

    from service.api.connection_limits import raise_open_files_limit
    from service.rig.emulated_foot import RigOptions

    raise_open_files_limit()
    the_scene = load_adapted_scene(scene, bus=None, servo=None)
    check_emulated(the_scene)
    # Fills the cache for the node.
    find_scene_calibration(RigOptions(the_scene, NODE, options.make_foot(the_scene)))
    arguments = [f"--scene={scene}", *options.to_arguments()]
    folder = resolve_data_folder(data)
    if data is None:
        folder /= "demo"
    arguments.append(f"--journal={folder / 'node'}")
    uvloop.run(_run_demo(host, port, advertise, folder, seconds, arguments))


async def _run_demo(
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
    from storage.permissions import set_umask_and_create_private_folder

    stop = create_stop_event()
    set_umask_and_create_private_folder(data)
    with open_listening_socket(host, port) as listening, ExitStack() as stack:
        given_token = read_token()
        token = load_or_create_token(given_token, data)
        stack.enter_context(publish_token(listening, token))
        logins = Logins(token)
        find_urls = partial(list_urls, listening, host, advertise)
        urls = find_urls()
        # First: the node finds and measures its tiles while the server starts.
        node = await _start_node(urls[-1], token, node_arguments)
        try:
            async with _run_server(listening, data, logins, find_urls) as server:
                print_addresses(urls, data, logins, is_stored=not given_token, is_demo=True)
                remark_unreachable(urls, host)
                remark(f"list recordings: foottile sessions --server {urls[-1]}")
                ended = asyncio.create_task(node.wait())
                stopped = asyncio.create_task(stop.wait())
                done, _ = await asyncio.wait(
                    {ended, stopped}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED
                )
                stopped.cancel()
                if ended in done:
                    raise FootTileError(
                        f"the node ended with code {node.returncode}",
                        remedy="See its output above",
                    )
                await _stop_recording(server)
                await _stop_node(node)  # before its server, else it would try to reconnect
                if not stop.is_set():
                    remark(f"ended after {seconds:g} s; data in {data}")
        finally:
            await _stop_node(node)


@asynccontextmanager
async def _run_server(
    listening: socket.socket, data: Path, logins: Logins, find_urls: Callable[[], list[str]]
) -> AsyncIterator[Server]:
    """Run a server while the block runs."""
    from devices.realtime import freeze_garbage_collector
    from service.api.address import list_own_names
    from service.api.app import make_app
    from service.api.runner import serve_app
    from service.server.server import Server

    server = Server(data)
    hosts = (*list_own_names(), get_host(find_urls()[0]))
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
        start_new_session=True,  # Ctrl-C reaches this process, which stops the recording first
    )


async def _stop_recording(server: Server) -> None:
    for session in server.recorder.list_recording(NODE):
        server.recorder.stop_session(session.id)
        sealed = await server.sealer.wait_until_sealed_or_timeout(session.id, _SEAL_TIMEOUT_S)
        remark(f"session {sealed.id} ({sealed.name}) is {sealed.state}")


async def _stop_node(node: asyncio.subprocess.Process) -> None:
    """Stop the node, if it still runs."""
    if node.returncode is not None:
        return
    with suppress(ProcessLookupError):
        node.terminate()
    try:
        await asyncio.wait_for(node.wait(), _STOP_TIMEOUT_S)
    except TimeoutError:
        with suppress(ProcessLookupError):
            node.kill()
        await node.wait()
