"""Recursions over time, compiled: a Python loop per frame does not do ten million of them.

Compiled without fast-math, so that a loop gives the same bits as the same arithmetic in Python,
however a recording is cut into batches. A division by zero is infinite or NaN, as in numpy, and no
exception.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """`function` as machine code, made at its first call and kept on disk where that can be."""
    try:
        return cast("F", numba.njit(cache=True, nogil=True, error_model="numpy")(function))
    except RuntimeError:  # nowhere to keep it: no home and a read-only installation
        return cast("F", numba.njit(nogil=True, error_model="numpy")(function))
