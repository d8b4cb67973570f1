"""Driver of the NXP MPL115A2: registers, coefficients, compensation and its inverse, transfers.

Source: MPL115A2 data sheet Rev. 10, "DS" below. The arithmetic is pure and works on arrays; the
driver class only transfers bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.buses.i2c import I2cBus, i2c_msg
from devices.errors import TileSetupError

ADDRESS = 0x60
"""I2C address, fixed for every part (DS 2): more than one on a bus needs a multiplexer."""

REGISTER_PADC = 0x00
REGISTER_COEFFICIENTS = 0x04
REGISTER_CONVERT = 0x12
"""DS table 4. The registers auto-increment in a read."""

CONVERSION_TYPICAL_NS = 1_600_000
CONVERSION_MAX_NS = 3_000_000
"""Longest conversion time (DS table 10), used for a part that is not measured."""

PRESSURE_MIN_KPA = 50.0
PRESSURE_MAX_KPA = 115.0
"""Upper end of the specified range, 50 to 115 kPa: the full scale of Pcomp (DS eq. 2)."""

COUNTS_MAX = 1023

TADC_PER_KELVIN = -5.35
"""Counts of `tadc` per kelvin (Linux' mpl115 driver, Freescale's answer; hardware.md 1.3)."""
_TADC_AT_25_DEGC = 472

SAMPLE_DELAY_DIVISOR = 4
"""Divisor of the conversion time for the sample instant. Pressure is sampled in the first part of a
conversion (DS table 7); a quarter is assumed, as the instant is not stated (hardware.md 1.4)."""

_KPA_PER_PCOMP = (PRESSURE_MAX_KPA - PRESSURE_MIN_KPA) / COUNTS_MAX
_SIGNED_WORDS = struct.Struct(">4h")
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
        """
        a0, b1, b2, c12 = _SIGNED_WORDS.unpack(struct.pack(">4H", *words))
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
        a0, b1, b2, c12 = struct.unpack(">4H", _SIGNED_WORDS.pack(*fixed))
        return a0, b1, b2, c12

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


def compensate_kpa(
    padc: npt.ArrayLike,
    tadc: npt.ArrayLike,
    a0: float | Floats,
    b1: float | Floats,
    b2: float | Floats,
    c12: float | Floats,
) -> Floats:
    """Compute absolute pressure in kPa from raw counts (DS 8.2, eq. 1 and 2).

    Both counts are unsigned; `tadc` is normally above 511 below about 20 degC. No clipping: counts
    past the specified range give pressures past it. Arguments broadcast.
    """
    p = np.asarray(padc, dtype=np.float64)
    t = np.asarray(tadc, dtype=np.float64)
    return np.asarray(compensate_kpa_jit(p, t, a0, b1, b2, c12))


def compensate_kpa_jit(p: Any, t: Any, a0: Any, b1: Any, b2: Any, c12: Any) -> Any:
    """Compute `compensate_kpa` as bare arithmetic of floats or arrays, for compiled code."""
    return (a0 + (b1 + c12 * t) * p + b2 * t) * _KPA_PER_PCOMP + PRESSURE_MIN_KPA


def compute_padc(
    pressure_kpa: npt.ArrayLike, tadc: npt.ArrayLike, coefficients: Coefficients
) -> Floats:
    """Compute the unrounded `padc` of a pressure: the exact inverse of `compensate_kpa`."""
    c = coefficients
    t = np.asarray(tadc, dtype=np.float64)
    pcomp = (np.asarray(pressure_kpa, dtype=np.float64) - PRESSURE_MIN_KPA) / _KPA_PER_PCOMP
    return np.asarray((pcomp - c.a0 - c.b2 * t) / (c.b1 + c.c12 * t))


def compute_kpa_per_padc(tadc: npt.ArrayLike, b1: float | Floats, c12: float | Floats) -> Floats:
    """Compute the pressure step of one count of `padc` in kPa.

    It is negative: `padc` falls as pressure rises.
    """
    return np.asarray(compute_kpa_per_padc_jit(np.asarray(tadc, dtype=np.float64), b1, c12))


def compute_kpa_per_padc_jit(t: Any, b1: Any, c12: Any) -> Any:
    """Compute `compute_kpa_per_padc` as bare arithmetic of floats or arrays, for compiled code."""
    return (b1 + c12 * t) * _KPA_PER_PCOMP


class Mpl115a2:
    """Transfers to the part that the multiplexers connect.

    Messages are built once; a read overwrites its buffer. A repeated START joins write and read of
    one transaction, as in DS figures 4 and 6.
    """

    def __init__(self, bus: I2cBus) -> None:
        self._bus = bus
        self._convert = i2c_msg.write(ADDRESS, [REGISTER_CONVERT, 0x00])
        self._point_at_counts = i2c_msg.write(ADDRESS, [REGISTER_PADC])
        self._counts = i2c_msg.read(ADDRESS, 4)
        self._padc = i2c_msg.read(ADDRESS, 2)
        self._point_at_coefficients = i2c_msg.write(ADDRESS, [REGISTER_COEFFICIENTS])
        self._coefficients = i2c_msg.read(ADDRESS, 8)

    def start_conversion(self) -> None:
        """Start one conversion of pressure and temperature in every connected part."""
        self._bus.transfer(self._convert)

    def read_counts(self) -> tuple[int, int]:
        """Read `padc` and `tadc` of the last finished conversion, 0..1023 each."""
        self._bus.transfer(self._point_at_counts, self._counts)
        padc, tadc = _UNSIGNED_WORDS.unpack(bytes(self._counts))
        return padc >> 6, tadc >> 6

    def read_padc(self) -> int:
        """Read `padc` alone, which saves 18 bits on the wire."""
        self._bus.transfer(self._point_at_counts, self._padc)
        return int.from_bytes(bytes(self._padc), "big") >> 6

    def read_coefficient_bytes(self) -> bytes:
        """Read the eight coefficient registers once, without a check."""
        self._bus.transfer(self._point_at_coefficients, self._coefficients)
        return bytes(self._coefficients)

    def read_coefficient_words(self, *, where: str, reads: int = 3) -> tuple[int, int, int, int]:
        """Read the four coefficient registers `reads` times, check them, return unsigned words.

        The protocol has no checksum, and a wrong coefficient is a silent, constant error for a
        whole session; hence the repetition and the plausibility check.

        Raises:
            TileSetupError: the readings differ or are implausible.
            I2cError: the transfer failed.
        """
        readings = set()
        for _ in range(reads):
            readings.add(self.read_coefficient_bytes())
        if len(readings) > 1:
            raise TileSetupError(
                f"{reads} readings of the coefficients differ: "
                + ", ".join(sorted(reading.hex(" ") for reading in readings)),
                where=where,
                remedy="The line is disturbed: shorten the leads, check pull-ups, or use 100 kHz",
            )
        a0, b1, b2, c12 = struct.unpack(">4H", readings.pop())
        reason = Coefficients.from_words((a0, b1, b2, c12)).find_implausibility()
        if reason:
            raise TileSetupError(
                f"the coefficients are no MPL115A2's: {reason}",
                where=where,
                remedy="Check that the tile is plugged in and that SDA is not stuck",
            )
        return a0, b1, b2, c12


def estimate_degc(tadc: float) -> float:
    """Estimate the temperature of `tadc`, within some 5 K: the chip is not calibrated for it.

    25 degC at 472 counts and -5.35 counts/K (hardware.md 1.3); the data sheet states no scale.
    """
    return 25.0 + (tadc - _TADC_AT_25_DEGC) / TADC_PER_KELVIN
