"""What a bus and its parts really do, measured over that bus before the first frame.

How long a part takes to convert differs from part to part (1.6 ms typical, 3 ms at most, MPL115A2
data sheet table 10) and no bit says when it is done. What a read during a conversion does is not
documented: it may return the last result, abort the conversion, or return the new pressure with the
old temperature (hardware.md 1.4). So there is one read per CONVERT here, never a poll, and no power
cycle; whether a conversion was finished shows in words that changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from devices.array.budget import CONVERT_BITS, read_bits
from devices.buses.i2c import I2cBus, i2c_msg
from devices.chips.mpl115a2 import (
    ADDRESS,
    CONVERSION_MAX_NS,
    CONVERSION_TYPICAL_NS,
    REGISTER_COEFFICIENTS,
    Mpl115a2,
)
from devices.chips.tca9548a import ADDRESSES, CHANNELS, MuxRouter, Tca9548a
from devices.clock import Clock
from devices.errors import BusFaultError, NoAcknowledgeError, TileSetupError
from devices.frames import TileInfo
from devices.scene.hardware import TileScene

_SETTLED_NS = 3_200_000  # the longest conversion and a little more
_SHORTEST_NS = 800_000  # half the typical time: no part is that fast
_RESOLUTION_NS = 8_000  # half a percent of the typical time
_NEVER_NS = 1 << 62
_SAME_MAX = 8
"""So many readings without any change, and a conversion is taken to be unfinished. Of two healthy
readings one in nine is equal by chance, in one of 10^7 cases all eight are."""
_TEMPERATURE_SAME_MAX = 20
"""The same for the temperature alone, which is loaded last; every second one is equal by chance."""
_MARGIN = 1.004
"""Allowance for the drift of a part's clock; a part that drifts further is noticed in the run."""

_ADDRESS_BITS = 29
"""SCL periods before a read takes its data: START, address, register, START, address."""

_SCL_READS = 100
_UNDISTURBED = 0.1
"""Part of the reads that is taken to be undisturbed by what the machine did meanwhile."""
_SCL_BYTES = (2, 12)  # far apart, within the part's registers


def identify(bus: I2cBus, tiles: Sequence[TileScene]) -> tuple[TileInfo, ...]:
    """Find every tile of a scene, one channel at a time, and read its coefficients three times.

    One at a time, because in a broadcast the acknowledge is a wired AND: a missing tile does not
    show (hardware.md 2).

    Raises:
        TileSetupError: a tile or its mux does not answer, or its coefficients are implausible.
        BusFaultError: the bus itself fails.
    """
    _all_closed(bus)
    router = MuxRouter(bus, (tile.mux for tile in tiles))
    chip = Mpl115a2(bus)
    return tuple(_identify(router, chip, tile) for tile in tiles)


def _identify(router: MuxRouter, chip: Mpl115a2, tile: TileScene) -> TileInfo:
    where = f"tile {tile.serial} (mux 0x{tile.mux:02x} channel {tile.channel})"
    try:
        router.connect_only(tile.mux, tile.channel)
        words = chip.read_coefficient_words(where=where)
    except NoAcknowledgeError as error:
        raise TileSetupError(
            f"does not answer: {error}",
            where=where,
            remedy="Plug it in, or take it out of the scene file",
        ) from error
    return TileInfo(
        serial=tile.serial,
        mux=tile.mux,
        channel=tile.channel,
        coefficient_words=words,
        x_m=tile.x_m,
        y_m=tile.y_m,
        z_m=tile.z_m,
        reference=tile.reference,
        conversion_ms=CONVERSION_TYPICAL_NS / 1e6,
    )


@dataclass(frozen=True)
class Plug:
    """One channel of one mux, and what answers there at 0x60.

    Attributes:
        mux: address of the mux.
        channel: 0 to 7.
        coefficient_words: of the part; None if its coefficients are no part's.
        problem: what is wrong with it; empty if nothing is.
    """

    mux: int
    channel: int
    coefficient_words: tuple[int, int, int, int] | None
    problem: str = ""


def find_tiles(bus: I2cBus) -> tuple[Plug, ...]:
    """Look behind every mux address and channel, one at a time, whatever a scene says.

    Raises:
        BusFaultError: the bus itself fails, or acknowledges everything and gives nothing but zeros.
    """
    muxes = _all_closed(bus)
    router = MuxRouter(bus, muxes)
    if muxes and not router.echoes():
        raise BusFaultError(
            f"{len(muxes)} multiplexers acknowledge, and none keeps what is written to it",
            where=bus.name,
            remedy="SDA is stuck low: pull the tiles' plugs one by one, or cycle their supply",
        )
    chip = Mpl115a2(bus)
    plugs = []
    for mux in muxes:
        for channel in CHANNELS:
            try:
                router.connect_only(mux, channel)
                words = chip.read_coefficient_words(where=f"mux 0x{mux:02x} channel {channel}")
                plugs.append(Plug(mux, channel, words))
            except NoAcknowledgeError:
                continue
            except TileSetupError as error:
                plugs.append(Plug(mux, channel, None, str(error)))
    return tuple(plugs)


def _all_closed(bus: I2cBus) -> list[int]:
    """Addresses of all muxes that are there, now closed.

    A tile behind one that was left open would answer with those that are asked.
    """
    return [address for address in ADDRESSES if _answers(bus, address)]


