"""Driver of the Bosch BMP581: registers, settings, the law of its counts, transfers.

Source: BMP581 data sheet BST-BMP581-DS004, "DS" below; open points are marked in docs/hardware.md
12. The chip compensates and linearises by itself, and has a status register: a
repeated reading is told from a new one. It converts by itself (CONTINUOUS) or on command (FORCED).

A part is told by the id that is burnt into its memory. Its settings are OSR_CONFIG, DSP_IIR and
ODR_CONFIG. All registers written are read back: a write that a part ignores is acknowledged, and a
flipped bit may leave plausible pressures without compensation.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from devices.buses.i2c import I2cBus, i2c_msg
from devices.chips.pressure_chip import ChipSettings, Counts, PressureChip, PressureLaw, Registers
from devices.errors import NoAcknowledgeError, TileSetupError, UsageError
from devices.flags import TileFlag
from devices.frames import NOT_READ

ADDRESSES = (0x46, 0x47)
"""I2C addresses with pin SDO low and high (DS 5.6)."""

REGISTER_CHIP_ID = 0x01
REGISTER_INT_SOURCE = 0x15
REGISTER_FIFO_SELECT = 0x18
REGISTER_TEMPERATURE = 0x1D
REGISTER_PRESSURE = 0x20
REGISTER_INT_STATUS = 0x27
REGISTER_STATUS = 0x28
REGISTER_FIFO_DATA = 0x29
REGISTER_NVM_ADDRESS = 0x2B
REGISTER_NVM_DATA = 0x2C
REGISTER_DSP_CONFIG = 0x30
REGISTER_DSP_IIR = 0x31
REGISTER_OSR_CONFIG = 0x36
REGISTER_ODR_CONFIG = 0x37
REGISTER_COMMAND = 0x7E
"""DS 7. Registers auto-increment in a read and in a write, but FIFO_DATA."""

CHIP_ID = 0x50
"""Id of a BMP581, and of a BMP580, which has the same data."""
OTHER_IDS = {0x51: ", a BMP585", 0x58: ", a BMP280", 0x60: ", a BME280"}

RESET_COMMAND = 0xB6
NVM_COMMAND = (0x5D, 0xA5)
"""Sequence that reads the row of the memory at NVM_ADDRESS into NVM_DATA (DS 4.8)."""
NVM_ID_ROWS = (0x23, 0x24, 0x25, 0x26)
"""Rows of the memory with the part's own id (DS 4.9)."""

NVM_READY, NVM_ERROR = 0x02, 0x04
"""Bits of STATUS."""
DATA_READY, POWER_ON_RESET = 0x01, 0x10
"""Bits of INT_STATUS, which a read clears. Data ready is set only if INT_SOURCE enables it, though
no pin need be wired (DS 4.7)."""
COMPENSATE, SHOW_FILTERED = 0x03, 0x78
"""Bits of DSP_CONFIG: compensation of both words; data registers and FIFO behind the filter."""
FIFO_PRESSURES = 2
"""FIFO_SELECT: the FIFO stores the pressure of each conversion, 32 in all; bits 2 to 4 decimate."""
PRESSURE_ON = 0x40
"""Bit of OSR_CONFIG."""
NOT_DEEP, MODE_BITS = 0x80, 0x03
STANDBY, NORMAL, FORCED, CONTINUOUS = 0, 1, 2, 3
"""Bits and modes of ODR_CONFIG. Without NOT_DEEP a part may sleep deeply in standby, and starts
later."""

NO_DATA = 0x7F7F7F
"""Word of a result that does not exist: before the first conversion, also after a brown-out, and of
a pressure that is switched off. As a pressure it would be 130.558 kPa."""
COUNTS_PER_KPA = 64_000
COUNTS_PER_KELVIN = 65_536
TEMPERATURE_OFFSET = 1 << 23
"""Added to the signed temperature, as counts are unsigned; no part in use reads 65535 then."""

