"""What each schedule puts on the wire: how long, in which order, and never too early.

The formulas are those of hardware.md 4, in SCL periods.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from smbus2 import i2c_msg

from devices.array.schedules import BusTiming, compute_frame_s
from devices.scene.emulation_sections import ReadDuringConversion
from devices.scene.hardware_sections import ScheduleName
from tests.devices.rigs import (
    CONVERT,
    FOUR,
    ONE,
    READ,
    READ_PRESSURE,
    SCHEDULES,
    SELECT,
    TWO_MUXES,
    TYPICAL_NS,
    Plugs,
    Wires,
    array_on,
    full,
    scanned,
    settled,
    settled_on,
    timed_scan,
)


def muxes_of(plugs: Plugs) -> int:
    return len({mux for mux, _ in plugs})


def sequential_ns(plugs: Plugs, bit_ns: int, read: int) -> int:
    n, m = len(plugs), muxes_of(plugs)
    closes = m if m > 1 else 0
    return (n * (SELECT + CONVERT + read) + closes * SELECT) * bit_ns + n * TYPICAL_NS


def simultaneous_ns(plugs: Plugs, bit_ns: int, read: int) -> int:
    n, m = len(plugs), muxes_of(plugs)
    # The closing of the other muxes and the first select are hidden in the wait.
    hidden_ns = m * SELECT * bit_ns
    periods = m * SELECT + CONVERT + n * read + (n - 1) * SELECT + (m - 1) * SELECT
    return periods * bit_ns + max(TYPICAL_NS, hidden_ns)


def pipelined_ns(plugs: Plugs, bit_ns: int, read: int) -> int:
    n, m = len(plugs), muxes_of(plugs)
    closes = m if m > 1 else 0
    busy = n * (SELECT + read + CONVERT) + closes * SELECT
    return max(busy * bit_ns, TYPICAL_NS + (read + CONVERT) * bit_ns)


def per_mux_ns(plugs: Plugs, bit_ns: int, read: int) -> int:
    m = muxes_of(plugs)
    if m == 1:
        return simultaneous_ns(plugs, bit_ns, read)
    # bus_budget.py closes a mux behind its reads and opens it again for its CONVERT. It is the same
    # mux, so one select is saved; in a frame that waits, so are those that the wait hides.
    start = 2 * SELECT + CONVERT
    reads = [
        sum(mux == address for mux, _ in plugs) * (SELECT + read)
        for address in {mux for mux, _ in plugs}
    ]
    busy = m * start + sum(reads)
    return max(busy * bit_ns, TYPICAL_NS + (CONVERT + max(reads)) * bit_ns)


FORMULAS: dict[ScheduleName, Callable[[Plugs, int, int], int]] = {
    "simultaneous": simultaneous_ns,
    "pipelined": pipelined_ns,
    "per_mux": per_mux_ns,
    "sequential": sequential_ns,
}


def frame_ns(schedule: ScheduleName, plugs: Plugs, bit_ns: int, read: int = READ) -> int:
    if len(plugs) == 1:  # the mux stays as it is
        return TYPICAL_NS + (CONVERT + read) * bit_ns
    return FORMULAS[schedule](plugs, bit_ns, read)


every_schedule = pytest.mark.parametrize("schedule", SCHEDULES)
RATES = {400_000: 2_500, 250_000: 4_000, 100_000: 10_000}


def steady_ns(schedule: ScheduleName, plugs: Plugs, scl_hz: int, every: int = 1) -> int:
    """Length of a frame in the steady state, in which nothing is audited nor read twice."""
    wires = Wires(plugs, scl_hz)
    array = settled(wires, schedule, temperature_every=every)
    scanned(array, 2)
    (common, count), *_ = Counter(timed_scan(array, wires)[1] for _ in range(9)).most_common(1)
    assert count >= 4
    return common


@pytest.mark.parametrize("tiles", [1, 2, 3, 4, 6, 7, 8, 16, 24, 32, 64])
@pytest.mark.parametrize("scl_hz", [400_000, 100_000])
@every_schedule
def test_a_frame_takes_what_the_bus_budget_says_to_the_nanosecond(
    schedule: ScheduleName, scl_hz: int, tiles: int
) -> None:
    plugs = full(tiles)
    assert steady_ns(schedule, plugs, scl_hz) == frame_ns(schedule, plugs, RATES[scl_hz])


@pytest.mark.parametrize("tiles", [1, 2, 4, 8, 16, 32, 64])
@pytest.mark.parametrize("scl_hz", [400_000, 100_000])
@every_schedule
def test_no_frame_takes_longer_than_predicted(
    schedule: ScheduleName, scl_hz: int, tiles: int
) -> None:
    plugs = full(tiles)
    timing = BusTiming(scl_hz, (TYPICAL_NS * 1e-9,) * tiles, tuple(mux for mux, _ in plugs))
    predicted_ns = compute_frame_s(schedule, timing) * 1e9
    took_ns = steady_ns(schedule, plugs, scl_hz)
    assert took_ns <= predicted_ns + 1
    # hardware.md 4 counts one select a mux too many for per_mux.
    assert took_ns >= (0.93 if schedule == "per_mux" else 1.0) * predicted_ns - 1


plugs_drawn = st.lists(
    st.tuples(st.integers(0x70, 0x77), st.integers(0, 7)), unique=True, min_size=1, max_size=20
).map(lambda plugs: tuple(sorted(plugs)))


@settings(max_examples=40, deadline=None)
@given(
    schedule=st.sampled_from(SCHEDULES),
    plugs=plugs_drawn,
    scl_hz=st.sampled_from([400_000, 250_000, 100_000]),
)
def test_so_it_does_wherever_the_tiles_are_plugged_in(
    schedule: ScheduleName, plugs: Plugs, scl_hz: int
) -> None:
    bit_ns = RATES[scl_hz]
    expected_ns = frame_ns(schedule, plugs, bit_ns)
    # A mux with a single tile is not written again for a broadcast: a select less.
    alone = sum(sum(m == mux for m, _ in plugs) == 1 for mux in {mux for mux, _ in plugs})
    spared_ns = 2 * alone * SELECT * bit_ns if schedule in ("simultaneous", "per_mux") else 0
    assert expected_ns - spared_ns <= steady_ns(schedule, plugs, scl_hz) <= expected_ns


@pytest.mark.parametrize("tiles", [1, 4, 8, 16, 64])
@pytest.mark.parametrize("scl_hz", [400_000, 100_000])
@every_schedule
def test_without_temperature_a_frame_takes_what_two_bytes_take(
    schedule: ScheduleName, scl_hz: int, tiles: int
) -> None:
    plugs = full(tiles)
    expected = frame_ns(schedule, plugs, RATES[scl_hz], READ_PRESSURE)
    assert steady_ns(schedule, plugs, scl_hz, every=1000) == expected


@pytest.mark.parametrize(
    ("schedule", "tiles", "hz"),
    [
        # hardware.md 4, 400 kHz, 4 bytes
        *(("simultaneous", 4, 395), ("sequential", 4, 132), ("pipelined", 4, 544)),
        *(("pipelined", 8, 435), ("per_mux", 16, 257), ("per_mux", 64, 64)),
    ],
)
def test_the_published_rates_are_reached(schedule: ScheduleName, tiles: int, hz: int) -> None:
    took_ns = steady_ns(schedule, full(tiles), 400_000)
    if schedule == "per_mux":  # a select a mux is saved
        assert hz <= 1e9 / took_ns < 1.04 * hz
    else:
        assert round(1e9 / took_ns) == hz


@settings(max_examples=30, deadline=None)
@given(
    schedule=st.sampled_from(SCHEDULES),
    plugs=plugs_drawn,
    tc_ns=st.lists(st.integers(1_400_000, 2_000_000), min_size=20, max_size=20),
)
def test_drawn_parts_take_no_longer_than_the_slowest_of_them_would(
    schedule: ScheduleName, plugs: Plugs, tc_ns: list[int]
) -> None:
    wires, array = settled_on(plugs, schedule, tc_ns=tc_ns[: len(plugs)])
    begin_ns = wires.clock.now_ns()
    scanned(array, 5)
    slowest = frame_ns(schedule, plugs, 2_500) + (
        sum(tc_ns[: len(plugs)]) - len(plugs) * TYPICAL_NS
        if schedule == "sequential"
        else max(0, max(tc_ns[: len(plugs)]) - TYPICAL_NS)
    )
    # Sequential has no idle time that one tile could lend another.
    assert wires.clock.now_ns() - begin_ns <= 5 * slowest


# Transactions

R = "60<00 60>4"
C = "60<1200"


@every_schedule
def test_a_single_tile_needs_no_select_after_the_first(schedule: ScheduleName) -> None:
    wires, array = settled_on(ONE, schedule)
    wires.log.clear()
    array.scan_frame()
    assert sorted(wires.log) == [R, C]


def log_of_a_frame(schedule: ScheduleName, plugs: Plugs) -> list[str]:
    wires, array = settled_on(plugs, schedule)
    wires.log.clear()
    array.scan_frame()
    first = list(wires.log)
    wires.log.clear()
    array.scan_frame()
    assert wires.log == first, "frame by frame the same"
    return first


def test_a_simultaneous_frame_is_exactly_these_transactions() -> None:
    assert log_of_a_frame("simultaneous", TWO_MUXES) == [
        *("70<21", "73<03", C),
        *("73<00", "70<01", R),
        *("70<20", R),
        *("70<00", "73<01", R),
        *("73<02", R),
    ]


def test_a_sequential_frame_is_exactly_these_transactions() -> None:
    assert log_of_a_frame("sequential", TWO_MUXES) == [
        *("73<00", "70<01", C, R),
        *("70<20", C, R),
        *("70<00", "73<01", C, R),
        *("73<02", C, R),
    ]


def test_a_pipelined_frame_is_exactly_these_transactions() -> None:
    assert log_of_a_frame("pipelined", TWO_MUXES) == [
        *("73<00", "70<01", R, C),
        *("70<20", R, C),
        *("70<00", "73<01", R, C),
        *("73<02", R, C),
    ]
    assert log_of_a_frame("pipelined", FOUR[:2]) == ["70<01", R, C, "70<02", R, C]


def test_a_per_mux_frame_is_exactly_these_transactions() -> None:
    assert log_of_a_frame("per_mux", TWO_MUXES) == [
        # The tiles of the second mux, which were read last, convert while the first is read.
        *("73<03", C, "73<00"),
        *("70<01", R, "70<20", R),
        *("70<21", C, "70<00"),
        *("73<01", R, "73<02", R),
    ]


def test_per_mux_on_a_single_mux_is_one_broadcast() -> None:
    assert log_of_a_frame("per_mux", FOUR) == log_of_a_frame("simultaneous", FOUR)


@pytest.mark.parametrize(
    ("schedule", "per_frame"),
    # hardware.md 4: a 3n, b 2n + 2 for one mux (the first select is the broadcast's)
    [("sequential", 12), ("pipelined", 12), ("simultaneous", 10)],
)
def test_a_frame_makes_so_many_system_calls(schedule: ScheduleName, per_frame: int) -> None:
    assert len(log_of_a_frame(schedule, FOUR)) == per_frame


def test_mux_by_mux_makes_2n_and_3m_system_calls() -> None:
    # One a mux less than hardware.md 4 counts: what is read last is not closed before its CONVERT.
    assert len(log_of_a_frame("per_mux", full(16))) == 2 * 16 + 3 * 2


# What is open, and when


def open_channels(wires: Wires) -> int:
    return sum(mux.connected_mask.bit_count() for mux in wires.muxes)


def open_muxes(wires: Wires) -> int:
    return sum(mux.connected_mask != 0 for mux in wires.muxes)


@settings(max_examples=40, deadline=None)
@given(schedule=st.sampled_from(SCHEDULES), plugs=plugs_drawn, begun=st.binary(max_size=8))
def test_never_is_more_than_one_mux_open_outside_a_broadcast(
    schedule: ScheduleName, plugs: Plugs, begun: bytes
) -> None:
    wires = Wires(plugs)
    for mux, mask in zip(wires.muxes, begun, strict=False):  # somebody used the bus before
        wires.adapter.i2c_rdwr(i2c_msg.write(mux.address, [mask]))
    unplugged = 0xFF
    reads = 0

    def before(_: int, messages: tuple[i2c_msg, ...]) -> None:
        nonlocal reads
        if len(messages) == 2:
            reads += 1
            assert open_channels(wires) == 1, "a read with more open is the AND of tiles"
        elif messages[0].addr == 0x60 and schedule in ("pipelined", "sequential"):
            assert open_channels(wires) == 1
        elif messages[0].addr == 0x60 and schedule == "per_mux":
            assert open_muxes(wires) == 1

    def after() -> None:
        # Muxes that others left open are closed one after another before anything is opened.
        nonlocal unplugged
        if schedule != "simultaneous":
            assert open_muxes(wires) <= max(1, unplugged)
            unplugged = min(unplugged, open_muxes(wires))

    wires.on_transaction, wires.after_transaction = before, after
    array = array_on(wires, schedule)
    scanned(array, 4)
    assert reads >= 3 * len(plugs)


def test_a_broadcast_reaches_the_tiles_of_the_scene_and_no_other_channel() -> None:
    wires = Wires(TWO_MUXES)
    masks = []

    def before(_: int, messages: tuple[i2c_msg, ...]) -> None:
        if messages[0].addr == 0x60 and len(messages) == 1:
            masks.append({mux.address: mux.connected_mask for mux in wires.muxes})

    wires.on_transaction = before
    array = array_on(wires, "simultaneous")
    scanned(array, 3)
    assert masks == [{0x70: 0b100001, 0x73: 0b11}] * 3


@every_schedule
@settings(max_examples=15, deadline=None)
@given(
    plugs=plugs_drawn,
    tc_ns=st.lists(st.integers(1_200_000, 3_000_000), min_size=20, max_size=20),
    scl_hz=st.sampled_from([400_000, 100_000]),
)
def test_no_read_begins_before_its_parts_conversion_is_finished(
    schedule: ScheduleName, plugs: Plugs, tc_ns: list[int], scl_hz: int
) -> None:
    wires = Wires(plugs, scl_hz, tc_ns=tc_ns[: len(plugs)])
    stop_ns: dict[int, int] = {}
    for i, tile in enumerate(wires.tiles):

        def note(
            t_ns: int, words: tuple[int, int], chip: tuple[int, int, int, int], i: int = i
        ) -> None:
            stop_ns[i] = t_ns

        tile.on_conversion = note
    at = {(mux, 1 << channel): i for i, (mux, channel) in enumerate(plugs)}
    reads = 0

    def before(_: int, messages: tuple[i2c_msg, ...]) -> None:
        nonlocal reads
        if len(messages) == 2:
            (mux,) = [mux for mux in wires.muxes if mux.connected_mask]
            i = at[mux.address, mux.connected_mask]
            assert wires.clock.now_ns() >= stop_ns[i] + wires.tc_ns[i]
            reads += 1

    wires.on_transaction = before
    array = array_on(wires, schedule)
    for _ in range(21):  # some of them with a second look at a tile
        array.scan_frame()
    assert reads >= 20 * len(plugs)


@pytest.mark.parametrize("mode", ["stale", "abort", "torn"])
@every_schedule
def test_no_conversion_is_lost_or_torn_whatever_an_early_read_would_do(
    schedule: ScheduleName, mode: ReadDuringConversion
) -> None:
    tc_ns = [1_412_345, 1_999_999, 1_600_001, 1_723_456]
    _, array = settled_on(TWO_MUXES, schedule, mode=mode, tc_ns=tc_ns)
    last = array.scan_frame().pressure_raw
    for _ in range(100):
        scan = array.scan_frame()
        assert scan.pressure_raw == [pressure_raw + 1 for pressure_raw in last]
        last = scan.pressure_raw
