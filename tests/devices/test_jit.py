"""Compiled functions: the same numbers in any state of their cache."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numba
import numba.core.caching
import numba.core.config
import numpy as np
import pytest
from numba.core.errors import NumbaError

from devices.arrays import Floats
from devices.jit import jit_cached


def tripled(x: float) -> float:
    return 3.0 * x


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of machine code."""
    monkeypatch.setattr(numba.core.config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def call_anew(function: Any = tripled) -> tuple[float, int]:
    """Return the result as after a new start, and the number of cache hits."""
    compiled: Any = jit_cached(function)
    return compiled(2.0), sum(compiled.stats.cache_hits.values())


def test_a_function_is_compiled_once_with_or_without_a_callee(cache: Path) -> None:
    assert [call_anew(), call_anew()] == [(6.0, 0), (6.0, 1)]
    assert [call_anew(scaled), call_anew(scaled)] == [(12.0, 0), (12.0, 1)]


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("damage", ["empty", "cut", 0.02, 0.3, 0.6, 0.9])
def test_a_function_of_a_damaged_cache_is_compiled_again(
    cache: Path, suffix: str, damage: str | float
) -> None:
    call_anew()
    (file,) = cache.rglob(f"*{suffix}")
    content = bytearray(file.read_bytes())
    if isinstance(damage, float):  # garbled from this part of the file on
        at = int(damage * len(content))
        content[at : at + 8] = bytes(255 - byte for byte in content[at : at + 8])
    else:
        del content[0 if damage == "empty" else 40 :]
    file.write_bytes(content)
    assert [call_anew(), call_anew()] == [(6.0, 0), (6.0, 1)]


def refuse_to_write(*_: Any) -> None:
    raise OSError(28, "No space left on device")


@pytest.mark.usefixtures("cache")
def test_a_function_is_compiled_without_a_cache_and_on_a_full_disk(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as disk:
        disk.setattr(numba.core.caching.IndexDataCacheFile, "save", refuse_to_write)
        assert jit_cached(tripled)(2.0) == 6.0
    monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])
    assert jit_cached(tripled)(2.0) == 6.0


FACTOR = 2.0
inner = jit_cached(tripled)


def scaled(x: float) -> float:
    return FACTOR * inner(x)


def halved(x: float) -> float:
    return 0.5 * x


def at_most(x: float) -> float:
    return min(3.0 * x, 2.0)


def at_least(x: float) -> float:
    return max(3.0 * x, 2.0)


def rounded_down(x: float) -> float:
    return math.floor(1.5 * x)


def rounded_up(x: float) -> float:
    return math.ceil(1.5 * x)


PLACE = np.array([(1.0, 5.0)], [("near", np.float64), ("far", np.float64)])


def at_near(x: float) -> float:
    return x * PLACE[0].near  # type: ignore[no-any-return]  # a field of a record


def at_far(x: float) -> float:
    return x * PLACE[0].far  # type: ignore[no-any-return]  # a field of a record


@pytest.mark.usefixtures("cache")
@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        (at_most, at_least, [4.0, 6.0]),
        (rounded_down, rounded_up, [2.0, 4.0]),
        (at_near, at_far, [2.0, 10.0]),
    ],
)
def test_a_function_is_compiled_again_if_its_callee_differs_in_a_name_only(
    one: Any, other: Any, expected: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Python's byte code has the number of a name, and not the name.
    found = []
    for callee in (one, other):
        monkeypatch.setitem(globals(), "inner", jit_cached(callee))
        found.append(jit_cached(scaled)(1.0))
    assert found == expected


@pytest.mark.usefixtures("cache")
def test_an_index_without_its_machine_code_is_not_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert jit_cached(scaled)(1.0) == 6.0
    # The file is edited, and the disk takes the index, which comes first, but no machine code.
    locator = numba.core.caching.UserProvidedCacheLocator
    monkeypatch.setattr(locator, "get_source_stamp", lambda _: "edited")
    monkeypatch.setitem(globals(), "FACTOR", 10.0)
    with monkeypatch.context() as disk:
        disk.setattr(numba.core.caching.IndexDataCacheFile, "_save_data", refuse_to_write)
        assert jit_cached(scaled)(1.0) == 30.0
    assert jit_cached(scaled)(1.0) == 30.0


@pytest.mark.usefixtures("cache")
@pytest.mark.parametrize(
    ("name", "value", "expected"), [("FACTOR", 10.0, 30.0), ("inner", jit_cached(halved), 1.0)]
)
def test_a_function_is_compiled_again_if_a_callee_or_a_constant_has_changed(
    name: str, value: Any, expected: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The file of `scaled` is unchanged, and numba compares nothing else.
    assert jit_cached(scaled)(1.0) == 6.0
    monkeypatch.setitem(globals(), name, value)
    assert jit_cached(scaled)(1.0) == expected


def same(rows: Floats) -> Any:
    return rows


def pair(rows: Floats) -> Any:
    return rows[0], rows[1]


def copied(rows: Floats) -> Any:
    return rows.copy()


def summed(rows: Floats) -> Any:
    return (rows[0] + rows[1])[0]


@pytest.mark.usefixtures("cache")
@pytest.mark.parametrize("function", [same, pair, copied, summed])
def test_a_callee_that_returns_or_makes_an_array_is_refused(
    function: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Its references are not counted: it would be freed too early, or never.
    monkeypatch.setitem(globals(), "inner", jit_cached(function))
    with pytest.raises(NumbaError, match=r"return|NRT required"):
        jit_cached(calling)(np.ones((2, 3)))


def calling(rows: Floats) -> int:
    inner(rows)  # type: ignore[arg-type]  # another function, in the test
    return 0
