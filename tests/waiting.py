"""To wait for what other threads, processes and tasks do."""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Callable, Coroutine
from typing import Any, ParamSpec, TypeVar

import pytest

P = ParamSpec("P")
T = TypeVar("T")


def in_a_loop(test: Callable[P, Coroutine[Any, Any, None]]) -> Callable[P, None]:
    """A test that is a coroutine, run in an event loop of its own."""

    @functools.wraps(test)
    def run(*arguments: P.args, **options: P.kwargs) -> None:
        asyncio.run(test(*arguments, **options))

    return run


def until(condition: Callable[[], T], timeout_s: float = 8.0) -> T:
    """What `condition` gives, as soon as that is true."""
    end_s = time.monotonic() + timeout_s
    while not (found := condition()):
        if time.monotonic() > end_s:
            pytest.fail(f"not true within {timeout_s} s; last: {found!r}", pytrace=True)
        time.sleep(0.005)
    return found