CONVERSION_P_NS = (1_000_000, 1_700_000, 2_900_000, 5_400_000, 10_400_000, 20_400_000)
CONVERSION_T_NS = (1_000_000, 1_000_000, 1_000_000, 1_000_000, 1_000_000, 1_100_000)
"""Typical times of the two parts of a conversion, for pressure oversampled 1, 2, 4, 8, 16 and 32
times, and temperature as DS table 9 has it: once, and twice in the last (DS table 4)."""
OVERSAMPLINGS = (1, 2, 4, 8, 16, 32)
FILTER_COEFFICIENTS = (0, 1, 3, 7, 15, 31, 63, 127)
"""Coefficients c of the filter y = (c y + x) / (c + 1), by their code (DS 4.4.4); 0: no filter."""
START_UP_MAX_NS = 3_000_000
"""Longest time from FORCED to the start of its conversion (DS table 4)."""
START_SPREAD_NS = 1_200_000
"""Time by which these starts differ, of real parts: hardware.md 12. An instant is as uncertain."""
_TOLERANCE_PERCENT = 5  # of a conversion's time (DS table 4)

FIFO_FRAMES, _FIFO_FRAME_BYTES = 32, 3
_POLLED_BITS = 3500
"""Bits of polling until a part that is not ready has failed: 3.5 ms at 1 MHz, 9 ms at 400 kHz. A
change of mode takes 2.5 ms, a reset 2 (DS table 4). A driver has no clock."""
_POLL_BITS, _SILENT_BITS = 39, 11
_COLD_DEGC, _HOT_DEGC = -60.0, 110.0  # beyond the rated -40 to 85


def encode_settings(settings: ChipSettings) -> Registers:
    """Encode a tile's settings as OSR_CONFIG, DSP_IIR and ODR_CONFIG.

    Raises:
        UsageError: the chip has no such setting, or a filter is asked for with single conversions,
            whose effect on the first conversion is not documented.
    """
    if settings.oversampling not in OVERSAMPLINGS:
        raise UsageError(
            f"oversampling = {settings.oversampling}",
            expected=f"of a bmp581 one of {', '.join(map(str, OVERSAMPLINGS))}",
        )
    if settings.filter not in FILTER_COEFFICIENTS:
        raise UsageError(
            f"filter = {settings.filter}",
            expected=f"of a bmp581 one of {', '.join(map(str, FILTER_COEFFICIENTS))}",
        )
    if settings.filter and settings.mode == "forced":
        raise UsageError(
            'filter beside mode = "forced"',
            expected='mode = "continuous": what a single conversion finds in the filter is not '
            "documented",
        )
    osr_p = OVERSAMPLINGS.index(settings.oversampling)
    osr_t = CONVERSION_T_NS[osr_p] != CONVERSION_T_NS[0]
    code = FILTER_COEFFICIENTS.index(settings.filter)
    mode = STANDBY if settings.mode == "forced" else CONTINUOUS
    return PRESSURE_ON | osr_p << 3 | osr_t, code << 3 | code, NOT_DEEP | mode


def is_free_running(settings: Registers) -> bool:
    """Return whether a part with these settings converts by itself."""
    return settings[2] & MODE_BITS == CONTINUOUS


