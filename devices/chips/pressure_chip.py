"""Pressure chip: facts of a kind of chip, the law from its counts to kPa, and its transfers.

A kind is a `PressureChip`, made by its driver's module and listed in
`devices.chips.pressure_chips`. All other modules take a chip's facts from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.buses.i2c import I2cBus

Registers = tuple[int, ...]
"""Words that a part is identified by; opaque to all but its driver."""
Counts = tuple[int, int]
"""Counts of pressure and temperature."""


class ChipSettings(NamedTuple):
    """Settings of a chip in a scene."""

    oversampling: int = 1
    """Number of samples of the pressure in a conversion."""
    filter: int = 0
    """Coefficient of the chip's own low-pass; 0: none."""
    mode: Literal["continuous", "forced"] | None = None
    """Conversions that the part starts by itself, or on command; None: as is usual for the chip."""


@dataclass(frozen=True)
class PressureLaw:
    """Law from counts p, t to kPa: (a0 + (b1 + c12 t) p + b2 t) `unit_kpa` + `offset_kpa`.

    Of one part, or of n as arrays. A chip that compensates by itself has only `b1`.
    """

    a0: float | Floats
    b1: float | Floats
    b2: float | Floats
    c12: float | Floats
    unit_kpa: float | Floats
    offset_kpa: float | Floats

    def compute_kpa(self, pressure_raw: npt.ArrayLike, temperature_raw: npt.ArrayLike) -> Floats:
        """Compute absolute pressure; arguments broadcast.

        No clipping: counts past the range give pressures past it.
        """
        p = np.asarray(pressure_raw, dtype=np.float64)
        t = np.asarray(temperature_raw, dtype=np.float64)
        return np.asarray(compute_kpa(p, t, **vars(self)))

    def compute_kpa_per_count(self, temperature_raw: npt.ArrayLike) -> Floats:
        """Compute the pressure step of a pressure count; negative if counts fall with pressure."""
        t = np.asarray(temperature_raw, dtype=np.float64)
        return np.asarray(compute_kpa_per_count(t, self.b1, self.c12, self.unit_kpa))


def compute_kpa(
    p: Any, t: Any, a0: Any, b1: Any, b2: Any, c12: Any, unit_kpa: Any, offset_kpa: Any
) -> Any:
    """Compute a `PressureLaw` as bare arithmetic of floats or arrays, for compiled code."""
    return (a0 + (b1 + c12 * t) * p + b2 * t) * unit_kpa + offset_kpa


def compute_kpa_per_count(t: Any, b1: Any, c12: Any, unit_kpa: Any) -> Any:
    """Compute the pressure step of a count as bare arithmetic, for compiled code."""
    return (b1 + c12 * t) * unit_kpa


class ChipDriver(Protocol):
    """Transfers to the parts of one kind and address that the multiplexers connect.

    Every method may raise `I2cError`.
    """

    def start_up(self, settings: Registers) -> None:
        """Prepare a part after power-up.

        Raises:
            TileSetupError: it does not take its settings.
        """

    def identify(self, *, where: str) -> Registers:
        """Read a part's registers repeatedly, check them, and return them.

        Raises:
            TileSetupError: the readings differ, or are no such part's.
        """

    def read_registers(self) -> Registers:
        """Read a part's registers once, without a check."""

    def is_set_up_as(self, registers: Registers, settings: Registers) -> bool:
        """Return whether a quick look at a part finds these; it goes on converting."""

    def start_conversion(self) -> None:
        """Start one conversion of pressure and temperature in every connected part."""

    def has_new_counts(self) -> bool:
        """Return whether a conversion has ended since the last call; always without a status."""

    def read_counts(self) -> Counts:
        """Read the counts of the last finished conversion."""

    def read_pressure(self) -> int | None:
        """Read the pressure counts alone, which saves bus time; None if they prove nothing."""

    def read_new_pressures(self, at_once: int) -> list[int]:
        """Read the pressure of each conversion of a free-running part since the last call.

        Args:
            at_once: pressures of one transfer; one that is full is followed by another.
        """

    def read_temperature(self) -> int:
        """Read the temperature counts of the last finished conversion alone."""

    def classify_counts(self, pressure_raw: int, temperature_raw: int) -> int:
        """Return the tile flag of counts just read that no working part gives; 0 for others."""


@dataclass(frozen=True)
class PressureChip:
    """Kind of pressure chip.

    Attributes:
        name: name in scenes and descriptions of arrays.
        addresses: I2C addresses that a part may have, the usual one first.
        min_kpa: begin of the rated range.
        max_kpa: end of the rated range; a part may read somewhat beyond it.
        raw_type: type of a column of counts, unsigned.
        counts_max: largest count of pressure and of temperature.
        wrap_counts: modulus of pressure counts, which wrap beyond the rated range; 0: they do not.
        counts_per_kelvin: temperature counts per kelvin.
        temperature_noise_counts: standard deviation of a temperature reading.
        temperature_raw_at_25_degc: temperature counts at 25 degC; an estimate where the chip is not
            calibrated for it.
        temperature_raw_usual: temperature counts of a foot in use.
        has_status: True if the chip tells whether a conversion has ended.
        readable_register: first of twelve registers whose reading changes nothing.
        jump_kpa: distance from the median of the last three readings above which a healthy part's
            reading is rare, so that it is read again.
        far_jump_kpa: distance beyond any outlier of a healthy part: its identity is verified.
        jump_temperature_counts: change from frame to frame that no healthy part shows.
        oversamplings: numbers of samples that a reading may have.
        encode_settings: encodes a scene's settings of a tile for the driver; raises `UsageError`.
        is_free_running: returns whether a part with these settings starts conversions by itself.
        compute_read_bytes: computes the bytes of each read of a sample from settings: of the
            pressure alone, and with the temperature.
        bytes_per_conversion: bytes of each further conversion that a free-running part has stored.
        compute_conversion_ns: computes the typical and the longest time of a conversion from
            settings.
        compute_sample_delay_ns: computes the delay from the begin of a conversion to its sample
            instant, from settings and measured time.
        make_law: makes a part's law from its registers.
        make_driver: makes the driver of the parts at an address of a bus.
    """

    name: str
    addresses: tuple[int, ...]
    min_kpa: float
    max_kpa: float
    raw_type: np.dtype[Any]
    counts_max: Counts
    wrap_counts: int
    counts_per_kelvin: float
    temperature_noise_counts: float
    temperature_raw_at_25_degc: float
    temperature_raw_usual: float
    bytes_per_conversion: int
    has_status: bool
    readable_register: int
    jump_kpa: float
    far_jump_kpa: float
    jump_temperature_counts: int
    oversamplings: tuple[int, ...]
    encode_settings: Callable[[ChipSettings], Registers]
    is_free_running: Callable[[Registers], bool]
    compute_read_bytes: Callable[[Registers], tuple[tuple[int, ...], tuple[int, ...]]]
    compute_conversion_ns: Callable[[Registers], tuple[int, int]]
    compute_sample_delay_ns: Callable[[Registers, int], int]
    make_law: Callable[[Registers], PressureLaw]
    make_driver: Callable[[I2cBus, int], ChipDriver]

    def estimate_degc(self, temperature_raw: float) -> float:
        """Estimate the temperature of a part; within some 5 K for an uncalibrated chip."""
        return 25.0 + (temperature_raw - self.temperature_raw_at_25_degc) / self.counts_per_kelvin
