"""Commands of a server: `foottile serve`, `demo`, and `invite` and `accept-node` for access."""

from __future__ import annotations

import asyncio
import inspect
import os
import shlex
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from functools import partial
from pathlib import Path
from socket import gethostname
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_origin
from urllib.parse import quote

import typer

from devices.errors import FootTileError, StateError, require_extra
from foottile.local_server import is_loopback
from service.api.connection_limits import raise_open_files_limit
from service.api.settings import LimitSettings, Settings, load_settings
from service.cli.commands.sessions import SERVER, ServerOption
from service.cli.options import (
    SECONDS_MAX,
    CaOption,
    ChipOption,
    FootOptions,
    JsonOption,
    add_options,
    check_emulated,
    create_stop_event,
    echo,
    expand_options,
    load_adapted_scene,
    print_json,
    remark,
    resolve_data_folder,
)
from service.cli.tickets import (
    AdvertiseOption,
    TokenFolderOption,
    get_host,
    is_reachable,
    print_ticket,
    read_data_token,
    remark_unreachable,
    show_login_code,
)
from service.version import SOFTWARE_VERSION

if TYPE_CHECKING:
    import socket

    from service.api.access import Logins
    from service.cli.server_tls import ServerTls
    from service.discovery import Discovery
    from service.server.server import Server


