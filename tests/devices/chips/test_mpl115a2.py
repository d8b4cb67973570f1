"""The MPL115A2: arithmetic against the data sheet, transfers against an emulated part.

Golden vectors: hardware.md 1.2 (the data sheet's worked example, recomputed with exact
coefficients; a real part from a forum; the coefficient of the MPL115A1's data sheet) and 1.3.
"""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from smbus2 import i2c_msg

from devices.buses.i2c import I2cBus, open_bus
from devices.chips.mpl115a2 import Coefficients, Mpl115a2, compute_padc
from devices.chips.pressure_chips import Compensation
from devices.clock import VirtualClock
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, Mpl115a2Part
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from devices.errors import TileSetupError
from devices.flags import TileFlag
from devices.frames import NOT_READ
from tests.builders.arrays import make_tile
from tests.devices.rigs import Adapter

DATA_SHEET = bytes.fromhex("3ECE B3F9 C517 33C8")
FORUM = bytes.fromhex("3591 C0A2 C625 2C18")

Words = tuple[int, int, int, int]


def words_of(registers: bytes) -> Words:
    a0, b1, b2, c12 = struct.unpack(">4H", registers)
    return a0, b1, b2, c12


def part_of(registers: bytes) -> Coefficients:
    return Coefficients.from_words(words_of(registers))


def kpa_of(part: Coefficients, padc: int, tadc: int) -> float:
    return float(part.make_law().compute_kpa(padc, tadc))


def connected(registers: bytes, padc: int, tadc: int) -> tuple[Mpl115a2, VirtualClock]:
    """Return the driver of an emulated part that always measures the same."""
    clock = VirtualClock()
    chip = EmulatedMpl115a2(Mpl115a2Part(words_of(registers), 1_600_000, lambda _: (padc, tadc)))
    mux = EmulatedTca9548a(0x70, [(2, chip)])
    bus = open_bus("emulated", EmulatedI2cAdapter([mux], clock, 400_000))
    bus.transfer(i2c_msg.write(0x70, [0b100]))
    return Mpl115a2(bus), clock


@pytest.mark.parametrize(
    ("registers", "padc", "tadc", "kpa"),
    [(DATA_SHEET, 410, 507, 96.5873), (FORUM, 272, 521, 100.8227)],
    ids=["data sheet", "forum"],
)
def test_a_published_part_gives_its_pressure_through_driver_bus_and_chip(
    registers: bytes, padc: int, tadc: int, kpa: float
) -> None:
    driver, clock = connected(registers, padc, tadc)
    assert driver.read_counts() == (0, 0), "before the first conversion"
    part = Coefficients.from_words(driver.identify(where="test"))
    assert part.find_implausibility() == ""
    driver.start_conversion()
    clock.sleep_until_ns(clock.now_ns() + 1_600_000)
    assert driver.read_counts() == (padc, tadc)
    # 1e-4 distinguishes 4194304 from a rounded c12
    assert kpa_of(part, *driver.read_counts()) == pytest.approx(kpa, abs=1e-4)


# The bytes of the transfers


class Script(Adapter):
    """An adapter that expects exactly these transactions and gives these answers."""

    def __init__(self, *transactions: tuple[str, str]) -> None:
        self.left = list(transactions)

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        assert self.left, f"unexpected: {i2c_msgs}"
        expected, answer = self.left.pop(0)
        sent = [
            f"R{message.addr:02x} {message.len}"
            if message.flags & 1
            else f"W{message.addr:02x} {bytes(message).hex(' ')}"
            for message in i2c_msgs
        ]
        assert ", ".join(sent) == expected
        for i, value in enumerate(bytes.fromhex(answer)):
            i2c_msgs[-1].buf[i] = value


def scripted(*transactions: tuple[str, str]) -> tuple[Mpl115a2, Script]:
    script = Script(*transactions)
    return Mpl115a2(I2cBus(script, "script")), script


def test_a_conversion_and_its_readings_are_these_transactions() -> None:
    # data sheet: 6680h is 410, 7EC0h is 507; the six bits below are ignored; counts are unsigned
    driver, script = scripted(
        ("W60 12 00", ""),
        ("W60 00, R60 4", "66 80 7E C0"),
        ("W60 00, R60 4", "44 00 82 40"),
        ("W60 00, R60 4", "66 BF 7E FF"),
        ("W60 00, R60 4", "FF C0 80 00"),
    )
    driver.start_conversion()
    read = [driver.read_counts() for _ in range(4)]
    assert read == [(410, 507), (272, 521), (410, 507), (1023, 512)]
    assert not script.left


