"""Compiled loops: the same numbers whatever becomes of the folder that they are kept in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numba.core.caching
import numba.core.config
import pytest

from devices.compiled import compiled


def tripled(x: float) -> float:
    return 3.0 * x


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where compiled loops are kept."""
    monkeypatch.setattr(numba.core.config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def called() -> tuple[float, int]:
    """The loop's result as after a new start, and how often it came from disk."""
    loop: Any = compiled(tripled)
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


def test_without_a_place_to_keep_it_it_is_compiled_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])
    assert compiled(tripled)(2.0) == 6.0


def test_on_a_full_disk_it_is_compiled_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(numba.core.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(numba.core.caching.IndexDataCacheFile, "save", full)
    assert compiled(tripled)(2.0) == 6.0


FACTOR = 2.0
inner = compiled(tripled)


def scaled(x: float) -> float:
    return FACTOR * inner(x)


def halved(x: float) -> float:
    return 0.5 * x


@pytest.mark.usefixtures("kept")
@pytest.mark.parametrize(
    ("name", "value", "expected"), [("FACTOR", 10.0, 30.0), ("inner", compiled(halved), 1.0)]
)
def test_what_it_calls_or_takes_from_elsewhere_has_changed_and_it_is_compiled_anew(
    name: str, value: Any, expected: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The file of `scaled` is as it was, which is all that numba looks at.
    assert compiled(scaled)(1.0) == 6.0
    monkeypatch.setitem(globals(), name, value)
    assert compiled(scaled)(1.0) == expected


@pytest.mark.usefixtures("kept")
def test_what_calls_others_is_found_again_while_nothing_has_changed() -> None:
    first: Any = compiled(scaled)
    again: Any = compiled(scaled)
    assert first(1.0) == again(1.0) == 6.0
    assert sum(again.stats.cache_hits.values()) == 1