def _answers(bus: I2cBus, address: int) -> bool:
    try:
        Tca9548a(bus, address).write_mask(0)
    except NoAcknowledgeError:
        return False
    return True


@dataclass(frozen=True)
class WireTiming:
    """How fast the wires are, and what a transaction costs beyond its bits."""

    scl_hz: float
    transaction_s: float


def measure_wires(bus: I2cBus, clock: Clock, tile: TileInfo) -> WireTiming:
    """Measure SCL by the difference of two lengths of reading: nine periods for every byte.

    The adapter's nominal rate is not to be trusted: on a Raspberry Pi it follows the core's clock
    (hardware.md 3.2). What reads of both lengths have in common is the overhead.

    Raises:
        I2cError: the tile does not answer.
    """
    router = MuxRouter(bus, _all_closed(bus))
    router.connect_only(tile.mux, tile.channel)
    point = i2c_msg.write(ADDRESS, [REGISTER_COEFFICIENTS])
    took_ns: dict[int, list[int]] = {n: [] for n in _SCL_BYTES}
    reads = {n: i2c_msg.read(ADDRESS, n) for n in _SCL_BYTES}
    for _ in range(_SCL_READS):
        for n, read in reads.items():  # in turn, so that a drift of the load touches both
            begin_ns = clock.now_ns()
            bus.transfer(point, read)
            took_ns[n].append(clock.now_ns() - begin_ns)
    undisturbed = round(_UNDISTURBED * _SCL_READS)
    short_ns, long_ns = (sorted(took_ns[n])[undisturbed] for n in _SCL_BYTES)
    periods = 9 * (_SCL_BYTES[1] - _SCL_BYTES[0])
    scl_hz = 1e9 * periods / max(1.0, long_ns - short_ns)
    overhead_s = short_ns * 1e-9 - read_bits(_SCL_BYTES[0]) / scl_hz
    return WireTiming(scl_hz, max(0.0, overhead_s))


def measure_conversion_ns(
    bus: I2cBus, clock: Clock, tile: TileInfo, wires: WireTiming
) -> int | None:
    """The longest that a conversion of this part takes; None if its words do not show it.

    Bisects the delay from CONVERT to the one read. Each trial has two conversions: one read after
    the longest time that a conversion may take, and one read at the delay in question. If the
    second one's temperature differs from the first one's, it was finished, because the temperature
    is loaded last: that is proof. That nothing differs, many times, is taken for unfinished; an
    error there makes the time too long, never too short. The address of a read takes time on the
    wires before the data is taken, which counts: who waits for the result does not even begin to
    read before it is there.

    Raises:
        I2cError: the part does not answer.
    """
    router = MuxRouter(bus, _all_closed(bus))
    router.connect_only(tile.mux, tile.channel)
    chip = Mpl115a2(bus)

    wires_ns = round(1e9 * (CONVERT_BITS + read_bits(4.0)) / wires.scl_hz)
    wires_ns += round(2e9 * wires.transaction_s)

    def convert_and_read(delay_ns: int) -> tuple[tuple[int, int], int]:
        """The words, and how long after CONVERT they may have been read at the latest.

        A busy machine may hesitate before either transaction, so all of the time counts that the
        wires themselves did not take.
        """
        begin_ns = clock.now_ns()
        chip.convert()
        stop_ns = clock.now_ns()
        clock.sleep_until_ns(stop_ns + delay_ns)
        words = chip.read_counts()
        waited_ns = max(delay_ns, clock.now_ns() - begin_ns - wires_ns)
        clock.sleep_until_ns(stop_ns + _SETTLED_NS)
        return words, waited_ns

    def finished_within(delay_ns: int, known_ns: int) -> int | None:
        """The wait after which a conversion was seen to be finished; None if none was.

        A wait of `known_ns` or more, which is known to be enough, proves nothing new. If too few
        shorter waits were tried, the result is `known_ns`.
        """
        in_time = 0
        pressure_changed = False
        for _ in range(_TEMPERATURE_SAME_MAX):
            settled, _ = convert_and_read(_SETTLED_NS)
            words, waited_ns = convert_and_read(delay_ns)
            if waited_ns >= known_ns and words != settled:
                continue
            if words[1] != settled[1]:
                return waited_ns
            in_time += 1
            pressure_changed |= words[0] != settled[0]
            if in_time >= _SAME_MAX and not pressure_changed:
                return None
        return None if in_time >= _SAME_MAX else known_ns

    delay_ns = _bisected(finished_within)
    if delay_ns is None:
        return None
    return min(CONVERSION_MAX_NS, round((delay_ns + _ADDRESS_BITS * 1e9 / wires.scl_hz) * _MARGIN))


def _bisected(finished_within: Callable[[int, int], int | None]) -> int | None:
    if finished_within(CONVERSION_MAX_NS, _NEVER_NS) is None:
        return None
    unfinished_ns, finished_ns = _SHORTEST_NS, CONVERSION_MAX_NS
    while finished_ns - unfinished_ns > _RESOLUTION_NS:
        middle_ns = (unfinished_ns + finished_ns) // 2
        waited_ns = finished_within(middle_ns, finished_ns)
        if waited_ns is None:
            unfinished_ns = middle_ns
        elif waited_ns < finished_ns:
            finished_ns = waited_ns  # a sleep ends late: the real wait counts
        else:
            break  # this machine's sleeps are not finer than that
    return finished_ns
