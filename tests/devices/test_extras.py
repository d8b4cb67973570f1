"""What an error says where a package is missing that an extra brings."""

from __future__ import annotations

import sys

import pytest

from devices.errors import MissingExtraError, require_extra


def test_a_missing_package_is_named_with_the_extra_that_brings_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "scipy", None)
    with (
        pytest.raises(MissingExtraError, match=r"an emulated array needs scipy.*'foottile\[emul"),
        require_extra("emulation", "an emulated array"),
    ):
        import scipy.signal  # noqa: F401  # that it cannot be is the test


def test_a_mistake_of_ours_is_no_missing_package() -> None:
    with pytest.raises(ModuleNotFoundError), require_extra("server", "a server"):
        raise ModuleNotFoundError("no such module", name="service.no_such_module")
