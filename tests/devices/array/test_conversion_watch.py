"""Does a part still keep the time it was measured to need?"""

from __future__ import annotations

import pytest
from smbus2 import i2c_msg

from devices.array.budget import BusTiming
from devices.array.conversion_watch import ConversionWatch
from devices.array.health import TileHealth
from devices.array.ports import TilePorts
from devices.emulation.parts import random_of
from devices.errors import NoAcknowledgeError
from tests.devices.rigs import FOUR, TYPICAL_NS, Wires

LONGEST_NS = 3_000_000  # MPL115A2 data sheet, table 10


def watched(wires: Wires) -> tuple[ConversionWatch, TilePorts, list[TileHealth]]:
    ports = TilePorts(wires.bus, wires.infos)
    health = [TileHealth(info) for info in wires.infos]
    timing = BusTiming(wires.scl_hz, (TYPICAL_NS * 1e-9,) * 4, tuple(mux for mux, _ in FOUR))
    return ConversionWatch(ports, wires.clock, health, timing), ports, health


def tried(watch: ConversionWatch, ports: TilePorts, tile: int) -> None:
    ports.connect(tile)
    watch.try_conversion(tile)


def test_a_part_that_keeps_its_time_is_waited_for_as_measured() -> None:
    watch, ports, health = watched(Wires(FOUR))
    for tile in range(4):
        tried(watch, ports, tile)
    assert watch.wait_ns == [TYPICAL_NS] * 4
    assert not any(one.slow for one in health)


def test_a_slow_part_is_given_all_the_time_of_the_data_sheet_and_the_others_are_not() -> None:
    wires = Wires(FOUR)
    watch, ports, health = watched(wires)
    with wires.fault("slow", "T03"):
        for tile in range(4):
            tried(watch, ports, tile)
    assert watch.wait_ns == [TYPICAL_NS, TYPICAL_NS, LONGEST_NS, TYPICAL_NS]
    assert [one.slow for one in health] == [False, False, True, False]


def test_a_part_that_is_no_longer_slow_is_waited_for_as_measured_again() -> None:
    wires = Wires(FOUR)
    watch, ports, health = watched(wires)
    with wires.fault("slow", "T03"):
        tried(watch, ports, 2)
    tried(watch, ports, 2)
    assert watch.wait_ns == [TYPICAL_NS] * 4
    assert not health[2].slow


def test_a_reading_that_is_the_same_the_second_time_is_no_suspect() -> None:
    wires = Wires(FOUR)
    watch, ports, _ = watched(wires)
    ports.convert([1])
    wires.clock.sleep_until_ns(wires.clock.now_ns() + TYPICAL_NS)
    words = ports.read(with_temperature=True)
    watch.look_again(1, words)
    assert watch.to_try() is None


@pytest.mark.parametrize("words", [(11, 500), (10, 501)])
def test_a_reading_that_has_changed_since_makes_a_suspect_once(words: tuple[int, int]) -> None:
    wires = Wires(FOUR)
    watch, ports, _ = watched(wires)
    ports.convert([1])
    wires.clock.sleep_until_ns(wires.clock.now_ns() + TYPICAL_NS)
    watch.look_again(1, words)
    watch.look_again(1, words)
    assert watch.to_try() == 1
    assert watch.to_try() is None


def test_a_slow_part_is_tried_again_every_half_second() -> None:
    wires = Wires(FOUR)
    watch, ports, _ = watched(wires)
    tried_ms = []
    with wires.fault("slow", "T03"):
        tried(watch, ports, 2)
        begin_ns = wires.clock.now_ns()
        for _ in range(2_500):
            wires.clock.sleep_until_ns(wires.clock.now_ns() + 1_000_000)
            if watch.to_try() == 2:
                tried_ms.append((wires.clock.now_ns() - begin_ns) // 1_000_000)
    assert len(tried_ms) == 5 or len(tried_ms) == 4
    assert tried_ms[0] == pytest.approx(500, abs=2)


def test_a_part_that_does_not_answer_is_somebody_elses_business() -> None:
    wires = Wires(FOUR)
    watch, ports, _ = watched(wires)
    with wires.fault("no_answer", "T02"), pytest.raises(NoAcknowledgeError):
        tried(watch, ports, 1)
    assert watch.wait_ns == [TYPICAL_NS] * 4


# A busy machine


def hesitating(wires: Wires, seed: int) -> None:
    """Now and then the machine hesitates before a transfer, for longer than a conversion lasts."""
    rng = random_of(f"machine {seed}")

    def hesitate(_: int, __: tuple[i2c_msg, ...]) -> None:
        if rng.random() < 0.05:
            late_ns = int(rng.integers(500_000, 5_000_000))
            wires.clock.sleep_until_ns(wires.clock.now_ns() + late_ns)

    wires.on_transaction = hesitate


@pytest.mark.parametrize("seed", range(30))
def test_a_machine_that_hesitates_does_not_make_a_slow_part_look_as_quick_as_it_was(
    seed: int,
) -> None:
    wires = Wires(FOUR, tc_ns=2_000_000)
    watch, ports, health = watched(wires)
    tried(watch, ports, 2)
    assert health[2].slow
    hesitating(wires, seed)
    for _ in range(20):
        tried(watch, ports, 2)
        assert health[2].slow
        assert watch.wait_ns[2] == LONGEST_NS


@pytest.mark.parametrize("seed", range(30))
def test_a_machine_that_hesitates_does_not_make_a_part_look_slow(seed: int) -> None:
    wires = Wires(FOUR)
    watch, ports, health = watched(wires)
    hesitating(wires, seed)
    for _ in range(20):
        tried(watch, ports, 2)
        assert not health[2].slow


def test_a_machine_that_is_always_late_shows_nothing() -> None:
    wires = Wires(FOUR)
    watch, ports, health = watched(wires)
    wires.on_transaction = lambda _, __: wires.clock.sleep_until_ns(wires.clock.now_ns() + 500_000)
    tried(watch, ports, 2)
    assert not health[2].slow
    health[2].slow = True
    tried(watch, ports, 2)
    assert health[2].slow
