"""Schedules of one frame's transfers on the bus, and the time that each takes.

Each schedule is a function that scans one frame of an array into a `Scan`. `TileArray` handles and
flags faults; a schedule is only the order. At 400 kHz with four tiles of 1.6 ms: `sequential` 132
frames a second, `simultaneous` 395, `pipelined` 544 (hardware.md 4, strategies a, b, c; `per_mux`
is d).

Timing model of hardware.md 4: START, repeated START and STOP take one SCL period each, a byte nine;
every transaction may have a fixed overhead, every sleep an overshoot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from statistics import fmean
from typing import Protocol, get_args

from devices.array.tile import Scan
from devices.errors import SceneError
from devices.scene.hardware_sections import ScheduleName


class Transfers(Protocol):
    """Transfers of an array, for a schedule to order; implemented by `TileArray`."""

    @property
    def tile_indices(self) -> Sequence[int]:
        """Indices of all tiles."""

    @property
    def tiles_by_mux(self) -> Sequence[Sequence[int]]:
        """Tile indices of each multiplexer."""

    def start_conversions(self, scan: Scan, tiles: Sequence[int]) -> None:
        """Start a conversion in all these tiles at once."""

    def read_conversion(self, scan: Scan, tile: int) -> None:
        """Read a tile's conversion as soon as it is finished."""

    def wait_for_back_to_back_reads(self) -> None:
        """Wait until all tiles can be read and restarted back to back."""


Schedule = Callable[[Transfers, Scan], None]


def sequential(array: Transfers, scan: Scan) -> None:
    """Select, convert, wait and read tile by tile: slow, and the reference for the others."""
    for tile in array.tile_indices:
        array.start_conversions(scan, [tile])
        array.read_conversion(scan, tile)


def simultaneous(array: Transfers, scan: Scan) -> None:
    """Open all channels, send one CONVERT to all tiles, wait once, then read each: no skew."""
    array.start_conversions(scan, array.tile_indices)
    for tile in array.tile_indices:
        array.read_conversion(scan, tile)


def pipelined(array: Transfers, scan: Scan) -> None:
    """Read each tile's conversion of the previous frame and restart it at once.

    While one tile converts, the others are read, so that only the first tile has a wait. Tiles are
    sampled one after another; every sample has its own instant.
    """
    array.wait_for_back_to_back_reads()
    for tile in array.tile_indices:
        array.read_conversion(scan, tile)
        array.start_conversions(scan, [tile])


def per_mux(array: Transfers, scan: Scan) -> None:
    """Send one CONVERT to all tiles of a mux, while the tiles of the other muxes are read.

    Before the tiles of a mux are read, the tiles of the previous mux, just read, are restarted:
    each mux converts while all the others are read.
    """
    for index, tiles in enumerate(array.tiles_by_mux):
        array.start_conversions(scan, array.tiles_by_mux[index - 1])
        for tile in tiles:
            array.read_conversion(scan, tile)


SCHEDULES: Mapping[ScheduleName, Schedule] = {
    "sequential": sequential,
    "simultaneous": simultaneous,
    "pipelined": pipelined,
    "per_mux": per_mux,
}


SELECT_BITS = 20  # START, address, mask, STOP
CONVERT_BITS = 29  # START, address, register, data, STOP
ADDRESS_BITS = 29
"""SCL periods before a read takes its data: START, address, register, START, address."""
_READ_BITS = 30  # START, address, register, repeated START, address, STOP
_BYTE_BITS = 9  # eight bits and the acknowledge

STORED_MAX = 32
"""Conversions that a free-running part stores until they are read; then the oldest is lost."""

BROADCASTS: tuple[ScheduleName, ...] = ("simultaneous", "per_mux")
"""Schedules that start several tiles by one command, which a free-running part does not need."""

PREFERENCE: tuple[ScheduleName, ...] = ("simultaneous", "per_mux", "pipelined", "sequential")
"""Order of preference among equally fast schedules: least skew first."""
_AS_FAST = 0.995  # rates within half a percent count as equal


def count_read_bits(*n_bytes: float) -> float:
    """Return the SCL periods of reads of `n_bytes` each from a register."""
    return sum(_READ_BITS + _BYTE_BITS * n for n in n_bytes)


