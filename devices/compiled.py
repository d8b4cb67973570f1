"""Recursions over time, compiled: a Python loop per frame does not do ten million of them.

Compiled without fast-math, so that a loop gives the same bits as the same arithmetic in Python,
however a recording is cut into batches. A division by zero is infinite or NaN, as in numpy, and no
exception.
"""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import FunctionCache

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """`function` as machine code, made at its first call and kept on disk where that can be."""
    return _compiled(function, forceinline=False)


def inlined(function: F) -> F:
    """The same for parts of one that take many arrays: counting references costs more than they."""
    return _compiled(function, forceinline=True)


def _compiled(function: F, *, forceinline: bool) -> F:
    dispatcher: Any = numba.njit(nogil=True, error_model="numpy", forceinline=forceinline)(function)
    with contextlib.suppress(RuntimeError):  # nowhere to keep it: no home, read-only installation
        # As numba.njit(cache=True) does, which stops at a cache that it cannot read or write.
        dispatcher._cache = _Kept(function)  # type: ignore[no-untyped-call]  # noqa: SLF001  # numba's own seam
    return cast("F", dispatcher)


class _Kept(FunctionCache):
    """Machine code on disk; a full disk, or a file that a power cut left, costs a second."""

    def save_overload(self, sig: Any, data: Any) -> None:
        with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]  # numba has no types

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]  # likewise
        except (OSError, EOFError, pickle.UnpicklingError):
            with contextlib.suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]  # it is written again
            return None