def compute_read_bytes(settings: Registers) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the bytes of each read of a sample: of the pressure alone, and with the temperature.

    A free-running part sends two frames of its FIFO, and the temperature apart.
    """
    fifo = 2 * _FIFO_FRAME_BYTES  # one is usual, and the second tells that there is no more
    return ((fifo,), (fifo, 3)) if is_free_running(settings) else ((3,), (6,))


def compute_conversion_ns(settings: Registers) -> tuple[int, int]:
    """Return the typical and the longest time of a conversion, from its command or the last one."""
    index = settings[0] >> 3 & 7
    typical_ns = CONVERSION_P_NS[index] + CONVERSION_T_NS[index]
    longest_ns = typical_ns * (100 + _TOLERANCE_PERCENT) // 100
    return typical_ns, longest_ns + (0 if is_free_running(settings) else START_UP_MAX_NS)


def compute_sample_delay_ns(settings: Registers, conversion_ns: int) -> int:
    """Return the time from a conversion's begin to the middle of its pressure sample.

    The pressure is assumed to be the second part of a conversion. A filter c makes it older by c
    conversions in the mean. The measured time of a commanded conversion is the longest, so its
    start is late by half of the starts' spread.
    """
    late_ns = 0 if is_free_running(settings) else START_SPREAD_NS // 2
    filtered_ns = FILTER_COEFFICIENTS[settings[1] >> 3 & 7] * conversion_ns
    return conversion_ns - late_ns - filtered_ns - CONVERSION_P_NS[settings[0] >> 3 & 7] // 2


def make_law(registers: Registers) -> PressureLaw:
    """Make the law of a part's counts: 1/64 Pa each (DS 4.5).

    Raises:
        UsageError: these are no BMP581's registers.
    """
    if len(registers) != 1 + len(NVM_ID_ROWS) or registers[0] >> 8 != CHIP_ID:
        raise UsageError(
            f"registers {registers} of a bmp581", expected="chip and revision, and the part's id"
        )
    return PressureLaw(0.0, 1.0 / COUNTS_PER_KPA, 0.0, 0.0, 1.0, 0.0)


def _encode_registers(settings: Registers) -> tuple[int, ...]:
    """Encode INT_SOURCE, FIFO_SELECT, DSP_CONFIG, and the three registers of the settings."""
    osr, iir, odr = settings
    select = FIFO_PRESSURES if is_free_running(settings) else 0
    return DATA_READY, select, COMPENSATE | (SHOW_FILTERED if iir else 0), iir, osr, odr


def _is_torn(word: int) -> bool:
    """Return whether a word begins or ends as an empty one."""
    return word & 0xFFFF == NO_DATA & 0xFFFF or word >> 8 == NO_DATA >> 8


class Bmp581:
    """Transfers to the parts at an address that the multiplexers connect (`ChipDriver`)."""

    def __init__(self, bus: I2cBus, address: int = ADDRESSES[0]) -> None:
        self._bus, self._address = bus, address
        self._where = f"{bus.name}, address 0x{address:02x}"
        self._force = i2c_msg.write(address, [REGISTER_ODR_CONFIG, NOT_DEEP | FORCED])
        self._point_at_counts = i2c_msg.write(address, [REGISTER_TEMPERATURE])
        self._counts = i2c_msg.read(address, 6)
        self._point_at_fifo = i2c_msg.write(address, [REGISTER_FIFO_DATA])
        self._point_at_pressure = i2c_msg.write(address, [REGISTER_PRESSURE])
        self._pressure = i2c_msg.read(address, 3)

    def start_up(self, settings: Registers) -> None:
        """Reset a part, write its settings and read them back; it then converts if it runs freely.

        Without the reset a filter would keep its memory, and a part its flag of an older reset.

        Raises:
            TileSetupError: the part does not become ready, or ignores its settings.
        """
        self._read(REGISTER_CHIP_ID, 1)  # a part that is absent is not polled
        with suppress(NoAcknowledgeError):  # a part may not acknowledge its own reset (DS 7.36)
            self._write(REGISTER_COMMAND, RESET_COMMAND)
        self._check_memory(self._where)
        source, select, dsp, iir, osr, odr = _encode_registers(settings)
        # Filter and compensation are written in standby only, else they are lost; the mode is last.
        self._write(REGISTER_ODR_CONFIG, odr & ~MODE_BITS)
        self._write(REGISTER_DSP_CONFIG, dsp, iir)
        self._write(REGISTER_INT_SOURCE, source)
        if select:
            self._write(REGISTER_FIFO_SELECT, select)
        self._write(REGISTER_OSR_CONFIG, osr, odr)
        if not self._has_settings(settings):
            raise TileSetupError(
                "the part ignores its settings",
                where=self._where,
                remedy="Tie its pin CSB to VDDIO, check SDA and SCL, and cycle its supply",
            )

    def read_registers(self) -> Registers:
        """Read chip, revision and the part's id once, without a check; conversions stop then."""
        chip, revision = self._read(REGISTER_CHIP_ID, 2)
        if chip != CHIP_ID:
            return (chip << 8 | revision,)  # another chip is not written to
        (odr,) = self._read(REGISTER_ODR_CONFIG, 1)
        self._write(REGISTER_ODR_CONFIG, odr & ~MODE_BITS)
        self._wait_until(REGISTER_ODR_CONFIG, lambda odr: odr & MODE_BITS == STANDBY, "in standby")
        part_id = [self._read_memory(row) for row in NVM_ID_ROWS]
        self._write(REGISTER_ODR_CONFIG, odr)
        return (chip << 8 | revision, *part_id)

    def identify(self, *, where: str) -> Registers:
        """Read chip, revision and the part's id twice, check them, and return them.

        Raises:
            TileSetupError: the readings differ, are another chip's, or its memory is damaged.
        """
        (chip,) = self._read(REGISTER_CHIP_ID, 1)
        if chip != CHIP_ID:
            raise TileSetupError(
                f"chip id 0x{chip:02x}{OTHER_IDS.get(chip, '')}",
                where=where,
                expected=f"0x{CHIP_ID:02x}, a BMP581",
                remedy="Correct the scene's key `chip`, or check that SDA is not stuck",
            )
        self._check_memory(where)
        readings = {self.read_registers() for _ in range(2)}
        if len(readings) > 1:
            raise TileSetupError(
                "two readings of the part's id differ: "
                + ", ".join(" ".join(f"{word:04x}" for word in each) for each in readings),
                where=where,
                remedy="The line is disturbed: shorten the leads, check pull-ups, or use 100 kHz",
            )
        return readings.pop()

    def is_set_up_as(self, registers: Registers, settings: Registers) -> bool:
        """Return whether chip and settings are these; reading the part's id would stop it."""
        chip = int.from_bytes(self._read(REGISTER_CHIP_ID, 2), "big")
        return chip == registers[0] and self._has_settings(settings)

    def start_conversion(self) -> None:
        """Start one conversion of temperature and pressure in every connected part."""
        self._bus.transfer(self._force)

    def has_new_counts(self) -> bool:
        """Return whether a conversion has ended since this was last asked."""
        return bool(self._read(REGISTER_INT_STATUS, 1)[0] & DATA_READY)

    def read_counts(self) -> Counts:
        """Read both words of the last conversion in one burst, within which they do not change."""
        self._bus.transfer(self._point_at_counts, self._counts)
        data = bytes(self._counts)
        temperature = int.from_bytes(data[:3], "little", signed=True)
        return int.from_bytes(data[3:], "little"), temperature + TEMPERATURE_OFFSET

    def read_pressure(self) -> int | None:
        """Read the pressure alone; None if it proves nothing: no result, or a stuck line."""
        self._bus.transfer(self._point_at_pressure, self._pressure)
        word = int.from_bytes(bytes(self._pressure), "little")
        return None if word in (0, NO_DATA, (1 << 24) - 1) else word

    def read_new_pressures(self, at_once: int) -> list[int]:
        """Read the FIFO until it is empty: one pressure for each conversion since the last call.

        Their number is exact, and with it the part's clock can be followed: the chip stamps no
        time, and the data registers do not tell whether a conversion was missed.
        """
        words: list[int] = []
        message = i2c_msg.read(self._address, 3 * at_once)
        while True:
            self._bus.transfer(self._point_at_fifo, message)
            data = bytes(message)
            read = [int.from_bytes(data[i : i + 3], "little") for i in range(0, len(data), 3)]
            found = [word for word in read if word != NO_DATA]
            words += found
            if len(found) < len(read) or len(words) > FIFO_FRAMES:
                break
        # A result may end while the empty word is sent; torn, it would be plausible, and is sent
        # again. (Of whole ones every 2^16-th looks like that: its register tells.)
        if words and _is_torn(words[-1]) and self.read_pressure() != words[-1]:
            words.pop()
        return words

    def read_temperature(self) -> int:
        """Read the temperature alone."""
        word = int.from_bytes(self._read(REGISTER_TEMPERATURE, 3), "little", signed=True)
        return word + TEMPERATURE_OFFSET

    def classify_counts(self, pressure_raw: int, temperature_raw: int) -> int:
        """Return the tile flag of counts that no working part gives; 0 if they are possible."""
        if NO_DATA in (pressure_raw, temperature_raw - TEMPERATURE_OFFSET):
            return TileFlag.NOT_CONVERTED
        degc = (temperature_raw - TEMPERATURE_OFFSET) / COUNTS_PER_KELVIN
        is_far = temperature_raw != NOT_READ and not _COLD_DEGC < degc < _HOT_DEGC
        if pressure_raw == 0 or pressure_raw >> 23 or is_far:
            return TileFlag.IMPLAUSIBLE
        return 0

    def _check_memory(self, where: str) -> None:
        """Wait until a part is ready, and check the memory of its trim.

        Raises:
            TileSetupError: it does not become ready, or the memory is damaged.
        """
        status = self._wait_until(
            REGISTER_STATUS, lambda status: status & (NVM_READY | NVM_ERROR), "ready", where
        )
        if status & NVM_ERROR:
            raise TileSetupError(
                f"the part's memory is damaged: status 0x{status:02x}",
                where=where,
                remedy="Cycle its supply; if it stays so, replace the tile: its trim is lost",
            )

    def _read_memory(self, row: int) -> int:
        self._write(REGISTER_NVM_ADDRESS, row)
        for command in NVM_COMMAND:
            self._write(REGISTER_COMMAND, command)
        self._wait_until(
            REGISTER_STATUS, lambda status: status & NVM_READY, "ready after a read of its memory"
        )
        return int.from_bytes(self._read(REGISTER_NVM_DATA, 2), "little")

    def _has_settings(self, settings: Registers) -> bool:
        source, _, _, select = self._read(REGISTER_INT_SOURCE, 4)
        dsp, iir, *_, osr, odr = self._read(REGISTER_DSP_CONFIG, 8)
        if not is_free_running(settings):
            odr &= ~MODE_BITS  # a conversion may be running
        return (source, select, dsp, iir, osr, odr) == _encode_registers(settings)

    def _wait_until(
        self, register: int, is_ready: Callable[[int], int], what: str, where: str = ""
    ) -> int:
        """Poll a register until it is as expected; return it."""
        message = i2c_msg.read(self._address, 1)
        left_bits = _POLLED_BITS
        while left_bits > 0:
            left_bits -= _SILENT_BITS
            with suppress(NoAcknowledgeError):  # a part in its reset is silent
                self._bus.transfer_once(i2c_msg.write(self._address, [register]), message)
                (value,) = bytes(message)
                if is_ready(value):
                    return value
                left_bits -= _POLL_BITS - _SILENT_BITS
        raise TileSetupError(
            f"the part is not {what}",
            where=where or self._where,
            remedy="Check its supply, and that SDA is not stuck",
        )

    def _write(self, register: int, *values: int) -> None:
        self._bus.transfer(i2c_msg.write(self._address, [register, *values]))

    def _read(self, register: int, count: int) -> bytes:
        message = i2c_msg.read(self._address, count)
        self._bus.transfer(i2c_msg.write(self._address, [register]), message)
        return bytes(message)


