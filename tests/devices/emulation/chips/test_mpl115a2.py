"""One emulated MPL115A2, called as its two wires would call it."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.emulation.chips.mpl115a2 import (
    EmulatedMpl115a2,
    EmulatedPart,
    PartFaults,
    SampleFunction,
)
from devices.emulation.fault_timing import FaultTiming
from devices.scene.emulation_sections import ReadDuringConversion
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP

TC_NS = 1_900_000


class Samples:
    """A sense that gives (1, 101), (2, 102), ... and notes when it was asked."""

    def __init__(self) -> None:
        self.asked_ns: list[int] = []

    def __call__(self, t_ns: int) -> tuple[int, int]:
        self.asked_ns.append(t_ns)
        return len(self.asked_ns), 100 + len(self.asked_ns)


def part(
    sense: SampleFunction | None = None,
    mode: ReadDuringConversion = "stale",
    faults: PartFaults | None = None,
    spare: Callable[[], EmulatedPart] | None = None,
) -> EmulatedMpl115a2:
    return EmulatedMpl115a2(
        EmulatedPart(DATA_SHEET_CHIP, TC_NS, sense or Samples()), mode, faults, spare
    )


def between(begin_ns: int, end_ns: int) -> FaultTiming:
    """A fault that is there in one window of time."""
    fault = FaultTiming([(begin_ns * 1e-9, end_ns * 1e-9)])
    fault.begin_scene_time(0)
    return fault


def write(chip: EmulatedMpl115a2, t_ns: int, *values: int) -> None:
    assert chip.on_address(False, t_ns)
    assert all(chip.receive_byte(value) for value in values)
    chip.on_stop(t_ns)


def convert(chip: EmulatedMpl115a2, t_ns: int) -> None:
    write(chip, t_ns, 0x12, 0x00)


def counts(chip: EmulatedMpl115a2, t_ns: int) -> tuple[int, int]:
    assert chip.on_address(False, t_ns)
    assert chip.receive_byte(0x00)
    assert chip.on_address(True, t_ns)
    raw = chip.send_bytes(4)
    chip.on_stop(t_ns)
    return int.from_bytes(raw[:2], "big") >> 6, int.from_bytes(raw[2:], "big") >> 6


def test_the_new_words_are_there_exactly_at_the_end_of_the_conversion() -> None:
    chip = part()
    convert(chip, 1_000)
    assert counts(chip, 1_000 + TC_NS - 1) == (0, 0)
    assert counts(chip, 1_000 + TC_NS) == (1, 101)


def test_the_pressure_is_sampled_a_quarter_into_the_conversion() -> None:
    samples = Samples()
    convert(part(samples), 1_000)
    assert samples.asked_ns == [1_000 + TC_NS // 4]


@pytest.mark.parametrize("late_ns", [-300_000, 300_000])
def test_a_part_may_sample_earlier_or_later_and_is_ready_when_it_would_be(late_ns: int) -> None:
    samples = Samples()
    chip = EmulatedMpl115a2(EmulatedPart(DATA_SHEET_CHIP, TC_NS, samples, late_ns))
    convert(chip, 1_000)
    assert samples.asked_ns == [1_000 + TC_NS // 4 + late_ns]
    assert counts(chip, 1_000 + TC_NS - 1) == (0, 0)
    assert counts(chip, 1_000 + TC_NS) == (1, 101)


def test_a_convert_during_a_conversion_starts_it_anew() -> None:
    chip = part()
    convert(chip, 0)
    convert(chip, TC_NS // 2)
    assert counts(chip, TC_NS) == (0, 0), "the first conversion should be gone"
    assert counts(chip, TC_NS // 2 + TC_NS) == (2, 102)


def test_a_convert_right_at_the_end_of_a_conversion_does_not_lose_it() -> None:
    chip = part()
    convert(chip, 0)
    convert(chip, TC_NS)
    assert counts(chip, TC_NS) == (1, 101)
    assert counts(chip, 2 * TC_NS) == (2, 102)


def test_a_conversion_that_ends_while_the_next_convert_is_on_the_wire_is_not_lost() -> None:
    chip = part()
    convert(chip, 0)
    assert chip.on_address(False, TC_NS - 1)
    chip.receive_byte(0x12)
    chip.receive_byte(0x00)
    chip.on_stop(TC_NS + 1)
    assert counts(chip, TC_NS + 2) == (1, 101)
    assert counts(chip, 2 * TC_NS + 1) == (2, 102)


def test_a_conversion_starts_at_the_stop_and_not_at_the_data_byte() -> None:
    samples = Samples()
    chip = part(samples)
    assert chip.on_address(False, 0)
    chip.receive_byte(0x12)
    chip.receive_byte(0x00)
    assert samples.asked_ns == []
    chip.on_stop(50_000)
    assert samples.asked_ns == [50_000 + TC_NS // 4]
    chip.on_stop(60_000)
    assert len(samples.asked_ns) == 1, "one CONVERT, one conversion"


@given(
    register=st.integers(0, 255),
    data=st.binary(min_size=1, max_size=3),
)
def test_only_a_data_byte_at_register_0x12_starts_a_conversion(register: int, data: bytes) -> None:
    samples = Samples()
    write(part(samples), 0, register, *data)
    reached = {(register + i) & 0x7F for i in range(len(data))}
    assert bool(samples.asked_ns) == (0x12 in reached)


@given(padc=st.integers(0, 1023), tadc=st.integers(0, 1023))
def test_words_are_left_justified_with_six_zeros(padc: int, tadc: int) -> None:
    chip = part(lambda _: (padc, tadc))
    convert(chip, 0)
    chip.on_address(False, TC_NS)
    chip.receive_byte(0x00)
    chip.on_address(True, TC_NS)
    raw = int.from_bytes(chip.send_bytes(4), "big")
    assert raw == padc << 22 | tadc << 6


@given(first=st.integers(0, 127), count=st.integers(0, 200))
def test_a_read_past_the_last_register_begins_again_at_the_first(first: int, count: int) -> None:
    chip = part()
    chip.on_address(False, 0)
    chip.receive_byte(first)
    chip.on_address(True, 0)
    registers = (
        bytes(4) + b"".join(word.to_bytes(2, "big") for word in DATA_SHEET_CHIP) + bytes(116)
    )
    assert chip.send_bytes(count) == bytes(registers[(first + i) % 128] for i in range(count))


def test_two_reads_in_a_row_go_on_where_the_first_one_ended() -> None:
    chip = part()
    chip.on_address(False, 0)
    chip.receive_byte(0x04)
    chip.on_address(True, 0)
    assert chip.send_bytes(2) + chip.send_bytes(2) == bytes.fromhex("3eceb3f9")


def test_a_silent_part_acknowledges_nothing_and_hears_nothing() -> None:
    samples = Samples()
    chip = part(samples, faults=PartFaults(no_answer=between(100, 200)))
    assert chip.on_address(False, 99)
    assert not chip.on_address(False, 100)
    assert not chip.on_address(True, 199)
    assert chip.on_address(True, 200)


def test_a_conversion_that_ran_when_the_part_fell_silent_is_finished() -> None:
    # RST does not disturb a conversion nor its result (hardware.md 1.4).
    chip = part(faults=PartFaults(no_answer=between(1, TC_NS)))
    convert(chip, 0)
    assert not chip.on_address(False, TC_NS - 1)
    assert counts(chip, TC_NS) == (1, 101)


def test_a_frozen_part_keeps_its_last_result_and_recovers() -> None:
    chip = part(faults=PartFaults(stale=between(TC_NS, 50_000_000)))
    convert(chip, 0)
    assert counts(chip, TC_NS) == (1, 101)
    convert(chip, 10_000_000)
    assert counts(chip, 40_000_000) == (1, 101)
    convert(chip, 50_000_000)
    assert counts(chip, 50_000_000 + TC_NS) == (3, 103), "what it missed is gone"


def test_torn_words_are_the_new_pressure_and_the_old_temperature() -> None:
    chip = part(mode="torn")
    convert(chip, 0)
    assert counts(chip, TC_NS // 2 - 1) == (0, 0)
    assert counts(chip, TC_NS // 2) == (1, 0)
    assert counts(chip, TC_NS) == (1, 101)


@pytest.mark.parametrize("mode", ["stale", "abort", "torn"])
def test_a_write_during_a_conversion_disturbs_nothing(mode: ReadDuringConversion) -> None:
    chip = part(mode=mode)
    convert(chip, 0)
    write(chip, TC_NS // 2, 0x00)
    assert counts(chip, TC_NS) == (1, 101)


# Faults of a part


def coefficients(chip: EmulatedMpl115a2, t_ns: int) -> bytes:
    assert chip.on_address(False, t_ns)
    assert chip.receive_byte(0x04)
    assert chip.on_address(True, t_ns)
    raw = chip.send_bytes(8)
    chip.on_stop(t_ns)
    return raw


def test_a_part_that_was_unplugged_comes_back_with_empty_registers() -> None:
    # Power-up clears the registers (hardware.md 1.4), and a conversion under way is lost.
    chip = part(faults=PartFaults(unplugged=between(2 * TC_NS, 3 * TC_NS)))
    convert(chip, 0)
    assert counts(chip, TC_NS) == (1, 101)
    convert(chip, 2 * TC_NS - 1)
    assert not chip.on_address(False, 2 * TC_NS)
    assert counts(chip, 4 * TC_NS) == (0, 0)
    assert coefficients(chip, 4 * TC_NS).hex() == "3eceb3f9c51733c8", "it is the same part"
    convert(chip, 4 * TC_NS)
    assert counts(chip, 5 * TC_NS) == (3, 103)


def test_a_part_that_nobody_asked_while_it_was_unplugged_is_empty_all_the_same() -> None:
    chip = part(faults=PartFaults(unplugged=between(2 * TC_NS, 3 * TC_NS)))
    convert(chip, 0)
    assert counts(chip, TC_NS) == (1, 101)
    assert counts(chip, 4 * TC_NS) == (0, 0)


def test_a_replaced_part_is_another_one_from_then_on() -> None:
    faults = PartFaults(replaced=between(TC_NS, 2 * TC_NS))
    chip = part(faults=faults, spare=lambda: EmulatedPart(FORUM_CHIP, TC_NS, lambda _: (7, 700)))
    convert(chip, 0)
    assert not chip.on_address(False, TC_NS), "its channel is empty for a while"
    assert counts(chip, 2 * TC_NS) == (0, 0)
    assert coefficients(chip, 2 * TC_NS).hex() == "3591c0a2c6252c18"
    convert(chip, 2 * TC_NS)
    assert counts(chip, 3 * TC_NS) == (7, 700)


def test_a_slow_part_takes_2_9_ms_which_the_data_sheet_allows() -> None:
    chip = part(faults=PartFaults(slow=between(0, 1)))
    convert(chip, 0)
    assert counts(chip, 2_899_999) == (0, 0)
    assert counts(chip, 2_900_000) == (1, 101)
    convert(chip, 10_000_000)
    assert counts(chip, 10_000_000 + TC_NS) == (2, 102), "and then its own time again"


def test_a_part_that_is_lost_between_address_and_data_reads_as_ones() -> None:
    chip = part(faults=PartFaults(all_ones=between(TC_NS, 2 * TC_NS)))
    convert(chip, 0)
    assert counts(chip, TC_NS) == (1023, 1023)
    assert coefficients(chip, TC_NS) == b"\xff" * 8
    assert counts(chip, 2 * TC_NS) == (1, 101)


def test_a_witness_is_told_of_every_conversion_and_of_no_other_transfer() -> None:
    told: list[tuple[int, tuple[int, int]]] = []
    chip = part(faults=PartFaults(stale=between(2 * TC_NS, 3 * TC_NS)))
    chip.on_conversion = lambda stop_ns, words, _: told.append((stop_ns, words))
    convert(chip, 7)
    counts(chip, TC_NS)
    convert(chip, 2 * TC_NS)  # it never ends, but what it would have given is known
    assert told == [(7, (1, 101)), (2 * TC_NS, (2, 102))]