COEFFICIENTS = "W60 04, R60 8"


def test_coefficients_are_read_three_times() -> None:
    driver, script = scripted(*[(COEFFICIENTS, DATA_SHEET.hex())] * 3)
    assert driver.identify(where="tile T01") == (0x3ECE, 0xB3F9, 0xC517, 0x33C8)
    assert not script.left


@pytest.mark.parametrize("odd_one", [0, 1, 2])
def test_readings_of_the_coefficients_that_differ_are_refused(odd_one: int) -> None:
    readings = [DATA_SHEET.hex()] * 3
    readings[odd_one] = "3ece b3f9 c517 33c0"  # one bit
    driver, _ = scripted(*[(COEFFICIENTS, reading) for reading in readings])
    with pytest.raises(TileSetupError, match="differ") as caught:
        driver.identify(where="tile T01")
    assert caught.value.where == "tile T01"
    assert "3ece b3f9 c517 33c8" in str(caught.value)
    assert "3ece b3f9 c517 33c0" in str(caught.value)
    assert "check pull-ups, or use 100 kHz" in caught.value.remedy


@pytest.mark.parametrize("registers", ["00" * 8, "ff" * 8], ids=["SDA stuck low", "no part"])
def test_coefficients_of_a_dead_bus_are_refused(registers: str) -> None:
    driver, _ = scripted(*[(COEFFICIENTS, registers)] * 3)
    with pytest.raises(TileSetupError, match="no MPL115A2's") as caught:
        driver.identify(where="tile T01")
    assert caught.value.where == "tile T01"
    assert "stuck" in caught.value.remedy


# Impossible counts


@pytest.mark.parametrize(
    ("counts", "flags"),
    [
        ((0, 0), TileFlag.NOT_CONVERTED),
        ((1023, 1023), TileFlag.IMPLAUSIBLE),
        ((500, 1023), TileFlag.IMPLAUSIBLE),
        ((500, 0), TileFlag.IMPLAUSIBLE),
        ((0, 500), 0),  # hardware.md 1.3: counts fall through zero
        ((1023, 500), 0),
        ((410, 507), 0),
        ((500, NOT_READ), 0),
        ((0, NOT_READ), 0),
    ],
)
def test_only_counts_of_no_part_are_impossible(counts: tuple[int, int], flags: int) -> None:
    driver, _ = scripted()
    assert driver.classify_counts(*counts) == flags


# Coefficients


@pytest.mark.parametrize(
    ("register", "c12", "tolerance"),
    [
        (0x33C8, 0.00079011917, 5e-12),
        (0x38CC, 0.00086665, 5e-9),
        (0x2C18, 0x0B06 / 2**22, 0),
        (0xFFFC, -1 / 2**22, 0),
    ],
)
def test_coefficients_are_decoded_exactly_and_c12_is_14_bits_left_justified(
    register: int, c12: float, tolerance: float
) -> None:
    part = Coefficients.from_words((*words_of(DATA_SHEET)[:3], register))
    assert (part.a0, part.b1, part.b2) == (2009.75, -2.3758544921875, -0.92047119140625)
    assert part.c12 == pytest.approx(c12, rel=0, abs=tolerance)


word = st.integers(0, 0xFFFF)


@given(words=st.tuples(word, word, word, word))
def test_coefficients_are_encoded_to_their_registers_without_the_two_bits_below_c12(
    words: Words,
) -> None:
    masked = (*words[:3], words[3] & 0xFFFC)
    assert Coefficients.from_words(words) == Coefficients.from_words(masked)
    assert Coefficients.from_words(words).to_words() == masked


@given(
    a0=st.floats(1700, 2200),
    b1=st.floats(-2.5, -1.9),
    b2=st.floats(-1.0, -0.85),
    c12=st.floats(0.00065, 0.00088),
)
def test_coefficients_are_encoded_to_the_nearest_step(
    a0: float, b1: float, b2: float, c12: float
) -> None:
    part = Coefficients(a0, b1, b2, c12)
    again = Coefficients.from_words(part.to_words())
    assert abs(again.a0 - a0) <= 0.5 / 8
    assert abs(again.b1 - b1) <= 0.5 / 8192
    assert abs(again.b2 - b2) <= 0.5 / 16384
    assert abs(again.c12 - c12) <= 0.5 / 2**22


