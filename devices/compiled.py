"""Recursions over time, compiled: a Python loop per frame does not do ten million of them.

Compiled without fast-math, so that a loop gives the same bits as the same arithmetic in Python,
however a recording is cut into batches. A division by zero is infinite or NaN, as in numpy, and no
exception.

Machine code is kept with a digest of all that it was made of: numba itself looks at the file of the
function alone, and would go on running what has since been mended in a file that it calls.
"""

from __future__ import annotations

import contextlib
import hashlib
import pickle
from collections.abc import Callable, Iterator
from functools import cached_property
from types import CodeType, ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
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

    @cached_property
    def _made_of(self) -> str:
        return _digest(self._py_func)  # not before the first call: what it calls may come later

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        key = super()._index_key(sig, codegen)  # type: ignore[no-untyped-call]  # numba has no types
        return (*key, self._made_of)

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


def _digest(function: Callable[..., Any]) -> str:
    """Of a function's code, of all compiled functions that it reaches, and of their constants."""
    digest, seen, todo = hashlib.sha256(), set(), [function]
    while todo:
        each = todo.pop()
        if each in seen:
            continue
        seen.add(each)
        digest.update(each.__code__.co_code)
        for value in (*each.__code__.co_consts, *_globals_of(each)):
            if isinstance(value, np.ndarray):
                digest.update(value.tobytes())
            elif isinstance(value, CodeType):
                digest.update(value.co_code)
            elif isinstance(value, int | float | str | tuple | np.dtype):
                digest.update(repr(value).encode())
            elif hasattr(value, "py_func"):
                todo.append(value.py_func)
    return digest.hexdigest()


def _globals_of(function: Callable[..., Any]) -> Iterator[Any]:
    """What its names stand for in its module, and in modules that it names."""
    names = function.__code__.co_names
    for name in names:
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType):
            yield from (getattr(value, each, None) for each in names)
        else:
            yield value
