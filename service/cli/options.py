"""What several commands share: options that are pairs, output paths, progress, and JSON."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from devices.errors import UsageError

JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


class _Output(Console):
    def on_broken_pipe(self) -> None:
        # The reader has seen enough, as with `| head -1`: that is no failure.
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0)


# Data goes to stdout; progress and remarks to stderr, progress only on a terminal.
stdout = _Output()
stderr = Console(stderr=True)


def pair(text: str | None, option: str) -> tuple[float, float] | None:
    """Two numbers with a comma between them.

    Raises:
        UsageError: anything else.
    """
    if text is None:
        return None
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        first = second = math.nan
    if not (math.isfinite(first) and math.isfinite(second)):
        raise UsageError(f"{option} {text!r} is no pair of numbers", expected="A,B")
    return first, second


def data_folder(given: Path | None) -> Path:
    """The data folder that an option names, or the user's."""
    from platformdirs import user_data_path

    return given if given is not None else user_data_path("foottile")


def output_path(path: Path, *inputs: Path) -> Path:
    """Where to write, links resolved, after a look whether it can be, before anything takes time.

    Raises:
        UsageError: its folder is missing or not writable, it is no regular file, or one of the
            inputs, which would be lost.
    """
    target = path.resolve()
    folder = target.parent
    if not folder.is_dir():
        raise UsageError(f"no folder {str(folder)!r} to write {path.name} in", remedy="Make it")
    if (target.exists() and not target.is_file()) or not os.access(folder, os.W_OK):
        raise UsageError(f"{str(path)!r} cannot be written")
    if any(target == given.resolve() for given in inputs):
        raise UsageError(
            f"{str(path)!r} is an input and would be lost", remedy="Write to another file"
        )
    return target


def plain(value: Any) -> Any:
    """A result as JSON can hold it: what is not finite is null, a dataclass an object.

    A dataclass with a method `as_dict` is what that says.
    """
    if hasattr(value, "as_dict"):
        return plain(value.as_dict())
    if is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_text(value: object) -> str:
    """A JSON document of any result."""
    return json.dumps(plain(value), indent=2, allow_nan=False) + "\n"


def print_json(value: object) -> None:
    """One JSON document on stdout."""
    sys.stdout.write(json_text(value))


@contextmanager
def progress(message: str) -> Iterator[Callable[[str], None]]:
    """Say what takes time, on a terminal only.

    What it gives says how far it is: in the same line on a terminal, else a line each on stderr.
    """
    if not stderr.is_terminal:
        yield remark
        return
    with stderr.status(message) as status:
        yield status.update


def say(message: str) -> None:
    """A line of the result on stdout, as it is."""
    stdout.print(message, highlight=False, soft_wrap=True, markup=False)


def remark(message: str) -> None:
    """A line on stderr that a user should see, wherever it goes."""
    stderr.print(message, style="dim", highlight=False, markup=False, soft_wrap=True)
