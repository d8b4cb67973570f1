"""Differences of the two firmwares of MX servos: protocol, model numbers, registers.

The factory's firmware uses Protocol 1.0. "MX(2.0)" firmware uses 2.0 and has another control table
and another model number. Sources: hardware.md 5, e-manual mx-28.md, mx-64.md and their `-2` pages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from devices.chips.dynamixel.protocol import PROTOCOL_1, PROTOCOL_2, DynamixelProtocol

COUNTS_PER_TURN = 4096
"""Encoder counts per turn of every MX servo (hardware.md 5)."""


class CountRange(Enum):
    """Range of a servo's count, which depends on its operating mode."""

    ONE_TURN = "one turn"
    """Position control (joint mode): the joint stays within the turn that the encoder measures."""
    MANY_TURNS = "many turns"
    """Multi-turn: the count continues beyond a turn, from its value at power-up."""
    WRAPPED = "wrapped"
    """Wheel mode of Protocol 1.0: the joint turns on, the count stays within a turn."""


@dataclass(frozen=True, slots=True)
class Register:
    """Register of a control table."""

    address: int
    size: int
    """Bytes to read: never two in 1.0, see `devices.chips.dynamixel.protocol`."""


@dataclass(frozen=True, slots=True)
class Firmware:
    """Protocol and registers of a firmware."""

    protocol: DynamixelProtocol
    model_numbers: Mapping[str, int]
    """Model number at address 0, by the model's name."""
    position_address: int
    position_bytes: int
    """Bytes of the present position: little-endian, signed, beyond one turn in multi-turn mode."""
    position_read_bytes: int
    """Bytes to read from there: in 1.0 one more, see `devices.chips.dynamixel.protocol`."""
    tick_register: Register
    """Realtime Tick: its first two bytes are milliseconds since power-up."""
    mode_register: Register
    """Operating Mode; in 1.0 the limits of the angle, CW and CCW, which decide the mode."""

    def get_count_range(self, mode_bytes: bytes) -> CountRange:
        """Return the range of the count for the content of the register `mode`."""
        if self.protocol.version == 2:
            return (
                CountRange.ONE_TURN if mode_bytes[0] == _POSITION_CONTROL else CountRange.MANY_TURNS
            )
        limits = mode_bytes[:4]
        if limits == _WHEEL:
            return CountRange.WRAPPED
        return CountRange.MANY_TURNS if limits == _MULTI_TURN else CountRange.ONE_TURN


_POSITION_CONTROL = 3  # of Operating Mode (e-manual mx-64-2.md)
_WHEEL, _MULTI_TURN = bytes(4), b"\xff\x0f\xff\x0f"  # both limits 0, both 4095 (mx-64.md)


FIRMWARES = {
    1: Firmware(
        PROTOCOL_1,
        {"MX-28": 29, "MX-64": 310},
        36,
        position_bytes=2,
        position_read_bytes=3,
        tick_register=Register(50, 3),
        mode_register=Register(6, 4),
    ),
    2: Firmware(
        PROTOCOL_2,
        {"MX-28": 30, "MX-64": 311},
        132,
        position_bytes=4,
        position_read_bytes=4,
        tick_register=Register(120, 2),
        mode_register=Register(11, 1),
    ),
}
"""Firmwares by protocol version."""


def find_model(model_number: int) -> tuple[str, int] | None:
    """Look up a model's name and protocol by its number; None if it is no MX-28 or MX-64."""
    for version, firmware in FIRMWARES.items():
        for name, its_number in firmware.model_numbers.items():
            if its_number == model_number:
                return name, version
    return None