@pytest.mark.parametrize(
    "wrong", [{"a0": 4096.0}, {"b1": -4.001}, {"b2": 2.0}, {"c12": 0.001953125}]
)
def test_a_coefficient_that_no_register_holds_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(struct.error):
        replace(part_of(DATA_SHEET), **wrong).to_words()


@pytest.mark.parametrize("name", ["a0", "b1", "b2", "c12"])
def test_a_coefficient_of_the_wrong_sign_is_implausible_and_named(name: str) -> None:
    part = part_of(DATA_SHEET)
    assert name in replace(part, **{name: -getattr(part, name)}).find_implausibility()
    assert name in replace(part, **{name: 0.0}).find_implausibility()


# Compensation


@pytest.mark.parametrize(
    ("registers", "padc", "tadc", "kpa", "tolerance_kpa"),
    [
        (DATA_SHEET, 410, 507, 96.587326, 5e-7),  # the worked example
        (DATA_SHEET, 0, 0, 177.7, 0.06),  # a part that never converted
        (DATA_SHEET, 0, 507, 148.0, 0.06),
        (DATA_SHEET, 1023, 507, 19.7, 0.06),
        (FORUM, 0, 521, 129.0, 0.06),
        (FORUM, 1023, 521, 23.1, 0.06),
    ],
)
def test_counts_are_compensated_also_outside_the_specified_range(
    registers: bytes, padc: int, tadc: int, kpa: float, tolerance_kpa: float
) -> None:
    assert kpa_of(part_of(registers), padc, tadc) == pytest.approx(kpa, abs=tolerance_kpa)


@pytest.mark.parametrize(
    ("registers", "tadc", "kpa", "padc_at_115_kpa"),
    [(DATA_SHEET, 507, -0.1255, 263), (FORUM, 521, -0.1035, 135)],
)
def test_pressure_falls_with_every_count(
    registers: bytes, tadc: int, kpa: float, padc_at_115_kpa: int
) -> None:
    part = part_of(registers)
    assert float(part.make_law().compute_kpa_per_count(tadc)) == pytest.approx(kpa, abs=5e-5)
    step = kpa_of(part, 301, tadc) - kpa_of(part, 300, tadc)
    assert step == pytest.approx(kpa, abs=5e-5)
    assert float(compute_padc(115.0, tadc, part)) == pytest.approx(padc_at_115_kpa, abs=0.5)


def test_one_count_of_temperature_is_38_pa() -> None:
    # hardware.md 1.3: -0.0379 kPa per count at the example's pressure
    step = kpa_of(part_of(DATA_SHEET), 410, 508) - kpa_of(part_of(DATA_SHEET), 410, 507)
    assert step == pytest.approx(-0.0379, abs=5e-5)


parts = st.builds(
    Coefficients,
    a0=st.floats(1500, 2500),
    b1=st.floats(-3.0, -1.5),
    b2=st.floats(-1.2, -0.7),
    c12=st.floats(0.0005, 0.001),
)


@given(part=parts, padc=st.integers(0, 1023), tadc=st.integers(0, 1023), kpa=st.floats(0, 300))
def test_compensation_and_its_inverse_undo_each_other(
    part: Coefficients, padc: int, tadc: int, kpa: float
) -> None:
    again = part.make_law().compute_kpa(compute_padc(kpa, tadc, part), tadc)
    assert float(again) == pytest.approx(kpa, abs=1e-9)
    # A part measures nothing if the temperature cancels its b1.
    assume(part.b1 + part.c12 * tadc < -0.1)
    found = float(compute_padc(kpa_of(part, padc, tadc), tadc, part))
    assert found == pytest.approx(padc, abs=1e-8)


def test_columns_of_frames_are_compensated_with_the_coefficients_of_each_tile() -> None:
    tiles = [part_of(DATA_SHEET), part_of(FORUM)]
    padc = np.array([[410, 272], [0, 1023], [65535, 0]], dtype=np.uint16)
    tadc = np.array([[507, 521], [507, 521], [65535, 521]], dtype=np.uint16)
    infos = [make_tile(registers=words_of(each)) for each in (DATA_SHEET, FORUM)]
    kpa = Compensation(infos).law.compute_kpa(padc, tadc)
    assert kpa.dtype == np.float64
    for row in range(3):
        for i, tile in enumerate(tiles):
            assert kpa[row, i] == kpa_of(tile, int(padc[row, i]), int(tadc[row, i]))
