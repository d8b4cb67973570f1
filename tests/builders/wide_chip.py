"""A second kind of pressure chip: 24 bits, compensated by itself, two addresses. No real one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from devices.buses.i2c import I2cBus, i2c_msg
from devices.chips.pressure_chip import Counts, PressureChip, PressureLaw, Registers
from devices.emulation.fault_timing import PartFaults
from devices.emulation.i2c_bus import OnConversion
from devices.emulation.parts import make_rng
from devices.emulation.surroundings import ChipSite
from devices.errors import TileSetupError
from devices.flags import TileFlag
from devices.scene.hardware_sections import TileSection
from devices.scene.scene_file import Scene

IDENTITY = (0x50, 0x32)
COUNTS_PER_KPA = 64_000
COUNTS_PER_KELVIN = 65_536
OFFSET_COUNTS = 1 << 23
"""Makes a signed temperature unsigned, and 65535 counts -127 degC."""
_CONVERT, _DATA, _IDENTITY = 0x36, 0x1D, 0x01
_CONVERSION_NS = 1_500_000


class WideDriver:
    """Its `ChipDriver`: temperature and pressure, three bytes each, low byte first."""

    def __init__(self, bus: I2cBus, address: int) -> None:
        self._bus, self._address = bus, address
        self.starts = 0

    def start_up(self) -> None:
        self.starts += 1

    def read_registers(self) -> Registers:
        identity, revision = self._read(_IDENTITY, 2)
        return identity, revision

    def identify(self, *, where: str) -> Registers:
        if (registers := self.read_registers()) != IDENTITY:
            raise TileSetupError(f"registers {registers} are no wide chip's", where=where)
        return registers

    def start_conversion(self) -> None:
        self._bus.transfer(i2c_msg.write(self._address, [_CONVERT, 1]))

    def read_counts(self) -> Counts:
        data = self._read(_DATA, 6)
        temperature = int.from_bytes(data[:3], "little", signed=True)
        return int.from_bytes(data[3:], "little"), temperature + OFFSET_COUNTS

    def read_pressure(self) -> int | None:
        return int.from_bytes(self._read(_DATA + 3, 3), "little")

    def classify_counts(self, pressure_raw: int, temperature_raw: int) -> int:
        return TileFlag.NOT_CONVERTED if pressure_raw == 0 else 0

    def _read(self, register: int, count: int) -> bytes:
        message = i2c_msg.read(self._address, count)
        self._bus.transfer(i2c_msg.write(self._address, [register]), message)
        return bytes(message)


WIDE_CHIP = PressureChip(
    name="wide",
    addresses=(0x46, 0x47),
    min_kpa=30.0,
    max_kpa=125.0,
    raw_type=np.dtype(np.uint32),
    counts_max=(2**24 - 1, 2**24 - 1),
    wrap_counts=0,
    counts_per_kelvin=COUNTS_PER_KELVIN,
    temperature_raw_at_25_degc=OFFSET_COUNTS + 25.0 * COUNTS_PER_KELVIN,
    temperature_raw_usual=OFFSET_COUNTS + 25.0 * COUNTS_PER_KELVIN,
    conversion_typical_ns=_CONVERSION_NS,
    conversion_max_ns=2_000_000,
    sample_delay_divisor=2,
    pressure_bytes=3,
    counts_bytes=6,
    readable_register=_IDENTITY,
    jump_kpa=0.5,
    far_jump_kpa=1.5,
    jump_temperature_counts=COUNTS_PER_KELVIN,
    make_law=lambda _: PressureLaw(0.0, 1.0 / COUNTS_PER_KPA, 0.0, 0.0, 1.0, 0.0),
    make_driver=WideDriver,
)


class EmulatedWideChip:
    """Its emulation: conversions that take time, noise of 50 counts, no faults."""

    sample_delay_ns = 0

    def __init__(self, address: int, serial: str, site: ChipSite) -> None:
        self.on_conversion: OnConversion | None = None
        self.address = address
        self._site = site
        self._rng = make_rng(f"wide/{site.noise_label}/{serial}")
        self.interrupt_supply()

    def interrupt_supply(self) -> None:
        self._registers = bytearray(128)
        self._registers[_IDENTITY : _IDENTITY + 2] = bytes(IDENTITY)
        self._written = bytearray()
        self._pending: tuple[int, bytes] | None = None

    def on_address(self, reading: bool, t_ns: int) -> bool:
        if self._pending is not None and t_ns >= self._pending[0]:
            self._registers[_DATA : _DATA + 6] = self._pending[1]
            self._pending = None
        if not reading:
            self._written.clear()
        return True

    def receive_byte(self, value: int) -> bool:
        self._written.append(value)
        return True

    def send_bytes(self, count: int) -> bytes:
        begin = self._written[0]
        return bytes(self._registers[begin : begin + count])

    def on_stop(self, t_ns: int) -> None:
        if bytes(self._written) == bytes([_CONVERT, 1]):
            t_s = self._site.to_scene_s(t_ns + _CONVERSION_NS // 2)
            noise, warmth = (50.0 * self._rng.standard_normal(2)).tolist()
            pressure = self._site.compute_kpa(t_s, t_ns) * COUNTS_PER_KPA + noise
            temperature = self._site.compute_degc(t_s) * COUNTS_PER_KELVIN + warmth
            data = round(temperature).to_bytes(3, "little", signed=True)
            data += round(pressure).to_bytes(3, "little")
            self._pending = t_ns + _CONVERSION_NS, data
            self._written.clear()


def make_wide_chip(
    tile: TileSection,
    scene: Scene,
    parts_seed: int,
    faults: PartFaults,
    make_site: Callable[[str], ChipSite],
) -> EmulatedWideChip:
    return EmulatedWideChip(tile.chip_address, tile.serial, make_site(tile.serial))
