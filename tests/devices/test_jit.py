"""Compiled loops: the same numbers whatever becomes of the folder that they are kept in."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numba.core.caching
import numba.core.config
import numpy as np
import pytest

from devices.jit import jit_cached


def tripled(x: float) -> float:
    return 3.0 * x


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where compiled loops are kept."""
    monkeypatch.setattr(numba.core.config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def called() -> tuple[float, int]:
    """The loop's result as after a new start, and how often it came from disk."""
    loop: Any = jit_cached(tripled)
    return loop(2.0), sum(loop.stats.cache_hits.values())


def test_it_is_compiled_once_and_kept(kept: Path) -> None:
    assert [called(), called()] == [(6.0, 0), (6.0, 1)]


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("left", [0, 40])
def test_what_a_power_cut_left_of_it_is_compiled_anew(kept: Path, suffix: str, left: int) -> None:
    called()
    (file,) = kept.rglob(f"*{suffix}")
    file.write_bytes(file.read_bytes()[:left])
    assert [called(), called()] == [(6.0, 0), (6.0, 1)]


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.9])
def test_what_a_disk_has_garbled_of_it_is_compiled_anew(
    kept: Path, suffix: str, share: float
) -> None:
    called()
    (file,) = kept.rglob(f"*{suffix}")
    content = bytearray(file.read_bytes())
    at = int(share * len(content))
    content[at : at + 8] = bytes(255 - byte for byte in content[at : at + 8])
    file.write_bytes(content)
    assert [called(), called()] == [(6.0, 0), (6.0, 1)]


def test_without_a_place_to_keep_it_it_is_compiled_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])
    assert jit_cached(tripled)(2.0) == 6.0


def test_on_a_full_disk_it_is_compiled_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(numba.core.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(numba.core.caching.IndexDataCacheFile, "save", full)
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


@pytest.mark.usefixtures("kept")
@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        (at_most, at_least, [4.0, 6.0]),
        (rounded_down, rounded_up, [2.0, 4.0]),
        (at_near, at_far, [2.0, 10.0]),
    ],
)
def test_what_it_calls_has_but_another_name_in_it_and_it_is_compiled_anew(
    one: Any, other: Any, expected: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Names are no part of Python's byte code: it says "the second name".
    found = []
    for called_now in (one, other):
        monkeypatch.setitem(globals(), "inner", jit_cached(called_now))
        found.append(jit_cached(scaled)(1.0))
    assert found == expected


@pytest.mark.usefixtures("kept")
def test_an_index_that_points_to_what_was_kept_before_is_not_believed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert jit_cached(scaled)(1.0) == 6.0
    # The file is edited, and the disk takes the index, which comes first, but no machine code.
    locator = numba.core.caching.UserProvidedCacheLocator
    monkeypatch.setattr(locator, "get_source_stamp", lambda _: "edited")
    monkeypatch.setitem(globals(), "FACTOR", 10.0)
    with monkeypatch.context() as disk:

        def full(*_: Any) -> None:
            raise OSError(28, "No space left on device")

        disk.setattr(numba.core.caching.IndexDataCacheFile, "_save_data", full)
        assert jit_cached(scaled)(1.0) == 30.0
    assert jit_cached(scaled)(1.0) == 30.0


@pytest.mark.usefixtures("kept")
@pytest.mark.parametrize(
    ("name", "value", "expected"), [("FACTOR", 10.0, 30.0), ("inner", jit_cached(halved), 1.0)]
)
def test_what_it_calls_or_takes_from_elsewhere_has_changed_and_it_is_compiled_anew(
    name: str, value: Any, expected: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The file of `scaled` is as it was, which is all that numba looks at.
    assert jit_cached(scaled)(1.0) == 6.0
    monkeypatch.setitem(globals(), name, value)
    assert jit_cached(scaled)(1.0) == expected


@pytest.mark.usefixtures("kept")
def test_what_calls_others_is_found_again_while_nothing_has_changed() -> None:
    first: Any = jit_cached(scaled)
    again: Any = jit_cached(scaled)
    assert first(1.0) == again(1.0) == 6.0
    assert sum(again.stats.cache_hits.values()) == 1
