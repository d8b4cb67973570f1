"""What the tests of an array share."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from smbus2 import i2c_msg

from tests.devices.rigs import CONVERT, READ, SCHEDULES, SELECT, TYPICAL_NS

BIT_NS = 2_500
WHOLE_NS = (4 * SELECT + CONVERT + 4 * READ) * BIT_NS + TYPICAL_NS  # simultaneous, four tiles

every_schedule = pytest.mark.parametrize("schedule", SCHEDULES)


def failing(
    number: int, when: Callable[[int, tuple[i2c_msg, ...]], bool]
) -> Callable[[int, tuple[i2c_msg, ...]], None]:
    def on_transaction(count: int, messages: tuple[i2c_msg, ...]) -> None:
        if when(count, messages):
            raise OSError(number, "injected")

    return on_transaction


def to_tiles(_: int, messages: tuple[i2c_msg, ...]) -> bool:
    return bool(messages[0].addr == 0x60)