@dataclass(frozen=True)
class BusTiming:
    """Timing of a bus, its host and its parts.

    Attributes:
        scl_hz: real bus clock.
        conversions_s: wait for each tile's conversion, in tile order.
        muxes: mux address of each tile.
        channels: channel of each tile; None: each has its own.
        addresses: I2C address of each tile; a command reaches those of one. None: all have one.
        free_running: whether each tile converts by itself; None: none does.
        read_bits: SCL periods of the reads of a sample; a mean if temperature is decimated, or
            chips differ.
        reads_per_sample: number of these reads, likewise.
        bits_per_conversion: SCL periods of each further conversion that a free-running tile has
            stored when it is read, likewise.
        transaction_overhead_s: overhead of one transaction beyond its bits.
        sleep_overshoot_s: overshoot of a sleep.
    """

    scl_hz: float
    conversions_s: tuple[float, ...]
    muxes: tuple[int, ...]
    read_bits: float = _READ_BITS + 4 * _BYTE_BITS
    transaction_overhead_s: float = 0.0
    sleep_overshoot_s: float = 0.0
    reads_per_sample: float = 1.0
    channels: tuple[int, ...] | None = None
    addresses: tuple[int, ...] | None = None
    free_running: tuple[bool, ...] | None = None
    bits_per_conversion: float = 0.0

    @property
    def commanded(self) -> tuple[bool, ...]:
        """True for each tile whose conversion is started by a command."""
        return tuple(not free for free in self.free_running or (False,) * len(self.muxes))

    @property
    def selects(self) -> tuple[bool, ...]:
        """True for each tile whose channel has to be selected after the tile before it."""
        places = [*zip(self.muxes, self.channels or range(len(self.muxes)), strict=True)]
        return tuple(place != places[i - 1] for i, place in enumerate(places))

    @property
    def select_s(self) -> float:
        """Duration of one write to a mux."""
        return SELECT_BITS / self.scl_hz + self.transaction_overhead_s

    @property
    def convert_s(self) -> float:
        """Duration of one CONVERT."""
        return CONVERT_BITS / self.scl_hz + self.transaction_overhead_s

    @property
    def read_s(self) -> float:
        """Duration of the reads of a tile's sample."""
        return self.read_bits / self.scl_hz + self.reads_per_sample * self.transaction_overhead_s

    @property
    def tile_counts_by_mux(self) -> tuple[int, ...]:
        """Number of tiles behind each mux."""
        return tuple(self.muxes.count(mux) for mux in sorted(set(self.muxes)))


def compute_frame_s(schedule: ScheduleName, timing: BusTiming) -> float:
    """Compute the frame period of a schedule, in seconds."""
    frame_s = _compute_frame_s(schedule, timing)
    free_s = [*compress(timing.conversions_s, timing.free_running or ())]
    if free_s:
        # A longer frame finds more conversions, which take longer to read; at the start, most.
        frame_s = STORED_MAX * max(free_s)
        for _ in range(_ROUNDS):
            found = [min(max(1.0, frame_s / each + _IN_VAIN), STORED_MAX) for each in free_s]
            bits = timing.read_bits + (fmean(found) - 1.0) * timing.bits_per_conversion
            frame_s = _compute_frame_s(schedule, replace(timing, read_bits=bits))
    return frame_s


_ROUNDS = 100
_IN_VAIN = 0.1  # conversions that a read expects too soon, and further reads where one was late


def _compute_frame_s(schedule: ScheduleName, timing: BusTiming) -> float:
    n, m = len(timing.muxes), len(timing.tile_counts_by_mux)
    s, c, r = timing.select_s, timing.convert_s, timing.read_s
    waits = [wait + timing.sleep_overshoot_s for wait in timing.conversions_s]
    turns = [
        wait + r + c if begins else max(wait, r)
        for wait, begins in zip(waits, timing.commanded, strict=True)
    ]
    if n == 1:  # the mux stays selected, and nothing overlaps the wait
        return turns[0]
    selects, closes = sum(timing.selects), m if m > 1 else 0
    busy = (selects + closes) * s + n * r + sum(timing.commanded) * c
    if schedule == "sequential":
        waited = sum(w for w, begins in zip(waits, timing.commanded, strict=True) if begins)
        return max(busy + waited, *turns)
    if schedule == "pipelined":
        return max(busy, *turns)
    c *= len(set(timing.addresses or (0,)))
    if schedule == "simultaneous" or m == 1:
        # The first select, and the closing of the other muxes, are hidden in the wait.
        return m * s + c + max(*waits, m * s) + n * r + (max(1, selects) - 1 + m - 1) * s
    start = 2 * s + c  # open a mux, convert, close it
    reads = []
    for mux in sorted(set(timing.muxes)):
        ours = [
            select for select, of in zip(timing.selects, timing.muxes, strict=True) if of == mux
        ]
        reads.append(sum(ours) * s + len(ours) * r + s)
    return max(m * start + sum(reads), max(waits) + start + max(reads))


