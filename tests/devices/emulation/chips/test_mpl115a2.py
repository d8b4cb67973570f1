"""One emulated MPL115A2, called as its two wires call it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.emulation.chips.mpl115a2 import (
    EmulatedMpl115a2,
    Mpl115a2Part,
    SampleFunction,
)
from devices.emulation.fault_timing import FaultTiming, PartFaults
from devices.scene.emulation_sections import ReadDuringConversion
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP

TC_NS = 1_900_000


class Samples:
    """A sense of (1, 101), (2, 102), ... that records its instants."""

    def __init__(self) -> None:
        self.asked_ns: list[int] = []

    def __call__(self, t_ns: int) -> tuple[int, int]:
        self.asked_ns.append(t_ns)
        return len(self.asked_ns), 100 + len(self.asked_ns)


def part(
    sense: SampleFunction | None = None,
    mode: ReadDuringConversion = "stale",
    spare: Callable[[], Mpl115a2Part] | None = None,
    late_ns: int = 0,
    **faults: Any,
) -> EmulatedMpl115a2:
    silicon = Mpl115a2Part(DATA_SHEET_CHIP, TC_NS, sense or Samples(), late_ns)
    return EmulatedMpl115a2(silicon, mode, PartFaults(**faults), spare)


def between(begin_ns: int, end_ns: int) -> FaultTiming:
    """Return a fault of one interval."""
    fault = FaultTiming([(begin_ns * 1e-9, end_ns * 1e-9)])
    fault.begin_scene_time(0)
    return fault


def write(chip: EmulatedMpl115a2, t_ns: int, *values: int) -> None:
    assert chip.on_address(False, t_ns)
    assert all(chip.receive_byte(value) for value in values)
    chip.on_stop(t_ns)


def convert(chip: EmulatedMpl115a2, t_ns: int) -> None:
    write(chip, t_ns, 0x12, 0x00)


def read(chip: EmulatedMpl115a2, t_ns: int, register: int, count: int) -> bytes:
    assert chip.on_address(False, t_ns)
    assert chip.receive_byte(register)
    assert chip.on_address(True, t_ns)
    raw = chip.send_bytes(count)
    chip.on_stop(t_ns)
    return raw


def counts(chip: EmulatedMpl115a2, t_ns: int) -> tuple[int, int]:
    raw = read(chip, t_ns, 0x00, 4)
    return int.from_bytes(raw[:2], "big") >> 6, int.from_bytes(raw[2:], "big") >> 6


# Conversions


@pytest.mark.parametrize("late_ns", [-300_000, 0, 300_000])
def test_a_conversion_samples_a_quarter_into_it_and_ends_after_its_time(late_ns: int) -> None:
    samples = Samples()
    chip = part(samples, late_ns=late_ns)
    assert chip.on_address(False, 0)
    chip.receive_byte(0x12)
    chip.receive_byte(0x00)
    assert samples.asked_ns == [], "it begins at the STOP"
    chip.on_stop(1_000)
    assert samples.asked_ns == [1_000 + TC_NS // 4 + late_ns]
    chip.on_stop(1_100)
    assert len(samples.asked_ns) == 1
    assert counts(chip, 1_000 + TC_NS - 1) == (0, 0)
    for t_ns in (1_000 + TC_NS, 60_000_000_000):
        assert counts(chip, t_ns) == (1, 101)


def test_a_convert_during_a_conversion_starts_it_again() -> None:
    chip = part()
    convert(chip, 0)
    convert(chip, TC_NS // 2)
    assert counts(chip, TC_NS) == (0, 0)
    assert counts(chip, TC_NS // 2 + TC_NS) == (2, 102)


@pytest.mark.parametrize(("address_ns", "stop_ns"), [(TC_NS, TC_NS), (TC_NS - 1, TC_NS + 1)])
def test_a_convert_at_the_end_of_a_conversion_keeps_its_result(
    address_ns: int, stop_ns: int
) -> None:
    chip = part()
    convert(chip, 0)
    assert chip.on_address(False, address_ns)
    chip.receive_byte(0x12)
    chip.receive_byte(0x00)
    chip.on_stop(stop_ns)
    assert counts(chip, stop_ns) == (1, 101)
    assert counts(chip, stop_ns + TC_NS) == (2, 102)


@pytest.mark.parametrize("mode", ["stale", "abort", "torn"])
def test_a_read_during_a_conversion_has_the_effect_of_the_mode(mode: ReadDuringConversion) -> None:
    chip = part(mode=mode)
    convert(chip, 0)
    write(chip, TC_NS // 2, 0x00)  # a write disturbs no conversion
    assert counts(chip, TC_NS) == (1, 101)
    begin_ns = 2 * TC_NS
    convert(chip, begin_ns)
    assert counts(chip, begin_ns + TC_NS // 2 - 1) == (1, 101)
    torn = (2, 101) if mode == "torn" else (1, 101)
    assert counts(chip, begin_ns + TC_NS // 2) == torn
    for at_ns in (begin_ns + TC_NS, begin_ns + 2 * TC_NS):  # lost, not delayed
        assert counts(chip, at_ns) == ((1, 101) if mode == "abort" else (2, 102))
    convert(chip, 5 * TC_NS)
    assert counts(chip, 6 * TC_NS) == (3, 103)


# Registers


@given(register=st.integers(0, 255), data=st.binary(max_size=3))
def test_a_data_byte_at_register_0x12_alone_starts_a_conversion(register: int, data: bytes) -> None:
    samples = Samples()
    chip = part(samples)
    write(chip, 0, register, *data)
    reached = {(register + i) & 0x7F for i in range(len(data))}
    assert bool(samples.asked_ns) == (0x12 in reached)
    read(chip, 1, 0x12, 2)
    assert bool(samples.asked_ns) == (0x12 in reached)
    assert read(chip, 1, 0x04, 8).hex() == "3eceb3f9c51733c8", "which are read-only"


@given(padc=st.integers(0, 1023), tadc=st.integers(0, 1023))
def test_counts_are_left_justified_before_six_zeros(padc: int, tadc: int) -> None:
    chip = part(lambda _: (padc, tadc))
    convert(chip, 0)
    assert int.from_bytes(read(chip, TC_NS, 0x00, 4), "big") == padc << 22 | tadc << 6


@given(first=st.integers(0, 255), pieces=st.lists(st.integers(0, 100), max_size=3))
def test_registers_are_read_from_any_address_and_begin_again_after_the_last(
    first: int, pieces: list[int]
) -> None:
    chip = part()
    write(chip, 0, first)  # a STOP before the read changes nothing
    chip.on_address(True, 0)
    registers = (
        bytes(4) + b"".join(word.to_bytes(2, "big") for word in DATA_SHEET_CHIP) + bytes(116)
    )
    found = b"".join(chip.send_bytes(count) for count in pieces)
    assert found == bytes(registers[(first + i) % 128] for i in range(sum(pieces)))


# Faults


def test_a_silent_part_acknowledges_nothing_and_finishes_its_conversion() -> None:
    # RST does not disturb a conversion nor its result (hardware.md 1.4).
    chip = part(no_answer=between(100, TC_NS))
    convert(chip, 0)
    assert chip.on_address(False, 99)
    assert not chip.on_address(False, 100)
    assert not chip.on_address(True, TC_NS - 1)
    assert counts(chip, TC_NS) == (1, 101)


def test_a_frozen_part_gives_its_last_result_until_it_recovers() -> None:
    chip = part(stale=between(TC_NS, 50_000_000))
    convert(chip, 0)
    assert counts(chip, TC_NS) == (1, 101)
    convert(chip, 10_000_000)
    assert counts(chip, 40_000_000) == (1, 101)
    convert(chip, 50_000_000)
    assert counts(chip, 50_000_000 + TC_NS) == (3, 103)


@pytest.mark.parametrize("is_addressed", [True, False])
def test_a_part_that_was_unplugged_has_empty_registers_and_its_coefficients(
    is_addressed: bool,
) -> None:
    # Power-up clears the registers (hardware.md 1.4), and a conversion under way is lost.
    chip = part(unplugged=between(2 * TC_NS, 3 * TC_NS))
    convert(chip, 0)
    assert counts(chip, TC_NS) == (1, 101)
    convert(chip, 2 * TC_NS - 1)
    if is_addressed:
        assert not chip.on_address(False, 2 * TC_NS)
    assert counts(chip, 4 * TC_NS) == (0, 0)
    assert read(chip, 4 * TC_NS, 0x04, 8).hex() == "3eceb3f9c51733c8"
    convert(chip, 4 * TC_NS)
    assert counts(chip, 5 * TC_NS) == (3, 103)


def test_a_replaced_part_is_another_one_after_its_absence() -> None:
    chip = part(
        spare=lambda: Mpl115a2Part(FORUM_CHIP, TC_NS, lambda _: (7, 700)),
        replaced=between(TC_NS, 2 * TC_NS),
    )
    convert(chip, 0)
    assert not chip.on_address(False, TC_NS)
    assert counts(chip, 2 * TC_NS) == (0, 0)
    assert read(chip, 2 * TC_NS, 0x04, 8).hex() == "3591c0a2c6252c18"
    convert(chip, 2 * TC_NS)
    assert counts(chip, 3 * TC_NS) == (7, 700)


def test_a_slow_part_takes_2_9_ms_which_the_data_sheet_allows() -> None:
    chip = part(slow=between(0, 1))
    convert(chip, 0)
    assert counts(chip, 2_899_999) == (0, 0)
    assert counts(chip, 2_900_000) == (1, 101)
    convert(chip, 10_000_000)
    assert counts(chip, 10_000_000 + TC_NS) == (2, 102), "then its own time again"


def test_a_part_lost_between_address_and_data_reads_as_ones() -> None:
    chip = part(all_ones=between(TC_NS, 2 * TC_NS))
    convert(chip, 0)
    assert counts(chip, TC_NS) == (1023, 1023)
    assert read(chip, TC_NS, 0x04, 8) == b"\xff" * 8
    assert counts(chip, 2 * TC_NS) == (1, 101)


def test_a_witness_is_notified_of_every_conversion_and_of_no_other_transfer() -> None:
    noted: list[tuple[int, tuple[int, int]]] = []
    chip = part(stale=between(2 * TC_NS, 3 * TC_NS))
    chip.on_conversion = lambda stop_ns, words, _: noted.append((stop_ns, words))
    convert(chip, 7)
    counts(chip, TC_NS)
    convert(chip, 2 * TC_NS)  # it never ends, but its sample is known
    assert noted == [(7, (1, 101)), (2 * TC_NS, (2, 102))]
