"""What the firmwares of an MX servo differ in: protocol, model number, and where the position is.

The factory's firmware speaks Protocol 1.0. "MX(2.0)" firmware speaks 2.0, has another control table
and another model number. Sources: hardware.md 5, e-manual mx-28.md, mx-64.md and their `-2` pages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from devices.chips.dynamixel.packets import DynamixelProtocol
from devices.chips.dynamixel.protocol1 import PROTOCOL_1
from devices.chips.dynamixel.protocol2 import PROTOCOL_2

COUNTS_PER_TURN = 4096
"""Of every MX servo (hardware.md 5)."""


@dataclass(frozen=True, slots=True)
class Firmware:
    """One of the two firmwares."""

    protocol: DynamixelProtocol
    model_numbers: Mapping[str, int]
    """At address 0, by the model's name."""
    position_address: int
    position_bytes: int
    """Bytes of the present position: little-endian, signed, beyond one turn in multi-turn mode."""
    asked_bytes: int
    """How many are read from there: in 1.0 one more, see `devices.chips.dynamixel.protocol1`."""


FIRMWARES = {
    1: Firmware(PROTOCOL_1, {"MX-28": 29, "MX-64": 310}, 36, position_bytes=2, asked_bytes=3),
    2: Firmware(PROTOCOL_2, {"MX-28": 30, "MX-64": 311}, 132, position_bytes=4, asked_bytes=4),
}
"""By the protocol that they speak."""


def known_model(number: int) -> tuple[str, int] | None:
    """A model's name and the protocol of its firmware; None if it is no MX-28 or MX-64."""
    for version, firmware in FIRMWARES.items():
        for name, its_number in firmware.model_numbers.items():
            if its_number == number:
                return name, version
    return None
