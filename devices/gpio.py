"""Errors of GPIO lines, for the bus's recovery and for sync lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from devices.errors import BusSetupError


@contextmanager
def translate_gpio_errors(chip: str, lines: Sequence[int], section: str) -> Iterator[None]:
    """Context manager: turn errors of GPIO lines into `BusSetupError` while the block runs."""
    try:
        yield
    except OSError as error:
        raise BusSetupError(
            f"GPIO lines cannot be used ({error.strerror or error})",
            where=f"{chip}, lines {', '.join(map(str, lines))}",
            remedy=f"Check {section}, that this user is in the group gpio, and that no other "
            "program holds the lines (gpioinfo)",
            errno=error.errno,
        ) from error
