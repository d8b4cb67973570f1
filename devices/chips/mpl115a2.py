"""Driver of the NXP MPL115A2: registers, coefficients, the law of its counts, transfers.

Source: MPL115A2 data sheet Rev. 10, "DS" below. The arithmetic is pure; the driver class only
transfers bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.buses.i2c import I2cBus, i2c_msg
from devices.chips.pressure_chip import ChipSettings, Counts, PressureChip, PressureLaw, Registers
from devices.errors import TileSetupError, UsageError
from devices.flags import TileFlag

ADDRESS = 0x60
"""I2C address, fixed for every part (DS 2): more than one on a bus needs a multiplexer."""

REGISTER_PADC = 0x00
REGISTER_COEFFICIENTS = 0x04
REGISTER_CONVERT = 0x12
"""DS table 4. The registers auto-increment in a read."""

PRESSURE_MIN_KPA = 50.0
PRESSURE_MAX_KPA = 115.0
"""Upper end of the specified range, 50 to 115 kPa: the full scale of Pcomp (DS eq. 2)."""

COUNTS_MAX = 1023

CONVERSION_TYPICAL_NS = 1_600_000
CONVERSION_MAX_NS = 3_000_000
"""DS table 10."""

TADC_PER_KELVIN = -5.35
"""Counts of `tadc` per kelvin (Linux' mpl115 driver, Freescale's answer; hardware.md 1.3)."""

_KPA_PER_PCOMP = (PRESSURE_MAX_KPA - PRESSURE_MIN_KPA) / COUNTS_MAX
_IDENTIFY_READS = 3
_SIGNED_WORDS = struct.Struct(">4h")
_COEFFICIENT_WORDS = struct.Struct(">4H")
_UNSIGNED_WORDS = struct.Struct(">2H")


@dataclass(frozen=True)
class Coefficients:
    """Factory coefficients of a part (DS 8.1, table 5).

    `a0` in counts, `b1` and `b2` in counts per count, `c12` in counts per count squared.
    """

    a0: float
    b1: float
    b2: float
    c12: float

    @classmethod
    def from_words(cls, words: Sequence[int]) -> Coefficients:
        """Decode the registers a0, b1, b2, c12 from unsigned 16-bit words.

        a0 has 3 fractional bits, b1 13, b2 14; c12 is 14 bits wide, left-justified, with 13
        fractional bits behind 9 zeros: without its shift by two it is four times too large.

        Raises:
            UsageError: these are not four.
        """
        if len(words) != 4:
            raise UsageError(f"{len(words)} registers", expected="a0, b1, b2 and c12")
        a0, b1, b2, c12 = _SIGNED_WORDS.unpack(_COEFFICIENT_WORDS.pack(*words))
        return cls(a0=a0 / 8, b1=b1 / 8192, b2=b2 / 16384, c12=(c12 >> 2) / 4194304)

    def to_words(self) -> tuple[int, int, int, int]:
        """Encode the nearest representable coefficients as unsigned register words.

        Raises:
            struct.error: a coefficient does not fit its register.
        """
        fixed = (
            round(self.a0 * 8),
            round(self.b1 * 8192),
            round(self.b2 * 16384),
            round(self.c12 * 4194304) << 2,
        )
        a0, b1, b2, c12 = _COEFFICIENT_WORDS.unpack(_SIGNED_WORDS.pack(*fixed))
        return a0, b1, b2, c12

    def make_law(self) -> PressureLaw:
        """Make the law of the part's counts (DS 8.2, eq. 1 and 2).

        Both counts are unsigned; `tadc` is normally above 511 below about 20 degC, and `padc` falls
        as pressure rises.
        """
        return PressureLaw(self.a0, self.b1, self.b2, self.c12, _KPA_PER_PCOMP, PRESSURE_MIN_KPA)

    def find_implausibility(self) -> str:
        """Return the reason why no working part has these coefficients; empty if plausible.

        All known parts have a0 > 0, b1 < 0, b2 < 0, c12 > 0 (hardware.md 8). Eight zero bytes (SDA
        stuck low) or eight ones (no part) fail here: they would give a constant 50 kPa.
        """
        for name, sign in (("a0", 1), ("b1", -1), ("b2", -1), ("c12", 1)):
            value = getattr(self, name)
            if value * sign <= 0:
                return f"{name} = {value:g}, but every known part has it {'><'[sign < 0]} 0"
        return ""


def compute_padc(
    pressure_kpa: npt.ArrayLike, tadc: npt.ArrayLike, coefficients: Coefficients
) -> Floats:
    """Compute the unrounded `padc` of a pressure: the exact inverse of the part's law."""
    c = coefficients
    t = np.asarray(tadc, dtype=np.float64)
    pcomp = (np.asarray(pressure_kpa, dtype=np.float64) - PRESSURE_MIN_KPA) / _KPA_PER_PCOMP
    return np.asarray((pcomp - c.a0 - c.b2 * t) / (c.b1 + c.c12 * t))


