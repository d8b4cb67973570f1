"""Entry point of `foottile`.

Importing all takes two thirds of a second, with numpy and pydantic's models of scenes.

By default the allocators of Arrow and glibc retain each thread's peak: a server that had answered
400 zooms into ten hours of 8 tiles held 80 MB.
"""

from __future__ import annotations

import ctypes
import io
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from devices.errors import FootTileError, UsageError, escape_control_chars, is_utf8_encodable
from foottile.errors import ClientError
from service.version import SOFTWARE_VERSION

_M_ARENA_MAX = -8  # malloc.h of glibc


def use_system_allocator() -> None:
    """Use one heap of the system's allocator for all threads, and for Arrow.

    Call it before pyarrow is imported, which then chooses its allocator, and before other threads
    start. Child processes inherit the choice for Arrow.
    """
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:  # other C libraries lack it, and have one heap
        mallopt(_M_ARENA_MAX, 1)


_PACKAGE = "service.cli.commands"

SUMMARIES = {
    "demo": "Run a server and an emulated node, and print a link to the live page.",
    "serve": "Run the server: live view, recording, REST API.",
    "node": "Read an array, keep its frames on disk and send them to a server.",
    "find": "List servers and nodes in the local network, with their addresses.",
    "invite": "Create a one-time login link, and on a terminal its QR code.",
    "accept-node": "Accept another machine under the name of a node.",
    "sessions": "List recorded sessions, newest first.",
    "pull": "Download a sealed session: data, description, markers.",
    "stream": "Print live frames of a node with their estimates, one line each, until Ctrl-C.",
    "bridge": "Republish live frames and markers for another program, until Ctrl-C.",
    "export": "Write a sealed session, or a slice of it, in another format.",
    "query": "Run SQL over all sealed sessions.",
    "simulate": "Run a scene on emulated hardware in virtual time and write the session.",
    "estimate": "Estimate a recorded session again and write it with the new estimates.",
    "video": "Keep films beside a session: add, list, remove, align, track.",
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

GROUPS = {"video": ("add", "list", "remove", "align", "track")}
"""Commands of the commands that are groups."""

COMMANDS = [f"{name} {each}".rstrip() for name in SUMMARIES for each in GROUPS.get(name, ("",))]
"""Names of all commands; two words in a group."""

_MODULES = {
    **dict.fromkeys(("pull", "export"), "sessions"),
    **dict.fromkeys(("demo", "invite", "accept-node"), "serve"),
    **dict.fromkeys(("benchmark", "reproduce"), "studies"),
    "recover": "verify",
    **{f"{group} {name}": group for group, names in GROUPS.items() for name in names},
}
"""Modules of commands that do not have their own name."""


def get_command_function(name: str) -> Callable[..., None]:
    """Import and return the function of a command."""
    function = name.replace("-", "_").replace(" ", "_")
    module = import_module(f"{_PACKAGE}.{_MODULES.get(name, function)}")
    command: Callable[..., None] = getattr(module, f"{function}_command")
    return command


def load_command(name: str) -> Any:
    """Return a command with its options, or a group of commands, as typer runs it."""
    from service.cli.options import require_finite_numbers

    app = typer.Typer(
        help=SUMMARIES[name],
        no_args_is_help=name in GROUPS,
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    for each in GROUPS.get(name, ()):
        app.command(each)(require_finite_numbers(get_command_function(f"{name} {each}")))
    if name not in GROUPS:
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


EXIT_INTERRUPTED = 130
"""Exit code after Ctrl-C, typer's and any shell's."""

app = typer.Typer(
    name="foottile",
    cls=LazyCommandGroup,
    help="Data service for arrays of FootTile pressure sensors on robot feet.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
add_summaries(app)


def _print_version(is_requested: bool) -> None:
    if is_requested:
        typer.echo(SOFTWARE_VERSION)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run the command line; an expected error becomes one line on stderr and an exit code.

    So does Ctrl-C, except in `serve`, `node` and `demo`, which it ends regularly.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the caller, who wants no output
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115  # open until the process ends
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            # A character that the terminal's encoding lacks must not end a command.
            stream.reconfigure(errors="backslashreplace")
    use_system_allocator()
    # Temporary files are also removed at a shutdown.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    try:
        _check_utf8()
        app()
    except FootTileError as error:
        sys.stderr.write(f"foottile: {error}\n")
        sys.exit(error.exit_code)
    except ClientError as error:
        sys.stderr.write(f"foottile: {escape_control_chars(str(error))}\n")
        sys.exit(2 if isinstance(error, ValueError) else 1)
    except SystemExit as end:
        if end.code == EXIT_INTERRUPTED:
            _print_interrupted()
        raise
    except KeyboardInterrupt:
        _print_interrupted()
        sys.exit(EXIT_INTERRUPTED)
    except OSError as error:
        sys.stderr.write(f"foottile: {escape_control_chars(str(error))}\n")
        _discard_output()
        sys.exit(1)


_PATH_VARIABLES = ("HOME", "TMPDIR", "XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME")


def _check_utf8() -> None:
    """Reject paths that are not UTF-8 at the start: results could not state them.

    Raises:
        UsageError: an argument, the working folder or a variable with a path is not UTF-8.
    """
    texts = {f"argument {number}": text for number, text in enumerate(sys.argv[1:], 1)}
    texts |= {
        f"the variable {name}": text
        for name, text in os.environ.items()
        if name in _PATH_VARIABLES or name.startswith("FOOTTILE_")
    }
    with suppress(OSError):  # deleted
        texts["the working folder"] = os.getcwd()
    for what, text in texts.items():
        if not is_utf8_encodable(text):
            raise UsageError(
                f"{what} is not UTF-8: {text!r}",
                expected="UTF-8, as results and messages contain paths",
                remedy="Rename that file or folder",
            )


def _discard_output() -> None:
    """Discard unwritten output, so that Python does not retry and report it at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _print_interrupted() -> None:
    sys.stderr.write("foottile: interrupted\n")