def compute_turns_s(timing: BusTiming) -> tuple[float, ...]:
    """Compute the delay from the begin of a pipelined frame to each tile's read, without waits."""
    turns = []
    t_s, alone = 0.0, len(timing.muxes) == 1
    for i, mux in enumerate(timing.muxes):
        leaves = mux != timing.muxes[i - 1]  # the first tile comes after the last one
        t_s += 0.0 if alone else (timing.selects[i] + leaves) * timing.select_s
        turns.append(t_s)
        t_s += timing.read_s + timing.convert_s * timing.commanded[i]
    return tuple(turns)


def compute_rates_hz(timing: BusTiming) -> dict[ScheduleName, float]:
    """Compute the frame rate of every schedule that suits the tiles."""
    return {
        name: 1.0 / compute_frame_s(name, timing)
        for name in get_args(ScheduleName)
        if name not in BROADCASTS or all(timing.commanded)
    }


def count_broadcast_channels(schedule: ScheduleName, muxes: Sequence[int]) -> int:
    """Return the largest number of channels that a schedule opens at once."""
    if schedule == "simultaneous":
        return len(muxes)
    if schedule == "per_mux":
        return max(muxes.count(mux) for mux in muxes)
    return 1


def check_broadcast_channels(
    schedule: ScheduleName, muxes: Sequence[int], channels_max: int
) -> None:
    """Check that a schedule's broadcast does not exceed the drive strength of a part.

    Every open channel adds its pull-ups, and in a read one part alone sinks their current: at most
    3 mA at 0.4 V (TCA9548A data sheet 9.2.1, hardware.md 2).

    Raises:
        SceneError: more channels at once than `channels_max`.
    """
    width = count_broadcast_channels(schedule, muxes)
    if width > channels_max:
        raise SceneError(
            f"schedule {schedule!r} opens {width} channels at once",
            where="array.broadcast_channels",
            expected=f"at most {channels_max}: one part has to sink the pull-ups of all of them",
            remedy='Use schedule = "per_mux" or "pipelined"; raise the bound only if the pull-ups '
            "of the channels are weak enough (10 kOhm for 8 channels)",
        )


@dataclass(frozen=True)
class ScheduleChoice:
    """Chosen schedule, and the reason in one sentence."""

    schedule: ScheduleName
    reason: str


def choose_schedule(
    timing: BusTiming, *, requested_rate_hz: float, channels_max: int
) -> ScheduleChoice:
    """Choose the schedule without skew if it is fast enough, else the fastest.

    Args:
        timing: measured timing of bus and parts.
        requested_rate_hz: requested frame rate; 0: as fast as possible.
        channels_max: largest number of channels open at once.
    """
    n, m = len(timing.muxes), len(timing.tile_counts_by_mux)
    rates = {
        name: rate
        for name, rate in compute_rates_hz(timing).items()
        if count_broadcast_channels(name, timing.muxes) <= channels_max
    }
    where = f"{n} tile{'s' * (n > 1)} on {m} mux{'es' * (m > 1)}"
    if requested_rate_hz and rates.get("simultaneous", 0.0) >= requested_rate_hz:
        return ScheduleChoice(
            "simultaneous",
            f"{where}: simultaneous has no skew and holds the {requested_rate_hz:g} frames/s "
            "asked for",
        )
    best = max(rates.values())
    name = next(name for name in PREFERENCE if rates.get(name, 0.0) >= _AS_FAST * best)
    return ScheduleChoice(name, f"{where}: {format_rates(rates, name)}")


def format_rates(rates: Mapping[ScheduleName, float], first: ScheduleName) -> str:
    """Format rates as text, `first` first."""
    others = [f"{other} {rate:.0f}" for other, rate in rates.items() if other != first]
    return f"{first} gives {rates[first]:.0f} frames/s, {', '.join(others)}"
