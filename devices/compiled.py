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

F = TypeVar("F", bound=Callable[..., Any])
_asking = threading.local()
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


class NotKeptError(Exception):
    """Machine code is not there yet; to compile it takes some ten seconds."""


@contextlib.contextmanager
def only_kept() -> Iterator[None]:
    """Nothing is compiled in this thread while the block runs: what is not kept is an error.

    Raises:
        NotKeptError: something would have to be.
    """
    _asking.only_kept = True
    try:
        yield
    finally:
        _asking.only_kept = False


def compiled(function: F) -> F:
    """`function` as machine code, made at its first call and kept on disk where that can be."""
    return _compiled(function, forceinline=False)


def inlined(function: F) -> F:
    """The same for parts of one that take many arrays: counting references costs more than they."""
    return _compiled(function, forceinline=True)


def _compiled(function: F, *, forceinline: bool) -> F:
    dispatcher: Any = numba.njit(forceinline=forceinline, **_OPTIONS)(function)
    if not has_cache_folder():
        return cast("F", dispatcher)
    with contextlib.suppress(RuntimeError):  # nowhere to keep it: no home, read-only installation
        # As numba.njit(cache=True) does, which stops at a cache that it cannot read or write.
        dispatcher._cache = _Kept(function)  # noqa: SLF001  # numba's own seam
    return cast("F", dispatcher)


def has_cache_folder() -> bool:
    """Is there a place for machine code? Without a home numba would make a folder named "~"."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~")
    return bool(os.environ.get("NUMBA_CACHE_DIR")) or os.path.isabs(home)


class _Kept(FunctionCache):
    """Machine code on disk; a full disk, or a file that a power cut left, costs a second."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]  # numba has no types
        self._cache_file = _Files(  # type: ignore[no-untyped-call]  # likewise
            self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp()
        )

    @cached_property
    def _made_of(self) -> str:
        return _digest(self._py_func)  # not before the first call: what it calls may come later

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        key = super()._index_key(sig, codegen)  # type: ignore[no-untyped-call]  # numba has no types
        return (*key, self._made_of)

    def save_overload(self, sig: Any, data: Any) -> None:
        with contextlib.suppress(Exception):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]  # numba has no types

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            kept = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]  # likewise
        except Exception:  # there is nothing that a garbled pickle may not raise
            with contextlib.suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]  # it is written again
            kept = None
        if kept is None and getattr(_asking, "only_kept", False):
            raise NotKeptError(self._name)
        return kept


class _Files(IndexDataCacheFile):
    """An index and its files, of which each says itself what it is, and proves it.

    The index is written first. If the file is not, because the disk is full or the process killed,
    or if two processes write at once, then it points to machine code of something else, which would
    run.
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
        stamp, of, data = pickle.loads(kept[size:])  # noqa: S301  # as numba does, and what we wrote
        return data if (stamp, of) == (self._source_stamp, key) else None


def _digest(function: Callable[..., Any]) -> str:
    """Of a function's code, of all compiled functions that it reaches, and of their constants."""
    digest, seen, left = hashlib.sha256(repr(_OPTIONS).encode()), set(), [function]
    while left:
        each = left.pop()
        if each in seen:
            continue
        seen.add(each)
        for code in _codes(each.__code__):
            # The code of `a.x` is that of `a.y`, and that of `math.sin(a)` that of `math.cos(a)`.
            _add(digest, code.co_code, repr(code.co_names).encode())
            for value in (*code.co_consts, *_globals_of(each, code.co_names)):
                if isinstance(value, np.ndarray):
                    _add(digest, repr((value.dtype, value.shape)).encode(), value.tobytes())
                elif isinstance(value, int | float | str | tuple | np.dtype | np.generic):
                    _add(digest, repr(value).encode())
                elif hasattr(value, "py_func"):
                    left.append(value.py_func)
                else:
                    _add(digest, getattr(value, "__qualname__", "").encode())
    return digest.hexdigest()


def _add(digest: Any, *parts: bytes) -> None:
    for part in parts:
        digest.update(len(part).to_bytes(8, "big") + part)


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Of a function, and of those within it."""
    yield code
    for value in code.co_consts:
        if isinstance(value, CodeType):
            yield from _codes(value)


def _globals_of(function: Callable[..., Any], names: tuple[str, ...]) -> Iterator[Any]:
    """What names stand for in its module, and in modules that they name."""
    for name in names:
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType):
            yield from (getattr(value, each, None) for each in names)
        else:
            yield value
