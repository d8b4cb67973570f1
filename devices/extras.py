"""Packages that not every installation has: an error names the extra that brings them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from devices.errors import MissingExtraError

Extra = Literal["server", "emulation", "plot", "gpio", "rig"]

_OURS = ("devices", "storage", "service")


@contextmanager
def needs_extra(extra: Extra, what: str, *, remedy: str = "") -> Iterator[None]:
    """Where packages of an extra are imported: a `with` block, or the decorator of a function.

    Args:
        extra: the extra of `pyproject.toml` that brings them.
        what: does not work without them; the error's text begins with it.
        remedy: what else helps.

    Raises:
        MissingExtraError: one of them is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in _OURS:  # a mistake of ours, which no package mends
            raise
        raise MissingExtraError(
            f"{what} needs {package}, which is not installed",
            remedy=remedy or f"Install it: pip install 'foottile[{extra}]'",
        ) from error
