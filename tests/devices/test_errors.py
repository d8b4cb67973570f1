"""Errors keep their facts, wherever they are caught and however they travel."""

from __future__ import annotations

import copy
import pickle
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
)


def family(kind: type[FootTileError]) -> Iterator[type[FootTileError]]:
    yield kind
    for child in kind.__subclasses__():
        yield from family(child)


EVERY_ERROR = sorted(
    {kind for kind in family(FootTileError) if kind.__module__ == "devices.errors"},
    key=lambda kind: kind.__name__,
)
I2C_ERRORS = [I2cError, NoAcknowledgeError, BusFaultError, BusMisuseError, BusSetupError]


@pytest.mark.parametrize("kind", EVERY_ERROR)
def test_the_text_is_made_of_the_facts(kind: type[FootTileError]) -> None:
    error = kind("it broke", where="tile T02", expected="a whole one", remedy="Mend it")
    assert str(error) == "tile T02: it broke; expected a whole one. Mend it"
    assert str(kind("it broke")) == "it broke"
    assert str(kind("it broke", remedy="Mend it")) == "it broke. Mend it"
    assert str(kind("did it break?", remedy="Mend it")) == "did it break? Mend it"


def travelled(error: FootTileError) -> FootTileError:
    arrived: FootTileError = pickle.loads(pickle.dumps(error))  # noqa: S301  # our own
    return arrived


@pytest.mark.parametrize("kind", EVERY_ERROR)
def test_facts_survive_pickling_and_copying(kind: type[FootTileError]) -> None:
    error = kind("it broke", where="tile T02", expected="a whole one", remedy="Mend it")
    for again in (travelled(error), copy.copy(error), travelled(travelled(error))):
        assert type(again) is kind
        assert (again.what, again.where) == ("it broke", "tile T02")
        assert (again.expected, again.remedy) == ("a whole one", "Mend it")
        assert str(again) == str(error)


@pytest.mark.parametrize("kind", I2C_ERRORS)
def test_the_errno_of_the_adapter_survives_pickling(kind: type[I2cError]) -> None:
    again = travelled(kind("no acknowledge", where="bus", errno=121))
    assert isinstance(again, kind)
    assert again.errno == 121
    assert again.to_dict()["errno"] == 121
    assert str(again) == "bus: no acknowledge"


@pytest.mark.parametrize("kind", EVERY_ERROR)
def test_an_error_is_usage_only_where_the_user_can_mend_it_in_what_he_typed(
    kind: type[FootTileError],
) -> None:
    assert kind.exit_code == (2 if issubclass(kind, (SceneError, UsageError)) else 1)


@pytest.mark.parametrize(
    ("kind", "builtin"),
    [
        (SceneError, ValueError),
        (UsageError, ValueError),
        (LoadTraceError, ValueError),
        (FileFormatError, ValueError),
        (CalibrationError, ValueError),
        (TareError, ValueError),
        (ServoPacketError, ValueError),
        (ServoTimeoutError, TimeoutError),
        *((kind, OSError) for kind in I2C_ERRORS),
    ],
)
def test_a_stranger_can_catch_it_by_a_builtin_type(
    kind: type[FootTileError], builtin: type[Exception]
) -> None:
    with pytest.raises(builtin, match="it broke"):
        raise kind("it broke")


def test_a_fault_of_one_device_is_told_from_a_fault_of_the_bus() -> None:
    for kind in I2C_ERRORS[1:]:
        assert issubclass(kind, I2cError)
        assert [other for other in I2C_ERRORS[1:] if issubclass(kind, other)] == [kind]


@pytest.mark.parametrize(
    "kind", [ServoSetupError, ServoTimeoutError, ServoPacketError, ServoStatusError]
)
def test_whatever_happens_to_a_servo_is_a_servo_error(kind: type[ServoError]) -> None:
    assert issubclass(kind, ServoError)
    assert not issubclass(kind, I2cError)


def test_a_tile_that_fails_at_start_up_is_no_bus_error() -> None:
    assert not issubclass(TileSetupError, (I2cError, OSError, ValueError))
