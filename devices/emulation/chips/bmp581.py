"""Emulated BMP581 at register level.

Source: BMP581 data sheet BST-BMP581-DS004 and hardware.md 12. What these leave open is chosen so
that it does not make the work of a driver easier: the start of a conversion takes a random time,
registers that need standby ignore other writes without a sign, and the part's clock is its own.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from devices.chips.bmp581 import (
    CHIP_ID,
    COMPENSATE,
    CONTINUOUS,
    CONVERSION_P_NS,
    COUNTS_PER_KELVIN,
    COUNTS_PER_KPA,
    DATA_READY,
    FILTER_COEFFICIENTS,
    FORCED,
    MODE_BITS,
    NO_DATA,
    NORMAL,
    NOT_DEEP,
    NVM_COMMAND,
    NVM_READY,
    POWER_ON_RESET,
    PRESSURE_ON,
    REGISTER_CHIP_ID,
    REGISTER_COMMAND,
    REGISTER_DSP_CONFIG,
    REGISTER_DSP_IIR,
    REGISTER_FIFO_DATA,
    REGISTER_FIFO_SELECT,
    REGISTER_INT_SOURCE,
    REGISTER_INT_STATUS,
    REGISTER_NVM_ADDRESS,
    REGISTER_NVM_DATA,
    REGISTER_ODR_CONFIG,
    REGISTER_OSR_CONFIG,
    REGISTER_PRESSURE,
    REGISTER_STATUS,
    REGISTER_TEMPERATURE,
    RESET_COMMAND,
    STANDBY,
)
from devices.emulation.fault_timing import PartFaults
from devices.emulation.i2c_bus import OnConversion
from devices.emulation.parts import make_part_rng, make_rng
from devices.emulation.surroundings import ChipSite
from devices.scene.hardware_sections import TileSection
from devices.scene.scene_file import Scene

_REVISION = 0x32
_REGISTERS = 0x80
_RESET_VALUES = {
    REGISTER_CHIP_ID: CHIP_ID,
    0x02: _REVISION,
    0x13: 0x30,  # DRIVE_CONFIG
    0x14: 0x35,  # INT_CONFIG
    REGISTER_STATUS: NVM_READY,
    REGISTER_DSP_CONFIG: COMPENSATE,
    REGISTER_ODR_CONFIG: 0x70,
    0x38: 0x80,  # OSR_EFF: valid
}
"""DS 7; OSR_EFF as a real part has it."""
_WRITABLE = {
    *range(0x13, 0x17),
    REGISTER_FIFO_SELECT,
    *range(REGISTER_NVM_ADDRESS, REGISTER_NVM_DATA + 2),
    *range(REGISTER_DSP_CONFIG, REGISTER_ODR_CONFIG + 1),
}
_IN_STANDBY_ONLY = {REGISTER_FIFO_SELECT, *range(REGISTER_NVM_ADDRESS, REGISTER_DSP_IIR + 1)}
"""Registers that ignore writes while conversions may run."""
_NVM_ROWS = 0x28
_READY_NS = 2_000_000  # after power-up or reset: silent until then
_NVM_READ_NS = 200_000
_START_UP_NS = (300_000, 1_500_000)  # of the first conversion after a change of mode
_TO_STANDBY_NS = 2_500_000  # the longest, after a conversion that is not finished
_DEEP_START_NS = 1_000_000  # later from deep standby
_T_NS = (1_000_000, 1_100_000, 1_500_000, 2_100_000, 3_300_000, 5_800_000, 10_800_000, 20_800_000)
_P_NS = (*CONVERSION_P_NS, 40_400_000, 80_400_000)
_NOISE_PA = (0.78, 0.58, 0.41, 0.30, 0.21, 0.15, 0.11, 0.08)  # DS table 9
_NOISE_K = 0.0055  # of a real part, once sampled
_TOLERANCE, _TOLERANCE_MAX = 0.017, 0.05  # of the clock: one sigma, and the data sheet's bound
_SLOW_FACTOR = 1.3
_UNCOMPENSATED = 1.02  # an assumption: plausible, but wrong
_ODR_HZ = (
    *(240.0, 218.537, 199.111, 179.2, 160.0, 149.333, 140.0, 129.855, 120.0, 110.164, 100.299),
    *(89.6, 80.0, 70.0, 60.0, 50.056, 45.025, 40.0, 35.0, 30.0, 25.005, 20.0, 15.0, 10.0, 5.0),
    *(4.0, 3.0, 2.0, 1.0, 0.5, 0.25, 0.125),
)
_FIFO_COUNT = 0x17
_FIFO_FRAMES = 32  # of one word
_CATCH_UP = 1024  # conversions that a filter may remember
_REMEMBERED_NS = 900_000_000  # domes give no older pressure: of a part that was silent for long

SampleFunction = Callable[[int], tuple[float, float]]
"""Function of a sample instant in ns that returns pressure in kPa and temperature in degC."""


@dataclass(frozen=True)
class Bmp581Part:
    """Fixed properties of one part.

    Attributes:
        part_id: its own id, four words.
        clock_factor: real over typical time of a conversion.
        sample: pressure and temperature at an instant, without the chip's noise.
        label: seed of noise and of start-up times.
    """

    part_id: tuple[int, ...]
    clock_factor: float
    sample: SampleFunction
    label: str


class EmulatedBmp581:
    """Emulated part: registers, modes, and conversions by the part's own clock.

    Args:
        part: its properties.
        address: 0x46 or 0x47.
        faults: its faults.
        make_replacement: makes the part that takes its place.
    """

    sample_delay_ns = 0
    """Delay of a sample after the instant that drivers assume."""

    def __init__(
        self,
        part: Bmp581Part,
        address: int,
        faults: PartFaults | None = None,
        make_replacement: Callable[[], Bmp581Part] | None = None,
    ) -> None:
        self.address = address
        self.on_conversion: OnConversion | None = None
        self.acknowledges_reset = True
        """The data sheet says that it does not; drivers that insist work on hardware."""
        self._part = part
        self._faults = faults if faults is not None else PartFaults()
        self._make_replacement = make_replacement
        self._rng = make_rng(part.label)
        self._seen_ns = self._t_ns = 0
        self.interrupt_supply()
        self._ready_ns = 0

    def interrupt_supply(self) -> None:
        """Reset: registers as after power-up, no result, and silence for a while."""
        self._registers = bytearray(_REGISTERS)
        for register, value in _RESET_VALUES.items():
            self._registers[register] = value
        self._set_word(REGISTER_TEMPERATURE, NO_DATA)
        self._set_word(REGISTER_PRESSURE, NO_DATA)
        self._registers[REGISTER_INT_STATUS] = POWER_ON_RESET
        self._memory_rows = {0x23 + i: word for i, word in enumerate(self._part.part_id)}
        self._pointer = 0
        self._expects_register = False
        self._commands: list[int] = []
        self._mode = STANDBY
        self._fifo: deque[bytes] = deque()
        self._ended_count = 0
        self._standby_ns = 0
        self._next_end_ns: int | None = None
        self._begin_ns = 0
        self._filtered: tuple[float, float] | None = None
        self._memory_ready_ns = 0
        self._ready_ns = self._t_ns + _READY_NS

    def on_address(self, reading: bool, t_ns: int) -> bool:
        """Handle the part's address; return the acknowledge."""
        since_ns, self._seen_ns = self._seen_ns, t_ns
        self._t_ns = t_ns
        faults = self._faults
        if faults.scene is None or faults.scene.is_any_possible:
            if faults.replaced.is_possible and faults.replaced.was_active_between(since_ns, t_ns):
                if self._make_replacement is not None:
                    self._part, self._make_replacement = self._make_replacement(), None
                self.interrupt_supply()
            if faults.unplugged.is_possible and faults.unplugged.was_active_between(since_ns, t_ns):
                self.interrupt_supply()
            if faults.no_answer(t_ns) or faults.unplugged(t_ns) or faults.replaced(t_ns):
                return False
        if t_ns < self._ready_ns:
            return False
        self._convert_until(t_ns)
        self._expects_register = not reading
        return True

    def receive_byte(self, value: int) -> bool:
        """Receive a register address, then data for it and those behind it."""
        if self._expects_register:
            self._pointer = value & 0x7F
            self._expects_register = False
            return True
        register, self._pointer = self._pointer, (self._pointer + 1) % _REGISTERS
        if register == REGISTER_COMMAND:
            return self._receive_command(value)
        if register in _WRITABLE and (register not in _IN_STANDBY_ONLY or self._is_in_standby):
            self._write(register, value)
        return True

    @property
    def _is_in_standby(self) -> bool:
        return self._mode == STANDBY and self._t_ns >= self._standby_ns

    def _receive_command(self, value: int) -> bool:
        self._commands.append(value)
        if value == RESET_COMMAND:
            self.interrupt_supply()
            return self.acknowledges_reset
        if tuple(self._commands[-2:]) == NVM_COMMAND and self._is_in_standby:
            row = self._registers[REGISTER_NVM_ADDRESS] & 0x3F
            word = self._memory_rows.get(row, 0) if row < _NVM_ROWS else 0
            self._registers[REGISTER_NVM_DATA : REGISTER_NVM_DATA + 2] = word.to_bytes(2, "little")
            self._memory_ready_ns = self._t_ns + _NVM_READ_NS
        return True

    def _write(self, register: int, value: int) -> None:
        if register == REGISTER_ODR_CONFIG:
            self._change_mode(value & MODE_BITS)
            value &= ~MODE_BITS
        elif register == REGISTER_OSR_CONFIG and self._mode in (NORMAL, CONTINUOUS):
            self._start_after(self._draw_start_up_ns())  # it begins anew
            self._fifo.clear()
        elif register == REGISTER_DSP_IIR:
            self._filtered = None
        self._registers[register] = value

    def _change_mode(self, mode: int) -> None:
        """Leave or enter a mode; another one is entered through standby only."""
        self._fifo.clear()
        if mode == STANDBY:
            if self._next_end_ns is not None:
                self._standby_ns = min(self._next_end_ns, self._t_ns + _TO_STANDBY_NS)
            self._mode, self._next_end_ns = STANDBY, None
        elif self._is_in_standby:
            deep = not self._registers[REGISTER_ODR_CONFIG] & NOT_DEEP
            self._mode = mode
            if mode != FORCED:
                self._filtered = None
            self._start_after(self._draw_start_up_ns() + deep * _DEEP_START_NS)

    def _draw_start_up_ns(self) -> int:
        return int(self._rng.integers(*_START_UP_NS))

    def _start_after(self, delay_ns: int) -> None:
        self._begin_ns = self._t_ns + delay_ns
        self._next_end_ns = self._begin_ns + self._conversion_ns()

    def _conversion_ns(self) -> int:
        osr = self._registers[REGISTER_OSR_CONFIG]
        usual_ns = _P_NS[osr >> 3 & 7] + _T_NS[osr & 7]
        slow = _SLOW_FACTOR if self._faults.slow(self._t_ns) else 1.0
        return round(usual_ns * self._part.clock_factor * slow)

    def _period_ns(self) -> int:
        if self._mode == CONTINUOUS:
            return self._conversion_ns()
        odr = self._registers[REGISTER_ODR_CONFIG] >> 2 & 0x1F
        return max(self._conversion_ns(), round(1e9 / _ODR_HZ[odr] * self._part.clock_factor))

    def _convert_until(self, t_ns: int) -> None:
        """Finish the conversions that end until an instant."""
        if self._next_end_ns is None or t_ns < self._next_end_ns:
            return
        if self._mode == FORCED:
            self._finish_conversion(self._next_end_ns)
            self._mode, self._next_end_ns = STANDBY, None
            return
        period_ns = self._period_ns()
        ended = 1 + (t_ns - self._next_end_ns) // period_ns
        last_ns = self._next_end_ns + (ended - 1) * period_ns
        remembered = _CATCH_UP if self._registers[REGISTER_DSP_IIR] else _FIFO_FRAMES
        remembered = min(ended, remembered)
        for back in range(remembered - 1, -1, -1):
            self._finish_conversion(last_ns - back * period_ns)
        self._next_end_ns = last_ns + period_ns

    def _finish_conversion(self, end_ns: int) -> None:
        if self._faults.stale(end_ns):
            return
        osr = self._registers[REGISTER_OSR_CONFIG]
        p_code, t_code = osr >> 3 & 7, osr & 7
        half_ns = round(_P_NS[p_code] * self._part.clock_factor) // 2
        kpa, degc = self._part.sample(max(end_ns - half_ns, self._t_ns - _REMEMBERED_NS))
        noise = self._rng.standard_normal(2).tolist()
        kpa += 1e-3 * _NOISE_PA[p_code] * noise[0]
        degc += _NOISE_K / math.sqrt(1 << t_code) * noise[1]
        shows = self._registers[REGISTER_DSP_CONFIG]
        if shows & COMPENSATE != COMPENSATE:
            kpa *= _UNCOMPENSATED
        filtered = self._filter(kpa, degc)
        temperature = _encode_degc(filtered[1] if shows & 0x08 else degc)
        pressure = _encode_kpa(filtered[0] if shows & 0x20 else kpa)
        self._set_word(REGISTER_TEMPERATURE, temperature)
        self._set_word(REGISTER_PRESSURE, pressure if osr & PRESSURE_ON else NO_DATA)
        select = self._registers[REGISTER_FIFO_SELECT]
        self._ended_count += 1
        if self._ended_count % (1 << (select >> 2 & 7)):
            select = 0  # decimated
        stored = b""
        if select & 1:
            stored += _encode_degc(filtered[1] if shows & 0x10 else degc).to_bytes(3, "little")
        if select & 2 and osr & PRESSURE_ON:
            stored += _encode_kpa(filtered[0] if shows & 0x40 else kpa).to_bytes(3, "little")
        if stored:
            self._fifo.append(stored)
            while len(self._fifo) * len(stored) > 3 * _FIFO_FRAMES:
                self._fifo.popleft()  # the oldest is lost without a sign
        if self._registers[REGISTER_INT_SOURCE] & DATA_READY:
            self._registers[REGISTER_INT_STATUS] |= DATA_READY
        if self.on_conversion is not None:
            begin_ns = end_ns - self._conversion_ns()
            self.on_conversion(begin_ns, (pressure, temperature), self._part.part_id)

    def _filter(self, kpa: float, degc: float) -> tuple[float, float]:
        """Filter a result; the first one behind standby fills the filter's memory."""
        codes = self._registers[REGISTER_DSP_IIR]
        if self._filtered is None:
            self._filtered = kpa, degc
        c_p, c_t = FILTER_COEFFICIENTS[codes >> 3 & 7], FILTER_COEFFICIENTS[codes & 7]
        old_kpa, old_degc = self._filtered
        self._filtered = (
            (c_p * old_kpa + kpa) / (c_p + 1),
            (c_t * old_degc + degc) / (c_t + 1),
        )
        return self._filtered

    def send_bytes(self, count: int) -> bytes:
        """Send bytes from the pointer on; results do not change within a burst."""
        begin = self._pointer
        if self._faults.all_ones.is_possible and self._faults.all_ones(self._t_ns):
            return b"\xff" * count
        if begin == REGISTER_FIFO_DATA:
            return self._send_fifo(count)
        self._pointer = (begin + count) % _REGISTERS
        places = [(begin + i) % _REGISTERS for i in range(count)]
        sent = bytes(self._show(register) for register in places)
        if REGISTER_INT_STATUS in places:
            self._registers[REGISTER_INT_STATUS] = 0  # a read clears all of its bits
        return sent

    def _send_fifo(self, count: int) -> bytes:
        """Send stored results; one that is read in part stays, and an empty FIFO sends 0x7F."""
        sent = b""
        while self._fifo and len(sent) + len(self._fifo[0]) <= count:
            sent += self._fifo.popleft()
        if self._fifo:
            sent += self._fifo[0]
        return sent.ljust(count, b"\x7f")[:count]

    def _show(self, register: int) -> int:
        value = self._registers[register]
        if register == REGISTER_ODR_CONFIG:
            value |= STANDBY if self._is_in_standby else self._mode or CONTINUOUS
        elif register == _FIFO_COUNT:
            value = len(self._fifo)
        elif register == REGISTER_STATUS and self._t_ns < self._memory_ready_ns:
            value &= ~NVM_READY
        return value

    def _set_word(self, register: int, word: int) -> None:
        self._registers[register : register + 3] = word.to_bytes(3, "little")

    def on_stop(self, t_ns: int) -> None:
        """Return at once: a byte takes effect when it is acknowledged."""


