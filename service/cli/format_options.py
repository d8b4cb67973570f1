"""Options of export formats, as options of a command."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Annotated, Any, Literal, get_args, get_origin

import typer
from pydantic import ValidationError
from pydantic.fields import FieldInfo

from devices.errors import UsageError
from service.cli.options import expand_options
from storage.formats.options import FormatOptions
from storage.formats.writers.registry import FORMATS

FormatOption = Annotated[str, typer.Option("--format", help=", ".join(FORMATS) + ".")]


def add_format_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter `options` of a command by an option for each field of `FormatOptions`.

    Raises:
        UsageError: a value that `FormatOptions` rejects.
    """
    parameters = [
        _make_parameter(name, field) for name, field in FormatOptions.model_fields.items()
    ]
    return expand_options(command, parameters, _make_options)


def _make_options(values: dict[str, Any]) -> FormatOptions:
    try:
        return FormatOptions(**values)
    except ValidationError as error:
        (name, *_), why = error.errors()[0]["loc"], error.errors()[0]["msg"]
        raise UsageError(f"--{name} {values[str(name)]!r}: {why}") from error


def _make_parameter(name: str, field: FieldInfo) -> inspect.Parameter:
    kinds = [kind for kind in get_args(field.annotation) if kind is not type(None)]
    choices = get_args(kinds[0]) if get_origin(kinds[0]) is Literal else ()
    text = f"{' or '.join(choices)}. {field.description}" if choices else field.description
    kind: Any = str if choices else kinds[0]
    annotation: Any = Annotated[kind | None, typer.Option(help=text)]
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
    )
