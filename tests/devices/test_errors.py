"""Errors keep their facts, wherever they are caught and however they travel."""

from __future__ import annotations

import copy
import pickle
import platform
import sys
from collections.abc import Iterator

import pytest

from devices.errors import (
    BusFaultError,
    BusMisuseError,
    BusSetupError,
    CalibrationError,
    FileFormatError,
    FootTileError,
    I2cError,
    LoadTraceError,
    MissingExtraError,
    NoAcknowledgeError,
    SceneError,
    ServoError,
    ServoPacketError,
    ServoSetupError,
    ServoStatusError,
    ServoTimeoutError,
    TareError,
    TileSetupError,
    UsageError,
    require_extra,
)


def iterate_kinds(kind: type[FootTileError]) -> Iterator[type[FootTileError]]:
    if kind.__module__ == "devices.errors":
        yield kind
    for child in kind.__subclasses__():
        yield from iterate_kinds(child)


@pytest.mark.parametrize("kind", sorted({*iterate_kinds(FootTileError)}, key=str))
def test_an_error_keeps_its_facts_through_pickling_and_copying(kind: type[FootTileError]) -> None:
    error = kind("it broke", where="tile T02", expected="a whole one", remedy="Mend it")
    pickled: FootTileError = pickle.loads(pickle.dumps(error))  # noqa: S301  # our own
    for again in (error, pickled, copy.copy(error), copy.copy(pickled)):
        assert type(again) is kind
        assert (again.what, again.where) == ("it broke", "tile T02")
        assert (again.expected, again.remedy) == ("a whole one", "Mend it")
        assert str(again) == "tile T02: it broke; expected a whole one. Mend it"
    assert str(kind("it broke")) == "it broke"
    assert str(kind("did it break?", remedy="Mend it")) == "did it break? Mend it"
    # 2: the user can correct it in the command line.
    assert kind.exit_code == (2 if issubclass(kind, SceneError | UsageError) else 1)


@pytest.mark.parametrize(
    "kind", [I2cError, NoAcknowledgeError, BusFaultError, BusMisuseError, BusSetupError]
)
def test_the_errno_of_the_adapter_survives_pickling(kind: type[I2cError]) -> None:
    again = pickle.loads(pickle.dumps(kind("no acknowledge", where="bus", errno=121)))  # noqa: S301  # our own
    assert isinstance(again, kind)
    assert again.errno == again.to_dict()["errno"] == 121
    assert str(again) == "bus: no acknowledge"


@pytest.mark.parametrize(
    ("kind", "bases"),
    [
        (SceneError, {ValueError}),
        (UsageError, {ValueError}),
        (LoadTraceError, {ValueError}),
        (FileFormatError, {ValueError}),
        (CalibrationError, {ValueError}),
        (TareError, {ValueError}),
        (NoAcknowledgeError, {OSError, I2cError}),
        (BusFaultError, {OSError, I2cError}),
        (BusMisuseError, {OSError, I2cError}),
        (BusSetupError, {OSError, I2cError}),
        (ServoSetupError, {ServoError}),
        (ServoPacketError, {ServoError, ValueError}),
        (ServoStatusError, {ServoError}),
        (ServoTimeoutError, {ServoError, OSError, TimeoutError}),
        (TileSetupError, set()),
    ],
)
def test_an_error_is_caught_by_these_types_and_no_others(
    kind: type[FootTileError], bases: set[type[Exception]]
) -> None:
    asked: list[type[Exception]] = [
        *(ValueError, OSError, TimeoutError, I2cError, ServoError),
        *(NoAcknowledgeError, BusFaultError, BusMisuseError, BusSetupError),
    ]
    assert {base for base in asked if base is not kind and issubclass(kind, base)} == bases


def test_a_missing_package_is_named_with_the_extra_that_brings_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "scipy", None)
    with (
        pytest.raises(MissingExtraError, match=r"an emulated array needs scipy.*'foottile\[emul"),
        require_extra("emulation", "an emulated array"),
    ):
        import scipy.signal  # noqa: F401  # its failure is the test


def test_a_missing_module_of_foottile_is_no_missing_extra() -> None:
    with pytest.raises(ModuleNotFoundError), require_extra("server", "a server"):
        raise ModuleNotFoundError("no such module", name="service.no_such_module")


@pytest.mark.parametrize("machine", ["aarch64", "armv7l", "x86_64"])
def test_an_extra_without_wheels_for_arm_says_so_where_it_is_asked_for(
    machine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: machine)
    for extra in ("mocap", "video"):
        with (
            pytest.raises(MissingExtraError, match=rf"foottile\[{extra}\]") as caught,
            require_extra(extra, "it"),
        ):
            raise ModuleNotFoundError(name="ezc3d")
        has_none = extra == "mocap" and machine != "x86_64"
        assert ("no wheel for ARM" in str(caught.value)) == has_none