def _encode_degc(degc: float) -> int:
    return round(degc * COUNTS_PER_KELVIN) & 0xFFFFFF


def _encode_kpa(kpa: float) -> int:
    return min(max(round(kpa * COUNTS_PER_KPA), 0), 0x7FFFFF)


def make_chip(
    tile: TileSection,
    scene: Scene,
    parts_seed: int,
    faults: PartFaults,
    make_site: Callable[[str], ChipSite],
) -> EmulatedBmp581:
    """Make the chip of a scene's tile; `make_site` makes the site of a serial."""

    def make_part(serial: str) -> Bmp581Part:
        rng = make_part_rng("bmp581", serial, parts_seed)
        off = float(np.clip(_TOLERANCE * rng.standard_normal(), -_TOLERANCE_MAX, _TOLERANCE_MAX))
        site = make_site(serial)
        frozen_kpa = math.nan

        def sample(t_ns: int) -> tuple[float, float]:
            nonlocal frozen_kpa
            t_s = site.to_scene_s(t_ns)
            if math.isnan(frozen_kpa) or not site.is_frozen(t_ns):
                frozen_kpa = site.compute_kpa(t_s, t_ns)
            return frozen_kpa, site.compute_degc(t_s)

        part_id = tuple(int(word) for word in rng.integers(1, 0xFFFF, 4))
        return Bmp581Part(part_id, 1.0 + off, sample, site.noise_label)

    return EmulatedBmp581(
        make_part(tile.serial),
        tile.chip_address,
        faults,
        make_replacement=lambda: make_part(f"{tile.serial}.spare"),
    )
