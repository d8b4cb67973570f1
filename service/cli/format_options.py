"""Options of the formats that sessions are written in, as options of a command."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Annotated, Any, Literal, get_args, get_origin

import typer
from pydantic import ValidationError
from pydantic.fields import FieldInfo

from devices.errors import UsageError
from storage.formats.options import FormatOptions
from storage.formats.writers.registry import FORMATS

FormatOption = Annotated[str, typer.Option("--format", help=", ".join(FORMATS) + ".")]


def with_format_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose parameter `options`, a `FormatOptions`, is an option for each of its fields.

    What they may be is said by `FormatOptions`; a UsageError is raised for anything else.
    """
    own = inspect.signature(command, eval_str=True)
    further = [_parameter(name, field) for name, field in FormatOptions.model_fields.items()]

    @wraps(command)
    def run(**given: Any) -> None:
        asked = {parameter.name: given.pop(parameter.name) for parameter in further}
        command(**given, options=_options(asked))

    parameters = [p for p in own.parameters.values() if p.name != "options"] + further
    run.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]  # for typer
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _options(asked: dict[str, Any]) -> FormatOptions:
    try:
        return FormatOptions(**asked)
    except ValidationError as error:
        (name, *_), why = error.errors()[0]["loc"], error.errors()[0]["msg"]
        raise UsageError(f"--{name} {asked[str(name)]!r}: {why}") from error


def _parameter(name: str, field: FieldInfo) -> inspect.Parameter:
    kinds = [kind for kind in get_args(field.annotation) if kind is not type(None)]
    choices = get_args(kinds[0]) if get_origin(kinds[0]) is Literal else ()
    text = f"{' or '.join(choices)}. {field.description}" if choices else field.description
    kind: Any = str if choices else kinds[0]
    annotation: Any = Annotated[kind | None, typer.Option(help=text)]
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
    )
