"""The BMP581: words against those of a real part, transfers against an emulated part.

Golden vectors: bytes of a real part that a third party's driver printed to full precision
(raspberrypi/firmware, issue 1994), and reset values of the data sheet (hardware.md 12).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from smbus2 import i2c_msg

from devices.buses.i2c import I2cBus, open_bus
from devices.chips import bmp581
from devices.chips.bmp581 import BMP581, Bmp581
from devices.chips.pressure_chip import ChipSettings
from devices.clock import VirtualClock
from devices.emulation.chips.bmp581 import Bmp581Part, EmulatedBmp581
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from devices.errors import NoAcknowledgeError, TileSetupError, UsageError
from devices.flags import TileFlag
from devices.frames import NOT_READ

PART_ID = (0x1234, 0x5678, 0x9ABC, 0xDEF0)
CONTINUOUS = BMP581.encode_settings(ChipSettings())
FORCED = BMP581.encode_settings(ChipSettings(mode="forced"))


class Bench:
    """One emulated part behind a mux, its driver and their clock."""

    def __init__(
        self,
        sample: Callable[[int], tuple[float, float]] = lambda _: (100.0, 25.0),
        clock_factor: float = 1.0,
        scl_hz: int = 400_000,
    ) -> None:
        self.clock = VirtualClock()
        self.chip = EmulatedBmp581(Bmp581Part(PART_ID, clock_factor, sample, "bench"), 0x46)
        mux = EmulatedTca9548a(0x70, [(2, self.chip)])
        adapter = EmulatedI2cAdapter([mux], self.clock, scl_hz)
        self.bus: I2cBus = open_bus("emulated", adapter)
        self.bus.transfer(i2c_msg.write(0x70, [0b100]))
        self.driver = Bmp581(self.bus, 0x46)

    def wait_ms(self, ms: float) -> None:
        self.clock.sleep_until_ns(self.clock.now_ns() + round(ms * 1e6))

    def read(self, register: int, count: int = 1) -> bytes:
        message = i2c_msg.read(0x46, count)
        self.bus.transfer(i2c_msg.write(0x46, [register]), message)
        return bytes(message)

    def write(self, register: int, *values: int) -> None:
        self.bus.transfer(i2c_msg.write(0x46, [register, *values]))


@pytest.mark.parametrize(
    ("data", "degc", "hpa"),
    [
        ("1f28193e3b62", 25.156723022460938, 1005.8896875),
        ("353a19633b62", 25.227371215820312, 1005.89546875),
        ("793619663b62", 25.212783813476562, 1005.8959375),
        ("322319813b62", 25.137481689453125, 1005.90015625),
        ("0000ff3e3b62", -1.0, 1005.8896875),
        ("0080e73e3b62", -24.5, 1005.8896875),
    ],
)
def test_words_of_a_real_part_are_its_pressure_and_temperature(
    data: str, degc: float, hpa: float
) -> None:
    bench = Bench()
    bench.chip._registers[0x1D:0x23] = bytes.fromhex(data)
    pressure_raw, temperature_raw = bench.driver.read_counts()
    law = BMP581.make_law((0x5032, *PART_ID))
    assert float(law.compute_kpa(pressure_raw, temperature_raw)) == pytest.approx(
        hpa / 10, rel=1e-15
    )
    assert BMP581.estimate_degc(temperature_raw) == degc
    assert bench.driver.classify_counts(pressure_raw, temperature_raw) == 0


def test_a_part_without_a_result_is_not_an_overload() -> None:
    bench = Bench()
    assert bench.read(0x1D, 6) == b"\x7f" * 6
    counts = bench.driver.read_counts()
    assert bench.driver.classify_counts(*counts) == TileFlag.NOT_CONVERTED
    assert bench.driver.read_pressure() is None


@pytest.mark.parametrize("data", [b"\x00" * 6, b"\xff" * 6])
def test_a_stuck_line_is_implausible(data: bytes) -> None:
    bench = Bench()
    bench.chip._registers[0x1D:0x23] = data
    assert bench.driver.classify_counts(*bench.driver.read_counts()) == TileFlag.IMPLAUSIBLE


def test_a_pressure_without_its_temperature_is_possible() -> None:
    assert Bench().driver.classify_counts(6_400_000, NOT_READ) == 0


def test_power_up_is_as_the_data_sheet_says() -> None:
    bench = Bench()
    assert bench.read(0x01, 2) == b"\x50\x32"
    assert bench.read(0x28) == b"\x02"
    assert bench.read(0x27) == b"\x10"
    assert bench.read(0x27) == b"\x00", "a read clears it"
    assert bench.read(0x36, 2) == b"\x00\x70"


def test_a_part_is_told_by_its_own_id() -> None:
    bench = Bench()
    assert bench.driver.identify(where="here") == (0x5032, *PART_ID)
    bench.driver.start_up(CONTINUOUS)
    bench.wait_ms(10)
    assert bench.driver.identify(where="here") == (0x5032, *PART_ID), "also while it converts"
    assert bench.read(0x37)[0] & 3 == 3, "and it goes on"


@pytest.mark.parametrize("osr", bmp581.OVERSAMPLINGS)
@pytest.mark.parametrize("factor", [0.95, 1.0, 1.05])
def test_a_free_running_part_converts_at_its_own_rate(osr: int, factor: float) -> None:
    bench = Bench(clock_factor=factor)
    bench.driver.start_up(BMP581.encode_settings(ChipSettings(oversampling=osr)))
    usual_ns, longest_ns = BMP581.compute_conversion_ns(
        BMP581.encode_settings(ChipSettings(oversampling=osr))
    )
    ended_ns = []
    bench.wait_ms(2)
    bench.driver.has_new_counts()  # one may have ended before
    for _ in range(20):
        while not bench.driver.has_new_counts():
            assert bench.clock.now_ns() < 10**10
        ended_ns.append(bench.clock.now_ns())
    mean_ns = (ended_ns[-1] - ended_ns[0]) / 19
    assert mean_ns == pytest.approx(factor * usual_ns, abs=10_000)
    assert mean_ns <= longest_ns + 10_000


@pytest.mark.parametrize("is_whole", [False, True])
def test_an_empty_word_of_the_fifo_that_is_torn_is_no_pressure(is_whole: bool) -> None:
    """100.86 kPa, if the chip writes while it sends; also a possible pressure."""
    torn = 0x627F7F
    bench = Bench()
    bench.driver.start_up(CONTINUOUS)
    bench.wait_ms(10)
    bench.driver.read_new_pressures(33)
    bench.chip._mode, bench.chip._next_end_ns = bmp581.STANDBY, None
    if is_whole:
        bench.chip._registers[0x20:0x23] = torn.to_bytes(3, "little")
    sent = (6_400_000).to_bytes(3, "little") + torn.to_bytes(3, "little")
    bench.chip._send_fifo = lambda count: sent.ljust(count, b"\x7f")  # type: ignore[method-assign]
    assert bench.driver.read_new_pressures(3) == [6_400_000, torn][: 1 + is_whole]


def test_data_ready_needs_its_source_and_no_wire() -> None:
    bench = Bench()
    bench.driver.start_up(CONTINUOUS)
    bench.wait_ms(10)
    bench.driver.has_new_counts()
    while not bench.driver.has_new_counts():
        assert bench.clock.now_ns() < 10**9
    assert not bench.driver.has_new_counts(), "the next one ends 2 ms later"
    bench.write(bmp581.REGISTER_INT_SOURCE, 0)
    bench.driver.has_new_counts()
    bench.wait_ms(10)
    assert not bench.driver.has_new_counts()


def test_a_command_gives_one_conversion() -> None:
    asked_ns: list[int] = []

    def sample(t_ns: int) -> tuple[float, float]:
        asked_ns.append(t_ns)
        return 101.0, 20.0

    bench = Bench(sample)
    bench.driver.start_up(FORCED)
    bench.wait_ms(20)
    assert not asked_ns
    bench.driver.start_conversion()
    bench.wait_ms(20)
    assert bench.driver.has_new_counts()
    assert len(asked_ns) == 1
    pressure_raw, temperature_raw = bench.driver.read_counts()
    assert pressure_raw / 64_000 == pytest.approx(101.0, abs=0.005)
    assert BMP581.estimate_degc(temperature_raw) == pytest.approx(20.0, abs=0.05)


def test_after_a_brown_out_a_part_has_no_result_and_no_settings() -> None:
    bench = Bench()
    bench.driver.start_up(CONTINUOUS)
    bench.wait_ms(10)
    registers = bench.driver.read_registers()
    assert bench.driver.is_set_up_as(registers, CONTINUOUS)
    bench.chip.interrupt_supply()
    bench.wait_ms(10)
    assert not bench.driver.is_set_up_as(registers, CONTINUOUS)
    assert bench.driver.classify_counts(*bench.driver.read_counts()) == TileFlag.NOT_CONVERTED
    bench.driver.start_up(CONTINUOUS)
    bench.wait_ms(10)
    assert bench.driver.classify_counts(*bench.driver.read_counts()) == 0


def test_a_reset_that_is_not_acknowledged_is_a_reset() -> None:
    bench = Bench()
    bench.chip.acknowledges_reset = False
    bench.driver.start_up(CONTINUOUS)
    with pytest.raises(NoAcknowledgeError):
        bench.write(bmp581.REGISTER_COMMAND, bmp581.RESET_COMMAND)


def test_settings_that_are_lost_are_said() -> None:
    bench = Bench()
    bench.chip._write = lambda register, value: None  # type: ignore[method-assign]
    with pytest.raises(TileSetupError, match="ignores its settings"):
        bench.driver.start_up(CONTINUOUS)


@pytest.mark.parametrize("settings", [CONTINUOUS, FORCED])
@pytest.mark.parametrize(("register", "bit"), [(0x15, 0x01), (0x18, 0x04), (0x30, 0x03)])
def test_a_flipped_bit_of_any_register_is_seen(
    register: int, bit: int, settings: tuple[int, ...]
) -> None:
    bench = Bench()
    bench.driver.start_up(settings)
    assert bench.driver.is_set_up_as((0x5032, *PART_ID), settings)
    bench.chip._registers[register] ^= bit
    assert not bench.driver.is_set_up_as((0x5032, *PART_ID), settings)
    assert bench.driver.read_registers() == (0x5032, *PART_ID)


def test_a_part_without_compensation_or_with_a_decimated_fifo_gives_plausible_pressures() -> None:
    bench = Bench()
    bench.driver.start_up(CONTINUOUS)
    bench.wait_ms(20)
    usual = bench.driver.read_new_pressures(33)
    bench.chip._registers[0x30], bench.chip._registers[0x18] = 0, bmp581.FIFO_PRESSURES | 4
    bench.wait_ms(20)
    found = bench.driver.read_new_pressures(33)
    assert len(found) == pytest.approx(len(usual) / 2, abs=1)
    assert all(0.5 < abs(word / 64_000 - 100.0) < 10.0 for word in found)
    assert not any(bench.driver.classify_counts(word, NOT_READ) for word in found)


def test_registers_of_standby_ignore_a_write_in_between() -> None:
    bench = Bench()
    bench.driver.start_up(CONTINUOUS)
    bench.wait_ms(5)
    bench.write(bmp581.REGISTER_DSP_IIR, 0x09)
    assert bench.read(bmp581.REGISTER_DSP_IIR) == b"\x00"


def test_registers_of_standby_ignore_a_write_until_the_mode_is_left() -> None:
    bench = Bench()
    bench.driver.start_up(BMP581.encode_settings(ChipSettings(oversampling=8)))
    bench.wait_ms(8)
    bench.write(bmp581.REGISTER_ODR_CONFIG, bmp581.NOT_DEEP)
    assert bench.read(bmp581.REGISTER_ODR_CONFIG)[0] & 3 == bmp581.CONTINUOUS
    bench.write(bmp581.REGISTER_DSP_IIR, 0x09)
    assert bench.read(bmp581.REGISTER_DSP_IIR) == b"\x00"
    bench.wait_ms(3)
    bench.write(bmp581.REGISTER_DSP_IIR, 0x09)
    assert bench.read(bmp581.REGISTER_DSP_IIR) == b"\x09"


def test_a_mode_is_left_through_standby_only() -> None:
    bench = Bench()
    bench.driver.start_up(CONTINUOUS)
    bench.wait_ms(5)
    bench.write(bmp581.REGISTER_ODR_CONFIG, 0x80 | bmp581.FORCED)
    assert bench.read(bmp581.REGISTER_ODR_CONFIG)[0] & 3 == bmp581.CONTINUOUS


@pytest.mark.parametrize("c", bmp581.FILTER_COEFFICIENTS[1:])
def test_the_filter_is_the_data_sheets(c: int) -> None:
    """A step of 10 kPa rests behind n conversions at the part (c / (c + 1)) ** n."""
    step_ns = 30_000_000
    bench = Bench(lambda t_ns: (100.0 if t_ns < step_ns else 110.0, 25.0))
    bench.driver.start_up(BMP581.encode_settings(ChipSettings(filter=c)))
    ends: list[int] = []
    bench.chip.on_conversion = lambda begin_ns, counts, _: ends.append(counts[0])
    bench.wait_ms(60)
    bench.driver.read_counts()
    after = [word / 64_000 for word in ends if word / 64_000 > 100.02]
    assert len(after) > 5
    for n, kpa in enumerate(after, 1):
        assert 110.0 - kpa == pytest.approx(10.0 * (c / (c + 1)) ** n, abs=0.01)


@pytest.mark.parametrize("c", [0, 1, 3, 7])
def test_a_filtered_pressure_is_that_of_its_sample_instant(c: int) -> None:
    bench = Bench(lambda t_ns: (100.0 + 1e-8 * t_ns, 25.0))
    settings = BMP581.encode_settings(ChipSettings(filter=c))
    delay_ns = BMP581.compute_sample_delay_ns(settings, 2_000_000)
    bench.driver.start_up(settings)
    errors_ns: list[float] = []
    bench.chip.on_conversion = lambda begin_ns, counts, _: errors_ns.append(
        (counts[0] / 64_000 - 100.0) * 1e8 - begin_ns - delay_ns
    )
    bench.wait_ms(400)
    bench.driver.read_pressure()
    assert abs(sum(errors_ns[-50:]) / 50) < 100_000


@pytest.mark.parametrize(
    ("register", "value", "message"),
    [
        (0x01, 0x51, "chip id 0x51, a BMP585"),
        (0x01, 0x60, "chip id 0x60, a BME280"),
        (0x28, 0x06, "memory is damaged: status 0x06"),
        (0x28, 0x04, "memory is damaged: status 0x04"),
        (0x28, 0x00, "the part is not ready"),
    ],
)
def test_another_chip_and_a_damaged_memory_are_named(
    register: int, value: int, message: str
) -> None:
    bench = Bench()
    bench.chip._registers[register] = value
    with pytest.raises(TileSetupError, match=message):
        bench.driver.identify(where="tile T01")


def test_a_part_that_still_loads_its_memory_is_waited_for() -> None:
    bench = Bench()
    bench.chip._memory_ready_ns = bench.clock.now_ns() + 2_000_000
    assert bench.driver.identify(where="here") == (0x5032, *PART_ID)


@pytest.mark.parametrize("scl_hz", [400_000, 1_000_000])
@pytest.mark.parametrize("is_silent", [False, True])
def test_a_part_that_never_is_ready_is_polled_for_some_milliseconds(
    scl_hz: int, is_silent: bool
) -> None:
    bench = Bench(scl_hz=scl_hz)
    bench.chip._memory_ready_ns = 10**12
    begin_ns = bench.clock.now_ns()
    if is_silent:
        bench.chip.on_address = lambda reading, t_ns: False  # type: ignore[method-assign]
    with pytest.raises(TileSetupError, match="not ready"):
        bench.driver._check_memory("here")
    assert 3_000_000 < bench.clock.now_ns() - begin_ns < 10_000_000


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (ChipSettings(oversampling=3), "one of 1, 2, 4, 8, 16, 32"),
        (ChipSettings(filter=2), "one of 0, 1, 3, 7, 15"),
        (ChipSettings(filter=1, mode="forced"), 'mode = "continuous"'),
    ],
)
def test_settings_that_the_chip_lacks_are_refused(settings: ChipSettings, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        BMP581.encode_settings(settings)


@pytest.mark.parametrize(
    ("settings", "registers"),
    [
        ({}, (0x40, 0x00, 0x83)),
        ({"mode": "forced"}, (0x40, 0x00, 0x80)),
        ({"oversampling": 4}, (0x50, 0x00, 0x83)),
        ({"oversampling": 32}, (0x69, 0x00, 0x83)),
        ({"filter": 7}, (0x40, 0x1B, 0x83)),
    ],
)
def test_settings_are_the_data_sheets_bits(
    settings: dict[str, Any], registers: tuple[int, ...]
) -> None:
    assert BMP581.encode_settings(ChipSettings(**settings)) == registers


def test_noise_of_a_reading_is_the_data_sheets() -> None:
    bench = Bench()
    words: list[int] = []
    bench.chip.on_conversion = lambda begin_ns, counts, _: words.append(counts[0])
    bench.driver.start_up(CONTINUOUS)
    for _ in range(2000):
        bench.wait_ms(2)
        bench.driver.read_pressure()
    mean = sum(words) / len(words)
    sigma_pa = (sum((w - mean) ** 2 for w in words) / len(words)) ** 0.5 / 64
    assert sigma_pa == pytest.approx(0.78, rel=0.05)
