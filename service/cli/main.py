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
from service.cli.table import Commands, name_all
from service.memory import use_system_allocator
from service.version import SOFTWARE_VERSION

INTERRUPTED = 130
"""Exit code after Ctrl-C, typer's and any shell's."""

app = typer.Typer(
    name="foottile",
    cls=Commands,
    help="Data service for arrays of FootTile pressure sensors on robot feet.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
name_all(app)


def _print_version(wanted: bool) -> None:
    if wanted:
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
    """Run the command line; every expected error becomes one line on stderr and an exit code.

    So does Ctrl-C, where it does not end a command well, as it does `serve`, `node` and `demo`.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # started with it closed: whoever does wants to hear nothing
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115  # as long as it runs
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            # A letter that the terminal's encoding lacks must not end a command.
            stream.reconfigure(errors="backslashreplace")
    use_system_allocator()
    # So that what is half-written is cleaned up when the machine is shut down, too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    try:
        _check_texts()
        app()
    except FootTileError as error:
        sys.stderr.write(f"foottile: {error}\n")
        sys.exit(error.exit_code)
    except ClientError as error:
        sys.stderr.write(f"foottile: {escape_control_chars(str(error))}\n")
        sys.exit(2 if isinstance(error, ValueError) else 1)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            _say_interrupted()
        raise
    except KeyboardInterrupt:
        _say_interrupted()
        sys.exit(INTERRUPTED)
    except OSError as error:
        sys.stderr.write(f"foottile: {escape_control_chars(str(error))}\n")
        _leave_unwritten()
        sys.exit(1)


_PATH_VARIABLES = ("HOME", "TMPDIR", "XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME")


def _check_texts() -> None:
    """Refuse paths that are not UTF-8 before anything is done: results could not state them.

    Raises:
        UsageError: an argument, the working folder or a variable with a path is not UTF-8.
    """
    texts = {f"argument {number}": text for number, text in enumerate(sys.argv[1:], 1)}
    texts |= {
        f"the variable {name}": text
        for name, text in os.environ.items()
        if name in _PATH_VARIABLES or name.startswith("FOOTTILE_")
    }
    with suppress(OSError):  # it is gone
        texts["the working folder"] = os.getcwd()
    for what, text in texts.items():
        if not is_utf8_encodable(text):
            raise UsageError(
                f"{what} is not UTF-8: {text!r}",
                expected="paths that JSON can state: they are in results and messages",
                remedy="Rename that file or folder",
            )


def _leave_unwritten() -> None:
    """What could not be written is not tried again when Python ends, which would say so again."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _say_interrupted() -> None:
    sys.stderr.write("foottile: interrupted\n")