BMP581 = PressureChip(
    name="bmp581",
    addresses=ADDRESSES,
    min_kpa=30.0,
    max_kpa=125.0,
    raw_type=np.dtype(np.uint32),
    counts_max=((1 << 24) - 1, (1 << 24) - 1),
    wrap_counts=0,
    counts_per_kelvin=COUNTS_PER_KELVIN,
    temperature_noise_counts=0.0055 * COUNTS_PER_KELVIN,  # of a real part (hardware.md 12)
    temperature_raw_at_25_degc=TEMPERATURE_OFFSET + 25.0 * COUNTS_PER_KELVIN,
    temperature_raw_usual=TEMPERATURE_OFFSET + 25.0 * COUNTS_PER_KELVIN,
    bytes_per_conversion=_FIFO_FRAME_BYTES,
    has_status=True,
    readable_register=REGISTER_CHIP_ID,
    # Between two readings of a walking foot; noise is 1 Pa.
    jump_kpa=0.5,
    far_jump_kpa=1.5,
    jump_temperature_counts=COUNTS_PER_KELVIN,
    oversamplings=OVERSAMPLINGS,
    encode_settings=encode_settings,
    is_free_running=is_free_running,
    compute_read_bytes=compute_read_bytes,
    compute_conversion_ns=compute_conversion_ns,
    compute_sample_delay_ns=compute_sample_delay_ns,
    make_law=make_law,
    make_driver=Bmp581,
)
"""A chip of phones: 200 times less noise than an MPL115A2, and two thirds more range."""
