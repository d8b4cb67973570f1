"""Commands of `foottile`, each imported when it is called; `--help` imports none.

Importing all takes two thirds of a second, with numpy and pydantic's models of scenes.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperGroup

_PACKAGE = "service.cli.commands"

SUMMARIES = {
    "demo": "Run a server and an emulated node, and print a link to the live page.",
    "serve": "Run the server: live view, recording, REST API.",
    "node": "Read an array, keep its frames on disk and send them to a server.",
    "invite": "Create a one-time login link, and on a terminal its QR code.",
    "accept-node": "Accept another machine under the name of a node.",
    "sessions": "List recorded sessions, newest first.",
    "pull": "Download a sealed session: data, description, markers.",
    "stream": "Print live frames of a node with their estimates, one line each, until Ctrl-C.",
    "export": "Write a sealed session, or a slice of it, in another format.",
    "query": "Run SQL over all sealed sessions.",
    "simulate": "Run a scene on emulated hardware in virtual time and write the session.",
    "estimate": "Estimate a recorded session again and write it with the new estimates.",
    "compare": "Compare a session with a reference: a force plate, an insole, another session.",
    "calibrate": (
        "Fit curve and effects of every tile in the recordings, with confidence intervals."
    ),
    "domes": "List the domes of the paper's Table I and their load ranges.",
    "verify": "Verify sessions and journals from their files: checksums, hashes, order and ledger.",
    "recover": "Repair journals and seal sessions after a crash, without a server.",
    "doctor": "Find the tiles of a bus, measure it, and predict its frame rate.",
    "reproduce": "Repeat the paper's experiments on emulated hardware.",
    "benchmark": "Measure time and error of every model set.",
}
"""Summary of each command, the first sentence of its function, in the order of `--help`."""

_MODULES = {"pull": "sessions", "export": "sessions"}
"""Modules with more than one command."""


def get_command_function(name: str) -> Callable[..., None]:
    """Import and return the function of a command."""
    function = name.replace("-", "_")
    module = import_module(f"{_PACKAGE}.{_MODULES.get(name, function)}")
    command: Callable[..., None] = getattr(module, f"{function}_command")
    return command


def load_command(name: str) -> Any:
    """Return a command with its options, as typer runs it."""
    from service.cli.options import require_finite_numbers

    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    app.command(name)(require_finite_numbers(get_command_function(name)))
    return typer.main.get_command(app)


class LazyCommandGroup(TyperGroup):
    """Command group with names and summaries that imports only the called command."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Return the called command, imported."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, command if name is None else load_command(name), rest


def add_summaries(app: typer.Typer) -> None:
    """Add names and summaries of the commands to a `LazyCommandGroup`."""
    for name, summary in SUMMARIES.items():
        app.command(name, help=summary)(_fail_unloaded)


def _fail_unloaded() -> None:
    raise AssertionError("a command is loaded before it runs")
