"""One emulated TCA9548A, called as its two wires call it."""

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


@given(before=st.integers(0, 255), after=st.binary(min_size=1, max_size=5), count=st.integers(0, 4))
def test_the_last_byte_written_is_the_mask_from_the_stop_on(
    before: int, after: bytes, count: int
) -> None:
    tiles = {channel: tile() for channel in range(7)}  # none on channel 7
    mux = EmulatedTca9548a(0x70, tiles)

    def connected(mask: int) -> list[EmulatedMpl115a2]:
        return [t for c, t in tiles.items() if mask >> c & 1]

    write(mux, before)
    mux.on_stop(0)
    write(mux, *after)
    assert mux.connected_mask == before
    assert list(mux.get_connected_devices()) == connected(before)
    mux.on_stop(0)
    for _ in range(2):  # a read and its STOP change nothing
        assert mux.connected_mask == after[-1]
        assert list(mux.get_connected_devices()) == connected(after[-1])
        mux.on_address(True, 0)
        assert mux.send_bytes(count) == after[-1:] * count
        mux.on_stop(0)


# Faults


def open_mux(**faults: tuple[int, int]) -> EmulatedTca9548a:
    """Return a mux with channel 0 open and each fault in one interval of nanoseconds."""
    timings = {
        name: FaultTiming([(begin_ns * 1e-9, end_ns * 1e-9)])
        for name, (begin_ns, end_ns) in faults.items()
    }
    for timing in timings.values():
        timing.begin_scene_time(0)
    mux = EmulatedTca9548a(0x70, {0: tile()}, timings.get("brown_out"), timings.get("mux_reset"))
    write(mux, 1)
    mux.on_stop(0)
    return mux


def test_a_mux_without_supply_is_silent_and_connects_nothing_afterwards() -> None:
    mux = open_mux(brown_out=(100, 200))
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


def test_a_brown_out_between_two_transfers_closes_all_channels() -> None:
    mux = open_mux(brown_out=(100, 200))
    mux.apply_faults(50)
    mux.apply_faults(300)
    assert mux.on_address(True, 300)
    assert (mux.connected_mask, mux.send_bytes(1)) == (0, b"\0")


def test_a_mux_can_be_opened_at_once_after_its_reset() -> None:
    mux = open_mux(mux_reset=(100, 200))
    mux.apply_faults(50)
    mux.apply_faults(150)
    assert mux.on_address(False, 150)
    assert mux.connected_mask == 0
    assert mux.receive_byte(1)
    mux.on_stop(150)
    mux.apply_faults(160)
    assert mux.connected_mask == 1, "it is reset once"


def test_the_reset_line_clears_a_mask_that_is_not_yet_in_force() -> None:
    mux = EmulatedTca9548a(0x70, {0: tile()})
    write(mux, 1)
    mux.reset()
    mux.on_stop(0)
    assert mux.connected_mask == 0
