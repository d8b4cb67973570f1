"""`foottile serve`: server."""

from __future__ import annotations

import shlex
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.errors import require_extra
from service.cli.options import create_stop_event, echo, remark
from service.cli.tickets import (
    AdvertiseOption,
    get_host,
    is_reachable,
    remark_unreachable,
    show_qr_code,
)

if TYPE_CHECKING:
    from service.api.logins import Logins
    from service.api.settings import Settings


def _make_limit(text: str) -> Any:
    return typer.Option(help=text, rich_help_panel="Limits for unauthenticated clients")


@require_extra("server", "`foottile serve`")
def serve_command(
    host: Annotated[
        str | None, typer.Option(help="Address to listen on; default 127.0.0.1: this machine only.")
    ] = None,
    port: Annotated[int | None, typer.Option(help="TCP port; default 8000; 0: any.")] = None,
    data: Annotated[Path | None, typer.Option(help="Folder for sessions and journals.")] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file with settings.")] = None,
    allow_host: Annotated[
        list[str] | None,
        typer.Option(help="Further host name of the server (repeatable)."),
    ] = None,
    advertise: AdvertiseOption = None,
    private: Annotated[
        bool | None,
        typer.Option("--private", help="Require a login for reading; default: for changes only."),
    ] = None,
    no_quantize: Annotated[
        bool | None,
        typer.Option(
            "--no-quantize",
            help="Seal sessions with estimates as computed: do not round off their noise.",
        ),
    ] = None,
    trusted_proxy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ADDRESS",
            help="Reverse proxy with trusted X-Forwarded-For and X-Forwarded-Proto (repeatable); "
            "default: none.",
        ),
    ] = None,
    max_connections: Annotated[int | None, _make_limit("Open connections; 512.")] = None,
    max_connections_per_address: Annotated[
        int | None,
        _make_limit("Open connections per address; 256."),
    ] = None,
    max_nodes: Annotated[int | None, _make_limit("Connected nodes; 32.")] = None,
    max_header_bytes: Annotated[int | None, _make_limit("Headers of a request; 32768.")] = None,
    header_timeout_s: Annotated[float | None, _make_limit("Timeout of headers; 10.")] = None,
    body_timeout_s: Annotated[float | None, _make_limit("Timeout of a body; 20.")] = None,
    idle_timeout_s: Annotated[float | None, _make_limit("Timeout between requests; 30.")] = None,
) -> None:
    """Run the server: live view, recording, REST API.

    Settings come from options, else from variables like FOOTTILE_HOST, else from --config. Changes
    need a token: FOOTTILE_TOKEN, or a generated one in the data folder. On a terminal it prints a
    login link; `foottile invite` creates others. Commands of this user on this machine find the
    token by themselves. Ctrl-C ends it; running recordings continue at the next start.
    """
    import uvloop

    from service.api.connection_limits import raise_open_files_limit
    from service.api.settings import load_settings

    settings = load_settings(
        config,
        host=host,
        port=port,
        data=data,
        allow_host=tuple(allow_host or ()) or None,
        advertise=advertise,
        private=private,
        no_quantize=no_quantize,
        trusted_proxy=tuple(trusted_proxy or ()) or None,
        max_connections=max_connections,
        max_connections_per_address=max_connections_per_address,
        max_nodes=max_nodes,
        max_header_bytes=max_header_bytes,
        header_timeout_s=header_timeout_s,
        body_timeout_s=body_timeout_s,
        idle_timeout_s=idle_timeout_s,
    )
    raise_open_files_limit()
    uvloop.run(_run_server(settings))


async def _run_server(settings: Settings) -> None:
    from devices.realtime import freeze_garbage_collector
    from service.api.address import (
        list_own_names,
        list_urls,
        load_or_create_token,
        open_listening_socket,
        publish_token,
    )
    from service.api.app import make_app
    from service.api.logins import Logins
    from service.api.runner import serve_app
    from service.server.server import Server
    from storage.permissions import set_umask_and_create_private_folder

    stop = create_stop_event()
    with open_listening_socket(settings.host, settings.port) as listening:
        set_umask_and_create_private_folder(settings.data)
        server = Server(settings.data, unquantized=settings.no_quantize)
        token = load_or_create_token(settings.token, settings.data)
        logins = Logins(token, is_private=settings.private)
        find_urls = partial(list_urls, listening, settings.host, settings.advertise)
        urls = find_urls()
        hosts = (*settings.allow_host, *list_own_names(), get_host(urls[0]))
        app = make_app(server, logins=logins, hosts=hosts, find_urls=find_urls)
        with publish_token(listening, token):
            async with serve_app(app, listening, settings):
                freeze_garbage_collector()
                print_addresses(urls, settings.data, logins, is_stored=not settings.token)
                remark_unreachable(urls, settings.host)
                await stop.wait()


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
    from service.api.address import TOKEN_NAME
    from service.api.logins import Role
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
        show_qr_code(add_ticket(urls[0], logins.tickets.create(Role.OPERATOR)))
    remark(f"data in {data}; Ctrl-C ends it")
    if is_compiling():
        remark(COMPILING_NOTE)
    where = f"$(cat {shlex.quote(str(data / TOKEN_NAME))})" if is_stored else '"$FOOTTILE_TOKEN"'
    if not has_screen:
        place = f"in {data / TOKEN_NAME}" if is_stored else "FOOTTILE_TOKEN"
        remark(f"its token is {place}; `foottile invite` prints a login link")
    token_text = token if sys.stderr.isatty() else where
    remark(f"a node: FOOTTILE_TOKEN={token_text} foottile node --scene FILE --server {urls[0]}")
