"""What a field of a message may hold that it must not: for tests that put it anywhere."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

ODD_VALUES: tuple[Any, ...] = (
    *(math.nan, math.inf, -math.inf, 1e308, -1e308, 1e-320, -0.0, 0.5),
    *(-1, 0, 1, 2**31, 2**53, 2**62 - 1, 2**62, 2**63 - 1, 2**63, 2**64, -(2**63) - 1, 10**30),
    *("", "x" * 100_000, "\0", "a\nb", "\x85", "0" * 32, "1", "NaN", "\u202e", "../x", "\ud800"),
    *(None, True, False, [], {}, [[]], [[0, 0]], [[0, 2**62 - 1]], [[5, 4]], [[0, 1], [1, 2]]),
    *({"x": [[0, 2**62 - 1]]}, {"a": math.nan}, {"": {}}, [math.inf], ["x"] * 1000),
)


def places(content: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths to everything in a message."""
    yield at
    if isinstance(content, dict | list):
        keys = content if isinstance(content, dict) else range(len(content))
        for key in keys:
            yield from places(content[key], (*at, key))


def with_value(content: Any, place: tuple[Any, ...], value: Any) -> Any:
    """The message with another value there."""
    if not place:
        return value
    copied = dict(content) if isinstance(content, dict) else list(content)
    copied[place[0]] = with_value(content[place[0]], place[1:], value)
    return copied
