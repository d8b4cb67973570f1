"""Emulated tiles behind an adapter that records its transactions and can be made to fail."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, get_args

import pytest
from smbus2 import i2c_msg

from devices.array.bus_recovery import BusRecovery
from devices.array.schedules import BusTiming, count_read_bits
from devices.array.tile import Scan
from devices.array.tile_array import TileArray
from devices.buses.i2c import I2cBus
from devices.clock import VirtualClock
from devices.emulation.chips.mpl115a2 import (
    EmulatedMpl115a2,
    Mpl115a2Part,
    SampleFunction,
)
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.fault_timing import PartFaults, SceneFaults
from devices.emulation.i2c_bus import EmulatedI2cAdapter, FaultyWires
from devices.emulation.parts import make_rng
from devices.errors import BusSetupError
from devices.frames import TileInfo
from devices.scene.emulation_sections import BUS_TARGET, FaultKind, PartFault, ReadDuringConversion
from devices.scene.hardware_sections import ScheduleName
from tests.builders.arrays import DATA_SHEET_CHIP, make_tile

# SCL periods per transaction, hardware.md 4
SELECT, CONVERT, READ, READ_PRESSURE, COEFFICIENTS, NOT_ACKNOWLEDGED = 20, 29, 66, 48, 102, 11
TYPICAL_NS = 1_600_000

SETTLED = 3
"""Frames after which every tile has the history that a reading is compared with."""

Words = tuple[int, int, int, int]
LOOK_FRAMES = 10
"""In one of so many frames a tile is read again before it is started."""

Plugs = tuple[tuple[int, int], ...]
ONE: Plugs = ((0x70, 0),)
FOUR: Plugs = ((0x70, 0), (0x70, 1), (0x70, 2), (0x70, 3))
TWO_MUXES: Plugs = ((0x70, 0), (0x70, 5), (0x73, 0), (0x73, 1))

SCHEDULES: tuple[ScheduleName, ...] = ("simultaneous", "pipelined", "per_mux", "sequential")
every_schedule = pytest.mark.parametrize("schedule", SCHEDULES)
BIT_NS = 2_500
WHOLE_NS = (4 * SELECT + CONVERT + 4 * READ) * BIT_NS + TYPICAL_NS
"""Length of a simultaneous frame of four tiles."""


def full(tiles: int) -> Plugs:
    """Return the plugs of so many tiles, eight to a mux."""
    return tuple((0x70 + i // 8, i % 8) for i in range(tiles))


def counting(first: int) -> SampleFunction:
    """Return a sense of which no two samples are equal; its hundreds are those of `first`."""
    results: Iterator[int] = iter(range(first, first + 10_000_000))
    return lambda _: (1 + next(results) % 1000, 500)


class Adapter:
    """Calls of an I2C adapter on which its transactions do not depend."""

    def set_timeout(self, units_10ms: int) -> None:
        pass

    def close(self) -> None:
        pass


class Wires(Adapter):
    """Emulated tiles behind an adapter that records its transactions and can be made to fail.

    `on_transaction` is called with the number and the messages of each transaction before it,
    `after_transaction` after it. `words` are the coefficients of single tiles, `tc_ns` their
    conversion times.
    """

    def __init__(
        self,
        plugs: Plugs,
        scl_hz: float = 400_000,
        *,
        words: dict[int, Words] | None = None,
        tc_ns: Sequence[int] | int = TYPICAL_NS,
        mode: ReadDuringConversion = "stale",
    ) -> None:
        self.plugs = plugs
        self.scl_hz = scl_hz
        self.words = [(words or {}).get(i, DATA_SHEET_CHIP) for i in range(len(plugs))]
        self.tc_ns = [tc_ns] * len(plugs) if isinstance(tc_ns, int) else list(tc_ns)
        self.clock = VirtualClock(7_000_000_000)
        self._faults = SceneFaults(())
        self.tiles = [
            EmulatedMpl115a2(
                Mpl115a2Part(self.words[i], self.tc_ns[i], counting(100 * i)),
                mode,
                self._part_faults(f"T{i + 1:02d}"),
            )
            for i in range(len(plugs))
        ]
        self.muxes = [
            EmulatedTca9548a(
                address,
                [(c, tile) for (m, c), tile in zip(plugs, self.tiles, strict=True) if m == address],
                self._faults.get_fault("brown_out", f"0x{address:02x}"),
                self._faults.get_fault("mux_reset", f"0x{address:02x}"),
            )
            for address in sorted({mux for mux, _ in plugs})
        ]
        line = FaultyWires(self._faults, "test")
        self.adapter = EmulatedI2cAdapter(self.muxes, self.clock, scl_hz, line)
        self.log: list[str] = []
        self.on_transaction: Callable[[int, tuple[i2c_msg, ...]], None] = lambda _, __: None
        self.after_transaction: Callable[[], None] = lambda: None

    def _part_faults(self, serial: str) -> PartFaults:
        own = {kind: self._faults.get_fault(kind, serial) for kind in get_args(PartFault)}
        return PartFaults(**own, scene=self._faults)

    def fault(self, kind: FaultKind, target: str = BUS_TARGET) -> AbstractContextManager[None]:
        """Inject a fault while the block runs: of a tile ("T01"), a mux ("0x70") or the bus."""
        return self._faults.inject(kind, target)

    @property
    def bus(self) -> I2cBus:
        return I2cBus(self, "emulated")

    @property
    def infos(self) -> tuple[TileInfo, ...]:
        """Tiles as a self-test finds them."""
        return tuple(
            make_tile(
                i,
                mux=mux,
                channel=channel,
                registers=self.words[i],
                conversion_ms=self.tc_ns[i] / 1e6,
            )
            for i, (mux, channel) in enumerate(self.plugs)
        )

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        self.log.append(
            " ".join(
                f"{m.addr:02x}>{m.len}" if m.flags & 1 else f"{m.addr:02x}<{bytes(m).hex()}"
                for m in i2c_msgs
            )
        )
        self.on_transaction(len(self.log), i2c_msgs)
        self.adapter.i2c_rdwr(*i2c_msgs)
        self.after_transaction()

    def set_timeout(self, units_10ms: int) -> None:
        self.adapter.set_timeout(units_10ms)


@dataclass
class ScriptedRecovery:
    """A recovery that records its calls, may fail, and may free SDA."""

    adapter: EmulatedI2cAdapter
    clock: VirtualClock
    fails: bool = False
    reports_free: bool = True
    clocks_free: bool = False
    reset_frees: bool = False
    has_reset: bool = True
    resets: int = field(default=0, init=False)
    asked_ns: list[int] = field(default_factory=list, init=False)

    def send_recovery_clocks(self) -> bool:
        self.asked_ns.append(self.clock.now_ns())
        if self.fails:
            raise BusSetupError("another program has the lines", where="gpio", errno=16)
        if self.clocks_free:
            self._free_sda()
        return self.reports_free

    def reset_muxes(self) -> bool:
        self.resets += 1
        if self.reset_frees:
            self._free_sda()
        return self.has_reset

    def _free_sda(self) -> None:
        self.adapter.line.sda_low.end_at(self.clock.now_ns())


def array_on(
    wires: Wires,
    schedule: ScheduleName = "simultaneous",
    *,
    waits_ns: Sequence[int] | None = None,
    temperature_every: int = 1,
    broadcast_channels: int = 64,
    recovery: BusRecovery | None = None,
    reference_n: Callable[[], float] | None = None,
) -> TileArray:
    """Return an array that waits as long as each part converts, or for `waits_ns`."""
    timing = BusTiming(
        wires.scl_hz,
        tuple(wait_ns * 1e-9 for wait_ns in waits_ns or wires.tc_ns),
        tuple(mux for mux, _ in wires.plugs),
        read_bits=count_read_bits(2.0 + 2.0 / temperature_every),
    )
    return TileArray(
        wires.bus,
        wires.infos,
        wires.clock,
        schedule=schedule,
        timing=timing,
        temperature_every=temperature_every,
        broadcast_channels=broadcast_channels,
        recovery=recovery,
        read_reference_n=reference_n,
    )


def settled(wires: Wires, schedule: ScheduleName = "simultaneous", **options: Any) -> TileArray:
    """Return an array after the frames in which every reading is read twice."""
    array = array_on(wires, schedule, **options)
    scanned(array, SETTLED + 1)
    return array


def settled_on(
    plugs: Plugs, schedule: ScheduleName = "simultaneous", **how: Any
) -> tuple[Wires, TileArray]:
    """Return tiles on these plugs, and an array that has their history."""
    wires = Wires(plugs, **how)
    return wires, settled(wires, schedule)


def scanned(array: TileArray, frames: int) -> Scan:
    """Return the last of so many frames."""
    for _ in range(frames - 1):
        array.scan_frame()
    return array.scan_frame()


def timed_scan(array: TileArray, wires: Wires) -> tuple[Scan, int]:
    """Return one frame and its length in ns."""
    begin_ns = wires.clock.now_ns()
    return array.scan_frame(), wires.clock.now_ns() - begin_ns


def hesitating(wires: Wires, seed: int, least_ns: int = 500_000) -> None:
    """Delay some transfers, by so much or up to 5 ms, as a busy machine does."""
    rng = make_rng(f"machine {seed}")

    def hesitate(_: int, __: tuple[i2c_msg, ...]) -> None:
        if rng.random() < 0.05:
            late_ns = int(rng.integers(least_ns, 5_000_000))
            wires.clock.sleep_until_ns(wires.clock.now_ns() + late_ns)

    wires.on_transaction = hesitate


def failing(
    number: int, when: Callable[[int, tuple[i2c_msg, ...]], bool] = lambda _, __: True
) -> Callable[[int, tuple[i2c_msg, ...]], None]:
    """Return an `on_transaction` that fails with an errno when `when` is true."""

    def on_transaction(count: int, messages: tuple[i2c_msg, ...]) -> None:
        if when(count, messages):
            raise OSError(number, "injected")

    return on_transaction
