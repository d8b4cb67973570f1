"""To wait for what other threads and processes do."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import pytest

T = TypeVar("T")


def until(condition: Callable[[], T], timeout_s: float = 8.0) -> T:
    """What `condition` gives, as soon as that is true."""
    end_s = time.monotonic() + timeout_s
    while not (found := condition()):
        if time.monotonic() > end_s:
            pytest.fail(f"not true within {timeout_s} s; last: {found!r}", pytrace=True)
        time.sleep(0.005)
    return found