def _add_setting_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter `options` of a command by an option for each setting.

    The token is none: a list of processes would show it.
    """
    parameters = []
    limits = LimitSettings.model_fields
    for name, field in sorted(Settings.model_fields.items(), key=lambda item: item[0] in limits):
        if name == "token":
            continue  # a list of processes would show it
        kind: Any = field.annotation if field.annotation in (bool, int, float, Path) else str
        if get_origin(field.annotation) is tuple:
            kind = list[str]
        default = None if field.default_factory else field.default
        help_text = f"{field.description}{f' Default: {default}.' if default else ''}"
        option = typer.Option(f"--{name.replace('_', '-')}", help=help_text)
        parameters.append(
            inspect.Parameter(
                *(name, inspect.Parameter.KEYWORD_ONLY),
                default=None,
                annotation=Annotated[kind | None, option],
            )
        )
    # A list that is not given may be empty.
    return expand_options(
        command, "options", parameters, lambda **given: {k: v for k, v in given.items() if v != []}
    )


@require_extra("server", "`foottile serve`")
@_add_setting_options
def serve_command(
    config: Annotated[Path | None, typer.Option(help="TOML file with settings.")] = None,
    *,
    options: dict[str, Any],
) -> None:
    """Run the server: live view, recording, REST API.

    Settings come from options, else from variables like FOOTTILE_HOST, else from --config. Changes
    need a token: FOOTTILE_TOKEN, or a generated one in the data folder. On a terminal it prints a
    login link; `foottile invite` creates others. Commands of this user on this machine find the
    token by themselves. Ctrl-C ends it; running recordings continue at the next start.
    """
    import uvloop

    settings = load_settings(config, **options)
    raise_open_files_limit()
    uvloop.run(_run_server(settings))


async def _run_server(settings: Settings) -> None:
    from service.systemd import report_to_systemd

    stop = create_stop_event()
    with _listen(settings) as listening_server:
        async with _serve(settings, listening_server), report_to_systemd(stop):
            await stop.wait()


class _ListeningServer(NamedTuple):
    """Server that holds its data folder and socket, and does not answer yet."""

    server: Server
    listening: socket.socket
    logins: Logins
    find_urls: Callable[[], list[str]]
    tls: ServerTls | None


@contextmanager
def _listen(settings: Settings) -> Iterator[_ListeningServer]:
    """Listen, lock the data folder, and let programs of this user find its token there.

    The folder is locked first: a second server must not change the token of the first.
    """
    from service.api.access import Logins
    from service.api.address import (
        list_urls,
        load_or_create_token,
        open_listening_socket,
        publish_token,
    )
    from service.cli.server_tls import open_tls
    from service.server.server import Server
    from storage.permissions import set_umask_and_create_private_folder

    with open_listening_socket(settings.host, settings.port) as listening:
        set_umask_and_create_private_folder(settings.data)
        server = Server(settings.data, unquantized=settings.no_quantize)
        token = load_or_create_token(settings.token, settings.data)
        tls = open_tls(settings)
        scheme = "https" if tls is not None else "http"
        find_urls = partial(list_urls, listening, settings.host, settings.advertise, scheme=scheme)
        with publish_token(listening, token, None if tls is None else tls.ca_path):
            logins = Logins(token, is_private=settings.private)
            yield _ListeningServer(server, listening, logins, find_urls, tls)


@asynccontextmanager
async def _serve(
    settings: Settings, listening_server: _ListeningServer, *, is_demo: bool = False
) -> AsyncIterator[Server]:
    """Let a server answer while the block runs, and print its addresses."""
    from devices.realtime import freeze_garbage_collector
    from service.api.address import list_own_names
    from service.api.app import make_app, serve_app
    from service.cli.server_tls import hand_out_ca

    server, listening, logins, find_urls, tls = listening_server
    urls = find_urls()
    hosts = {*settings.allow_host, *list_own_names(), get_host(urls[0])}
    announced: list[str] = []

    def on_announced(host: str) -> None:
        hosts.add(host)
        scheme = "https" if tls is not None else "http"
        announced[:] = [f"{scheme}://{host}:{listening.getsockname()[1]}"]
        remark(f"it is also at {announced[0]}, for machines that resolve names by mDNS")

    def find_all_urls() -> list[str]:
        first, *others = find_urls()
        return [first, *announced, *others]

    app = make_app(server, logins=logins, hosts=hosts, find_urls=find_all_urls)
    context = tls.context if tls is not None else None
    async with serve_app(app, listening, settings, context), AsyncExitStack() as stack:
        freeze_garbage_collector()
        # First what a phone needs first: a login is good for some minutes only.
        await stack.enter_async_context(
            hand_out_ca(tls, settings, listening, lambda: [get_host(url) for url in announced])
        )
        is_stored = not settings.token
        print_addresses(urls, settings.data, logins, is_stored=is_stored, is_demo=is_demo)
        remark_unreachable(urls, settings.host)
        if not is_loopback(listening.getsockname()[0]):
            discovery = _make_discovery(listening_server, on_announced)
            await stack.enter_async_context(discovery)
        yield server


def _make_discovery(
    listening_server: _ListeningServer, on_announced: Callable[[str], None]
) -> Discovery:
    """Return the discovery that announces a server."""
    from service.api.address import list_announced_addresses
    from service.discovery import SERVER_HOST, SERVERS, Announcement, Discovery

    server, listening, *_, tls = listening_server
    texts = {"id": server.id, "tls": str(int(tls is not None))}
    texts |= {"version": SOFTWARE_VERSION, "machine": gethostname()}
    port, find_addresses = listening.getsockname()[1], partial(list_announced_addresses, listening)
    announcement = Announcement(SERVERS, SERVER_HOST, SERVER_HOST, port, texts, find_addresses)
    return Discovery(announcement=announcement, on_announced=on_announced, report=remark)


def print_addresses(
    urls: list[str], data: Path, logins: Logins, *, is_stored: bool, is_demo: bool = False
) -> None:
    """Print the address of the page, a login for phones, and the command of a node.

    The token is printed only on a terminal, as others may read a log. In a log a demo prints a
    ticket, which is good once and expires soon.

    Args:
        urls: addresses of the server.
        data: data folder.
        logins: token and tickets of the server.
        is_stored: whether the token is in the data folder.
        is_demo: print login links without a terminal, too.
    """
    from service.api.access import Role
    from service.api.address import TOKEN_NAME
    from service.api.routes.login import add_ticket
    from service.estimation.compilation import COMPILING_NOTE, is_compiling

    token, has_screen = logins.token, sys.stdout.isatty()
    for url in urls:
        if has_screen:
            link = f"{url}/#token={token}"
        else:
            link = add_ticket(url, logins.tickets.create(Role.OPERATOR)) if is_demo else f"{url}/"
        echo(f"FootTile is at {link}")
    if has_screen and is_reachable(urls[0]):
        show_login_code(add_ticket(urls[0], logins.tickets.create(Role.OPERATOR)))
    remark(f"data in {data}; Ctrl-C ends it")
    if is_compiling():
        remark(COMPILING_NOTE)
    where = f"$(cat {shlex.quote(str(data / TOKEN_NAME))})" if is_stored else '"$FOOTTILE_TOKEN"'
    if not has_screen:
        place = f"in {data / TOKEN_NAME}" if is_stored else "FOOTTILE_TOKEN"
        remark(f"its token is {place}; `foottile invite` prints a login link")
    token_text = token if sys.stderr.isatty() else where
    ca = " --ca FILE" if urls[0].startswith("https") else ""
    remark(f"a node: FOOTTILE_TOKEN={token_text} foottile node --scene FILE --server {urls[0]}{ca}")


NODE = "demo"
_SEAL_TIMEOUT_S = 20.0
_STOP_TIMEOUT_S = 8.0


@require_extra("server", "`foottile demo`")
@add_options
def demo_command(
    scene: Annotated[str, typer.Option(help="Built-in scene, or a scene file.")] = "rolling",
    chip: ChipOption = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0: any.")] = 8000,
    advertise: AdvertiseOption = None,
    tls: Annotated[bool, typer.Option("--tls", help="Serve https, as `serve --tls`.")] = False,
    data: Annotated[
        Path | None, typer.Option(help="Folder for sessions; default: the user's demo folder.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.0, max=SECONDS_MAX, help="Run time; default: until Ctrl-C."),
    ] = None,
    *,
    options: FootOptions,
) -> None:
    """Run a server and an emulated node, and print a link to the live page.

    The scene never ends; a recorded load repeats. Ctrl-C stops and seals running recordings, and
    ends both.
    """
    import uvloop

    from foottile.environment import read_token
    from service.offline.calibration_lookup import find_scene_calibration
    from service.rig.emulated_foot import RigOptions

    raise_open_files_limit()
    the_scene = load_adapted_scene(scene, bus=None, servo=None, chip=chip)
    check_emulated(the_scene)
    # Fills the cache for the node.
    find_scene_calibration(RigOptions(the_scene, NODE, options.make_foot(the_scene)), remark)
    arguments = [f"--scene={scene}", *options.to_arguments()]
    if chip is not None:
        arguments.append(f"--chip={chip}")
    folder = resolve_data_folder(data)
    if data is None:
        folder /= "demo"
    arguments.append(f"--journal={folder / 'node'}")
    settings = Settings(host=host, port=port, advertise=advertise, tls=tls, data=folder)
    settings = settings.model_copy(update={"token": read_token()})
    uvloop.run(_run_demo(settings, seconds, arguments))


async def _run_demo(settings: Settings, seconds: float | None, node_arguments: list[str]) -> None:
    stop = create_stop_event()
    with _listen(settings) as listening_server:
        url = listening_server.find_urls()[-1]
        # First: the node finds and measures its tiles while the server starts.
        node = await _start_node(url, listening_server.logins.token, node_arguments)
        try:
            async with _serve(settings, listening_server, is_demo=True) as server:
                remark(f"list recordings: foottile sessions --server {url}")
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
                    remark(f"ended after {seconds:g} s; data in {settings.data}")
        finally:
            await _stop_node(node)


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
        sealed = await server.recorder.wait_until_sealed_or_timeout(session.id, _SEAL_TIMEOUT_S)
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