class Mpl115a2:
    """Transfers to the part that the multiplexers connect (`ChipDriver`).

    Messages are built once; a read overwrites its buffer. A repeated START joins write and read of
    one transaction, as in DS figures 4 and 6.
    """

    def __init__(self, bus: I2cBus, address: int = ADDRESS) -> None:
        self._bus = bus
        self._convert = i2c_msg.write(address, [REGISTER_CONVERT, 0x00])
        self._point_at_counts = i2c_msg.write(address, [REGISTER_PADC])
        self._counts = i2c_msg.read(address, 4)
        self._padc = i2c_msg.read(address, 2)
        self._point_at_coefficients = i2c_msg.write(address, [REGISTER_COEFFICIENTS])
        self._coefficients = i2c_msg.read(address, 8)

    def start_up(self, settings: Registers) -> None:
        """Return at once: a part works as soon as it has its supply."""

    def is_set_up_as(self, registers: Registers, settings: Registers) -> bool:
        """Return whether the registers are a part's own."""
        return self.read_registers() == registers

    def has_new_counts(self) -> bool:
        """Return True: the chip cannot tell."""
        return True

    def start_conversion(self) -> None:
        """Start one conversion of pressure and temperature in every connected part."""
        self._bus.transfer(self._convert)

    def read_counts(self) -> Counts:
        """Read `padc` and `tadc` of the last finished conversion, 0..1023 each."""
        self._bus.transfer(self._point_at_counts, self._counts)
        padc, tadc = _UNSIGNED_WORDS.unpack(bytes(self._counts))
        return padc >> 6, tadc >> 6

    def read_pressure(self) -> int | None:
        """Read `padc` alone, which saves 18 bits on the wire; None at either end of its counts.

        There it cannot tell an overloaded part from a stuck line (hardware.md 8): `tadc` can.
        """
        self._bus.transfer(self._point_at_counts, self._padc)
        padc = int.from_bytes(bytes(self._padc), "big") >> 6
        return None if padc in (0, COUNTS_MAX) else padc

    def read_new_pressures(self, at_once: int) -> list[int]:
        """Return none: no part runs freely."""
        return []

    def read_temperature(self) -> int:
        """Read `tadc`, behind `padc`."""
        return self.read_counts()[1]

    def classify_counts(self, padc: int, tadc: int) -> int:
        """Return the tile flag of counts that no working part gives; 0 if they are possible."""
        if padc == tadc == 0:
            return TileFlag.NOT_CONVERTED  # registers after power-up
        # Both ends of the temperature are 100 K away from anything this foot survives.
        return TileFlag.IMPLAUSIBLE if tadc in (0, COUNTS_MAX) else 0

    def read_registers(self) -> Registers:
        """Read the four coefficient registers once, without a check, as unsigned words."""
        self._bus.transfer(self._point_at_coefficients, self._coefficients)
        return _COEFFICIENT_WORDS.unpack(bytes(self._coefficients))

    def identify(self, *, where: str) -> Registers:
        """Read the coefficient registers three times, check them, return unsigned words.

        The protocol has no checksum, and a wrong coefficient is a silent, constant error for a
        whole session; hence the repetition and the plausibility check.

        Raises:
            TileSetupError: the readings differ or are implausible.
            I2cError: the transfer failed.
        """
        readings = {self.read_registers() for _ in range(_IDENTIFY_READS)}
        if len(readings) > 1:
            raise TileSetupError(
                f"{_IDENTIFY_READS} readings of the coefficients differ: "
                + ", ".join(sorted(" ".join(f"{w:04x}" for w in each) for each in readings)),
                where=where,
                remedy="The line is disturbed: shorten the leads, check pull-ups, or use 100 kHz",
            )
        registers = readings.pop()
        if reason := Coefficients.from_words(registers).find_implausibility():
            raise TileSetupError(
                f"the coefficients are no MPL115A2's: {reason}",
                where=where,
                remedy="Check that the tile is plugged in and that SDA is not stuck",
            )
        return registers


def _refuse_settings(settings: ChipSettings) -> Registers:
    if settings not in (ChipSettings(), ChipSettings(mode="forced")):
        raise UsageError(
            f"oversampling = {settings.oversampling}, filter = {settings.filter}, mode = "
            f"{settings.mode}",
            expected="none of these keys: an mpl115a2 has no settings, and converts on command",
        )
    return ()


MPL115A2 = PressureChip(
    name="mpl115a2",
    addresses=(ADDRESS,),
    min_kpa=PRESSURE_MIN_KPA,
    max_kpa=PRESSURE_MAX_KPA,
    raw_type=np.dtype(np.uint16),
    counts_max=(COUNTS_MAX, COUNTS_MAX),
    wrap_counts=COUNTS_MAX + 1,
    counts_per_kelvin=TADC_PER_KELVIN,
    temperature_noise_counts=0.5,  # hardware.md 1.6
    # Within some 5 K: the data sheet states no scale (hardware.md 1.3).
    temperature_raw_at_25_degc=472.0,
    temperature_raw_usual=500.0,
    bytes_per_conversion=0,
    has_status=False,
    readable_register=REGISTER_COEFFICIENTS,
    # 1.7 % of a healthy part's readings are so far off (noise 0.165 kPa with outliers, hardware.md
    # 1.3), and none is beyond the second.
    jump_kpa=0.5,
    far_jump_kpa=1.5,
    jump_temperature_counts=5,  # a kelvin (hardware.md 8)
    oversamplings=(1,),
    encode_settings=_refuse_settings,
    is_free_running=lambda _: False,
    compute_read_bytes=lambda _: ((2,), (4,)),
    compute_conversion_ns=lambda _: (CONVERSION_TYPICAL_NS, CONVERSION_MAX_NS),
    # Pressure is sampled in the first part of a conversion (DS table 7); a quarter is assumed, as
    # the instant is not stated (hardware.md 1.4).
    compute_sample_delay_ns=lambda _, conversion_ns: conversion_ns // 4,
    make_law=lambda registers: Coefficients.from_words(registers).make_law(),
    make_driver=Mpl115a2,
)
"""The kind of chip of the paper's tiles."""
