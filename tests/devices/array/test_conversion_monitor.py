"""Does a part still keep the time it was measured to need?"""

from __future__ import annotations

from typing import Any

import pytest

from devices.array.plausibility import ConversionMonitor
from devices.array.schedules import BusTiming
from devices.array.tile import TileHealth, TileIo
from devices.errors import NoAcknowledgeError
from tests.devices.rigs import FOUR, TYPICAL_NS, Wires, hesitating

LONGEST_NS = 3_000_000  # MPL115A2 data sheet, table 10


def watched(**how: Any) -> tuple[Wires, ConversionMonitor, TileIo, list[TileHealth]]:
    wires = Wires(FOUR, **how)
    ports = TileIo(wires.bus, wires.infos)
    health = [TileHealth(info) for info in wires.infos]
    timing = BusTiming(wires.scl_hz, (TYPICAL_NS * 1e-9,) * 4, tuple(mux for mux, _ in FOUR))
    return wires, ConversionMonitor(ports, wires.clock, health, timing), ports, health


def tried(watch: ConversionMonitor, ports: TileIo, tile: int) -> None:
    ports.connect_tile(tile)
    watch.test_conversion_time(tile)


def test_a_part_that_keeps_its_time_is_waited_for_as_measured() -> None:
    _, watch, ports, health = watched()
    for tile in range(4):
        tried(watch, ports, tile)
    assert watch.wait_ns == [TYPICAL_NS] * 4
    assert not any(one.is_slow for one in health)


def test_a_slow_part_is_given_all_the_time_of_the_data_sheet_and_the_others_are_not() -> None:
    wires, watch, ports, health = watched()
    with wires.fault("slow", "T03"):
        for tile in range(4):
            tried(watch, ports, tile)
    assert watch.wait_ns == [TYPICAL_NS, TYPICAL_NS, LONGEST_NS, TYPICAL_NS]
    assert [one.is_slow for one in health] == [False, False, True, False]


def test_a_part_that_is_no_longer_slow_is_waited_for_as_measured_again() -> None:
    wires, watch, ports, health = watched()
    with wires.fault("slow", "T03"):
        tried(watch, ports, 2)
    tried(watch, ports, 2)
    assert watch.wait_ns == [TYPICAL_NS] * 4
    assert not health[2].is_slow


def test_a_reading_that_is_the_same_the_second_time_is_no_suspect() -> None:
    wires, watch, ports, _ = watched()
    ports.start_conversions([1])
    wires.clock.sleep_until_ns(wires.clock.now_ns() + TYPICAL_NS)
    words = ports.read_counts(with_temperature=True)
    watch.check_read_in_time(1, words)
    assert watch.pop_due_trial() is None


@pytest.mark.parametrize("words", [(11, 500), (10, 501)])
def test_a_reading_that_has_changed_since_makes_a_suspect_once(words: tuple[int, int]) -> None:
    wires, watch, ports, _ = watched()
    ports.start_conversions([1])
    wires.clock.sleep_until_ns(wires.clock.now_ns() + TYPICAL_NS)
    watch.check_read_in_time(1, words)
    watch.check_read_in_time(1, words)
    assert watch.pop_due_trial() == 1
    assert watch.pop_due_trial() is None


def test_a_slow_part_is_tried_again_every_half_second() -> None:
    wires, watch, ports, _ = watched()
    tried_ms = []
    with wires.fault("slow", "T03"):
        tried(watch, ports, 2)
        begin_ns = wires.clock.now_ns()
        for _ in range(2_500):
            wires.clock.sleep_until_ns(wires.clock.now_ns() + 1_000_000)
            if watch.pop_due_trial() == 2:
                tried_ms.append((wires.clock.now_ns() - begin_ns) // 1_000_000)
    assert len(tried_ms) == 5 or len(tried_ms) == 4
    assert tried_ms[0] == pytest.approx(500, abs=2)


def test_a_part_that_does_not_answer_is_somebody_elses_business() -> None:
    wires, watch, ports, _ = watched()
    with wires.fault("no_answer", "T02"), pytest.raises(NoAcknowledgeError):
        tried(watch, ports, 1)
    assert watch.wait_ns == [TYPICAL_NS] * 4


# A busy machine


@pytest.mark.parametrize("seed", range(30))
def test_a_machine_that_hesitates_does_not_make_a_slow_part_look_as_quick_as_it_was(
    seed: int,
) -> None:
    wires, watch, ports, health = watched(tc_ns=2_000_000)
    tried(watch, ports, 2)
    assert health[2].is_slow
    hesitating(wires, seed)
    for _ in range(20):
        tried(watch, ports, 2)
        assert health[2].is_slow
        assert watch.wait_ns[2] == LONGEST_NS


@pytest.mark.parametrize("seed", range(30))
def test_a_machine_that_hesitates_does_not_make_a_part_look_slow(seed: int) -> None:
    wires, watch, ports, health = watched()
    hesitating(wires, seed)
    for _ in range(20):
        tried(watch, ports, 2)
        assert not health[2].is_slow


def test_a_machine_that_is_always_late_shows_nothing() -> None:
    wires, watch, ports, health = watched()
    wires.on_transaction = lambda _, __: wires.clock.sleep_until_ns(wires.clock.now_ns() + 500_000)
    tried(watch, ports, 2)
    assert not health[2].is_slow
    health[2].is_slow = True
    tried(watch, ports, 2)
    assert health[2].is_slow
