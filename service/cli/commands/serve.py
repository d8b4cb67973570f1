"""`foottile serve`: the server."""

from __future__ import annotations

import shlex
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.errors import require_extra
from service.cli.options import remark, say, stop_on_signals
from service.cli.tickets import AdvertiseOption, host_of, reaches_others, remark_reach, show_code

if TYPE_CHECKING:
    from service.api.logins import Logins
    from service.api.settings import Settings


def _bound(text: str) -> Any:
    return typer.Option(help=text, rich_help_panel="Bounds for those without a key")


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
        typer.Option(
            help="Further name under which the server is reached; may be given several times."
        ),
    ] = None,
    advertise: AdvertiseOption = None,
    private: Annotated[
        bool | None,
        typer.Option("--private", help="Ask for a login to look, too; default: only to change."),
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
            help="Reverse proxy whose X-Forwarded-For and X-Forwarded-Proto count; may be given "
            "several times; default: none.",
        ),
    ] = None,
    max_connections: Annotated[int | None, _bound("Requests and screens at once; 512.")] = None,
    max_connections_per_address: Annotated[
        int | None, _bound("The same from one address, as all phones of a hotspot are; 256.")
    ] = None,
    max_nodes: Annotated[int | None, _bound("Nodes at once; 32.")] = None,
    max_header_bytes: Annotated[int | None, _bound("Longest headers of a request; 32768.")] = None,
    header_timeout_s: Annotated[
        float | None, _bound("A request's headers have to come within; 10.")
    ] = None,
    body_timeout_s: Annotated[float | None, _bound("Its body has to come within; 20.")] = None,
    idle_timeout_s: Annotated[
        float | None, _bound("A connection may wait so long for its next request; 30.")
    ] = None,
) -> None:
    """Run the server: live view, recording, REST API.

    Settings come from options, else from FOOTTILE_HOST and the like, else from --config. Changes
    need a token: FOOTTILE_TOKEN, or one that is made and kept in the data folder. On a terminal a
    link is printed that logs a browser in; `foottile invite` prints others. Commands of this user
    on this machine find the token by themselves. Ctrl-C ends it; what is being recorded goes on
    when it runs again.
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
    uvloop.run(_serve(settings))


async def _serve(settings: Settings) -> None:
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
    from storage.permissions import restrict_to_owner

    stop = stop_on_signals()
    restrict_to_owner(settings.data)
    with open_listening_socket(settings.host, settings.port) as listening:
        server = Server(settings.data, exact=settings.no_quantize)
        token = load_or_create_token(settings.token, settings.data)
        logins = Logins(token, is_private=settings.private)
        find_urls = partial(list_urls, listening, settings.host, settings.advertise)
        urls = find_urls()
        hosts = (*settings.allow_host, *list_own_names(), host_of(urls[0]))
        app = make_app(server, logins=logins, hosts=hosts, find_urls=find_urls)
        with publish_token(listening, token):
            async with serve_app(app, listening, settings):
                freeze_garbage_collector()
                announce(urls, settings.data, logins, is_kept=not settings.token)
                remark_reach(urls, settings.host)
                await stop.wait()


def announce(
    urls: list[str], data: Path, logins: Logins, *, is_kept: bool, is_demo: bool = False
) -> None:
    """Print where the page is, how a phone gets in, and how a node gets there.

    The token is shown on a terminal only: what is not one is often a log, which others may read. A
    demo prints a ticket there, which is good once and soon ends.

    Args:
        urls: addresses of the server.
        data: its data folder.
        logins: token and tickets of the server.
        is_kept: is its token the one that is kept in the data folder?
        is_demo: has every link to log a browser in?
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
        say(f"FootTile is at {link}")
    if has_screen and reaches_others(urls[0]):
        show_code(add_ticket(urls[0], logins.tickets.create(Role.OPERATOR)))
    remark(f"data in {data}; Ctrl-C ends it")
    if is_compiling():
        remark(COMPILING_NOTE)
    where = f"$(cat {shlex.quote(str(data / TOKEN_NAME))})" if is_kept else '"$FOOTTILE_TOKEN"'
    if not has_screen:
        place = f"in {data / TOKEN_NAME}" if is_kept else "the one that was given"
        remark(f"its token is {place}; `foottile invite` prints a link that logs a browser in")
    shown = token if sys.stderr.isatty() else where
    remark(f"a node: FOOTTILE_TOKEN={shown} foottile node --scene FILE --server {urls[0]}")
