"""JIT compilation (numba) of recursions over time, for recordings of ten million frames.

Without fast-math, so that compiled code gives the same bits as Python, however a recording is split
into batches. A division by zero gives infinity or NaN, as in numpy, and no exception.

Machine code is cached on disk under a digest of all its source code. numba's own cache checks only
the file of the function, and would run stale code after a change in a file that it calls.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import threading
from collections.abc import Callable, Iterator
from functools import cached_property
from types import CodeType, ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import serialize
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.registry import cpu_target

F = TypeVar("F", bound=Callable[..., Any])
_thread_state = threading.local()
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_CALLEE_OPTIONS: dict[str, Any] = {"no_cpython_wrapper": True, "_nrt": False}
"""Options of a function in its compiled callers: no wrapper for Python, and no reference counts, as
the callers keep the arrays. Compiling all models takes a third less time so."""


class NotCompiledError(Exception):
    """The function is not in the cache of machine code. Compilation takes some ten seconds."""


@contextlib.contextmanager
def forbid_compilation() -> Iterator[None]:
    """Context manager: forbid compilation in this thread; only cached machine code runs.

    Raises:
        NotCompiledError: a called function is not in the cache.
    """
    _thread_state.cached_only = True
    try:
        yield
    finally:
        _thread_state.cached_only = False


def jit_cached(function: F) -> F:
    """Compile `function` at its first call; cache the machine code on disk where possible.

    Called by compiled code it can neither allocate an array nor return one.
    """
    return _jit(function, forceinline=False)


def jit_inlined(function: F) -> F:
    """Compile `function` inline into compiled callers.

    For functions with many array arguments, whose passing costs more than a short function does.
    """
    return _jit(function, forceinline=True)


def _jit(function: F, *, forceinline: bool) -> F:
    dispatcher: Any = numba.njit(forceinline=forceinline, **_OPTIONS)(function)
    callee: Any = numba.njit(forceinline=forceinline, **_OPTIONS, **_CALLEE_OPTIONS)(function)

    def get_overload(argument_types: Any) -> Any:
        returned = callee.overloads[argument_types].signature.return_type
        if cpu_target.target_context.data_model_manager[returned].contains_nrt_meminfo():
            # Without reference counts it would be freed too early; numba refuses only new arrays.
            raise numba.TypingError(
                f"{function.__qualname__} returns {returned}: what compiled code calls returns no "
                "array; let the caller pass one to fill"
            )
        return callee.get_overload(argument_types)

    # What compiled callers ask for. Without these they would take `dispatcher` itself.
    dispatcher.get_call_template, dispatcher.get_overload = callee.get_call_template, get_overload
    if not has_cache_folder():
        return cast("F", dispatcher)
    with contextlib.suppress(RuntimeError):  # no cache folder: no home, read-only installation
        # As numba.njit(cache=True), which fails if the cache cannot be read or written.
        dispatcher._cache = _DigestCache(function)  # noqa: SLF001  # numba's own seam
    return cast("F", dispatcher)


def has_cache_folder() -> bool:
    """Return whether machine code can be cached. Without a home numba makes a folder named "~"."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~")
    return bool(os.environ.get("NUMBA_CACHE_DIR")) or os.path.isabs(home)


class _DigestCache(FunctionCache):
    """Cache of machine code on disk. Write errors and damaged files only cost a recompilation."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]  # numba has no types
        self._cache_file = _ChecksummedFiles(  # type: ignore[no-untyped-call]  # likewise
            self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp()
        )

    @cached_property
    def _code_digest(self) -> str:
        return _hash_code(self._py_func)  # at the first call: its callees may be defined later

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        key = super()._index_key(sig, codegen)  # type: ignore[no-untyped-call]  # numba has no types
        return (*key, self._code_digest)

    def save_overload(self, sig: Any, data: Any) -> None:
        with contextlib.suppress(Exception):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]  # numba has no types

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            kept = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]  # likewise
        except Exception:  # a damaged pickle may raise anything
            with contextlib.suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]  # it is written again
            kept = None
        if kept is None and getattr(_thread_state, "cached_only", False):
            raise NotCompiledError(self._name)
        return kept


class _ChecksummedFiles(IndexDataCacheFile):
    """Index and data files of the cache; each data file holds its key and a checksum.

    numba writes the index first. If the disk is full, the process is killed, or two processes write
    at once, the index may point to machine code of another function.
    """

    def save(self, key: Any, data: Any) -> None:
        content = serialize.dumps((self._source_stamp, key, data))  # type: ignore[no-untyped-call]  # likewise
        super().save(key, hashlib.sha256(content).digest() + content)  # type: ignore[no-untyped-call]  # likewise

    def load(self, key: Any) -> Any:
        kept = super().load(key)  # type: ignore[no-untyped-call]  # likewise
        if not isinstance(kept, bytes):
            return None
        size = hashlib.sha256().digest_size
        if hashlib.sha256(kept[size:]).digest() != kept[:size]:
            return None
        stamp, saved_key, data = pickle.loads(kept[size:])  # noqa: S301  # as numba; our own file
        return data if (stamp, saved_key) == (self._source_stamp, key) else None


def _hash_code(function: Callable[..., Any]) -> str:
    """Hash a function's code, all compiled functions that it calls, and their constants."""
    options = repr((_OPTIONS, _CALLEE_OPTIONS))
    digest, seen, left = hashlib.sha256(options.encode()), set(), [function]
    while left:
        each = left.pop()
        if each in seen:
            continue
        seen.add(each)
        for code in _iterate_code(each.__code__):
            # The code of `a.x` is that of `a.y`, and that of `math.sin(a)` that of `math.cos(a)`.
            _update_digest(digest, code.co_code, repr(code.co_names).encode())
            for value in (*code.co_consts, *_iterate_globals(each, code.co_names)):
                if isinstance(value, np.ndarray):
                    _update_digest(
                        digest, repr((value.dtype, value.shape)).encode(), value.tobytes()
                    )
                elif isinstance(value, int | float | str | tuple | np.dtype | np.generic):
                    _update_digest(digest, repr(value).encode())
                elif hasattr(value, "py_func"):
                    left.append(value.py_func)
                else:
                    _update_digest(digest, getattr(value, "__qualname__", "").encode())
    return digest.hexdigest()


def _update_digest(digest: Any, *parts: bytes) -> None:
    for part in parts:
        digest.update(len(part).to_bytes(8, "big") + part)


def _iterate_code(code: CodeType) -> Iterator[CodeType]:
    """Yield a code object and all code objects nested in it."""
    yield code
    for value in code.co_consts:
        if isinstance(value, CodeType):
            yield from _iterate_code(value)


def _iterate_globals(function: Callable[..., Any], names: tuple[str, ...]) -> Iterator[Any]:
    """Yield the values of global `names`; for a module, the values of `names` within it."""
    for name in names:
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType):
            yield from (getattr(value, each, None) for each in names)
        else:
            yield value
