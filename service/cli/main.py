"""Entry point of `foottile`."""

from __future__ import annotations

import io
import os
import signal
import sys
from contextlib import suppress
from typing import Annotated

import typer

from devices.errors import FootTileError, UsageError
from devices.text import escape_control_chars, is_utf8_encodable
from foottile.errors import FootTileError as ClientError
from service.cli.command_table import LazyCommandGroup, add_summaries
from service.memory import use_system_allocator
from service.version import SOFTWARE_VERSION

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
