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

PATIENCE_S = 180.0
"""How long to wait for what has to happen in the end, on however slow a machine: no test's claim.
Who claims a time measures it."""


def in_a_loop(test: Callable[P, Coroutine[Any, Any, None]]) -> Callable[P, None]:
    """A test that is a coroutine, run in an event loop of its own; its waits end."""

    async def run_for_a_time(*arguments: P.args, **options: P.kwargs) -> None:
        async with asyncio.timeout(4 * PATIENCE_S):  # in the same task, unlike `wait_for`
            await test(*arguments, **options)

    @functools.wraps(test)
    def run(*arguments: P.args, **options: P.kwargs) -> None:
        asyncio.run(run_for_a_time(*arguments, **options))

    return run


def until(
    condition: Callable[[], T], timeout_s: float = PATIENCE_S, *, every_s: float = 0.005
) -> T:
    """What `condition` gives, as soon as that is true; it is asked for every so many seconds."""
    end_s = time.monotonic() + timeout_s
    while not (found := condition()):
        if time.monotonic() > end_s:
            pytest.fail(f"not true within {timeout_s} s; last: {found!r}", pytrace=True)
        time.sleep(every_s)
    return found


def left_s(end_s: float) -> float:
    """Seconds until this instant of `time.monotonic`: the timeout of a wait for one of many.

    Raises:
        TimeoutError: it is past, though others may come without end.
    """
    left = end_s - time.monotonic()
    if left <= 0.0:
        raise TimeoutError("what a test waits for did not come")
    return left
