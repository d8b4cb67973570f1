"""One emulated TCA9548A, called as its two wires would call it."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, EmulatedPart
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.fault_timing import FaultTiming


def tile() -> EmulatedMpl115a2:
    return EmulatedMpl115a2(EmulatedPart((0, 0, 0, 0), 1_600_000, lambda _: (0, 0)))


def write(mux: EmulatedTca9548a, *values: int) -> None:
    assert mux.on_address(False, 0)
    assert all(mux.receive_byte(value) for value in values)


@given(before=st.integers(0, 255), after=st.integers(0, 255))
def test_a_written_mask_is_latched_at_once_and_in_force_from_the_stop(
    before: int, after: int
) -> None:
    tiles = {channel: tile() for channel in range(8)}
    mux = EmulatedTca9548a(0x70, tiles)
    write(mux, before)
    mux.on_stop(0)
    write(mux, after)
    assert mux.connected_mask == before
    assert list(mux.get_connected_devices()) == [t for c, t in tiles.items() if before >> c & 1]
    mux.on_stop(0)
    assert mux.connected_mask == after
    assert list(mux.get_connected_devices()) == [t for c, t in tiles.items() if after >> c & 1]


@given(values=st.binary(min_size=1, max_size=5), count=st.integers(0, 4))
def test_the_last_byte_counts_and_every_byte_of_a_read_is_the_register(
    values: bytes, count: int
) -> None:
    mux = EmulatedTca9548a(0x70, {})
    write(mux, *values)
    mux.on_stop(0)
    assert mux.connected_mask == values[-1]
    mux.on_address(True, 0)
    assert mux.send_bytes(count) == values[-1:] * count


def test_a_stop_without_a_write_changes_nothing() -> None:
    mux = EmulatedTca9548a(0x70, {})
    write(mux, 0x81)
    mux.on_stop(0)
    mux.on_address(True, 0)
    mux.send_bytes(1)
    mux.on_stop(0)
    assert mux.connected_mask == 0x81


def test_a_channel_without_a_tile_connects_nothing() -> None:
    mux = EmulatedTca9548a(0x70, {1: tile()})
    write(mux, 0b1111_1101)
    mux.on_stop(0)
    assert list(mux.get_connected_devices()) == []


def between(begin_ns: int, end_ns: int) -> FaultTiming:
    """A fault that is there in one window of time."""
    fault = FaultTiming([(begin_ns * 1e-9, end_ns * 1e-9)])
    fault.begin_scene_time(0)
    return fault


def open_mux(
    brown_out: FaultTiming | None = None, mux_reset: FaultTiming | None = None
) -> EmulatedTca9548a:
    mux = EmulatedTca9548a(0x70, {0: tile()}, brown_out, mux_reset)
    write(mux, 1)
    mux.on_stop(0)
    return mux


def test_a_mux_without_supply_is_silent_and_connects_nothing_afterwards() -> None:
    mux = open_mux(brown_out=between(100, 200))
    mux.apply_faults(99)
    assert mux.on_address(False, 99)
    assert mux.connected_mask == 1
    mux.apply_faults(100)
    assert not mux.on_address(False, 100)
    assert not mux.on_address(True, 199)
    assert mux.connected_mask == 0
    mux.apply_faults(200)
    assert mux.on_address(True, 200)
    assert (mux.connected_mask, mux.send_bytes(1)) == (0, b"\0")


def test_a_brown_out_between_two_transfers_has_deselected_everything_silently() -> None:
    mux = open_mux(brown_out=between(100, 200))
    mux.apply_faults(50)
    mux.apply_faults(300)
    assert mux.on_address(True, 300)
    assert (mux.connected_mask, mux.send_bytes(1)) == (0, b"\0")


def test_a_mux_that_was_reset_can_be_opened_again_at_once() -> None:
    mux = open_mux(mux_reset=between(100, 200))
    mux.apply_faults(50)
    mux.apply_faults(150)
    assert mux.on_address(False, 150)
    assert mux.connected_mask == 0
    assert mux.receive_byte(1)
    mux.on_stop(150)
    mux.apply_faults(160)
    assert mux.connected_mask == 1, "once, not for as long as the fault is said to last"


def test_the_reset_line_forgets_what_was_latched_but_not_yet_in_force() -> None:
    mux = EmulatedTca9548a(0x70, {0: tile()})
    write(mux, 1)
    mux.reset()
    mux.on_stop(0)
    assert mux.connected_mask == 0
