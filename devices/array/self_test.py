"""Self-test of bus and parts before the first frame: identity, bus clock, conversion times.

Conversion times differ from part to part, and no bit of an MPL115A2 signals the end. The effect of
a read during a conversion is not documented: it may return the last result, abort the conversion,
or return the new pressure with the old temperature (hardware.md 1.4). So this module reads once per
CONVERT, never polls, and cycles no power; changed counts show that a conversion has finished.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise, product
from statistics import linear_regression, median

from devices.array.schedules import ADDRESS_BITS, CONVERT_BITS, count_read_bits
from devices.buses.i2c import I2cBus, i2c_msg
from devices.buses.usb_adapters import find_adapter
from devices.chips.pressure_chip import ChipDriver, ChipSettings, Counts, PressureChip, Registers
from devices.chips.pressure_chips import PRESSURE_CHIPS, get_chip
from devices.chips.tca9548a import ADDRESSES, CHANNELS, MuxRouter, Tca9548a
from devices.clock import Clock
from devices.errors import BusFaultError, NoAcknowledgeError, TileSetupError
from devices.frames import TileInfo
from devices.scene.hardware_sections import TileSection

_SPARE_NS = 200_000  # beyond the longest conversion
_SHORTEST_DIVISOR = 2  # of the typical time: no part is that fast
_RESOLUTION_DIVISOR = 200  # of the typical time
_NEVER_NS = 1 << 62
_SAME_MAX = 8
"""Unchanged readings from which a conversion counts as unfinished. Two of a healthy MPL115A2 are
equal by chance in one of nine cases, eight in one of 10^7."""
_TEMPERATURE_SAME_MAX = 20
"""Limit like `_SAME_MAX`, for the temperature alone, which is equal by chance in every second
reading. It is loaded last."""
MARGIN = 1.004
"""Allowance for the drift of a part's clock; a larger drift is detected while running."""

_STATUS_CONVERSIONS = 48
"""Conversions that are timed where a status tells their end. The first of free-running ones may
have ended earlier."""
_FREE_CONVERSIONS_MIN, _FREE_CONVERSIONS_NS = 8, 100_000_000
"""Fewest free-running ones, and time for more: a long one is timed as exactly by fewer."""

_SCL_READS = 100
_UNDISTURBED = 0.1
"""Part of the reads that is assumed to be undisturbed by other load of the machine."""
_SCL_BYTES = (2, 12)  # far apart, within the part's registers
_SCL_AGREE = 1.2
"""Ratio up to which the differences of four parts of the reads agree."""
_SCL_MAX_HZ = 1_000_000.0
"""Fast-mode Plus, the fastest of these chips (UM10204)."""


def identify_tiles(bus: I2cBus, tiles: Sequence[TileSection]) -> tuple[TileInfo, ...]:
    """Identify every tile of a scene, one channel at a time, by equal readings of its registers.

    One at a time, because in a broadcast the acknowledge is a wired AND, which hides a missing tile
    (hardware.md 2).

    Raises:
        TileSetupError: a tile or its mux does not answer, or its registers are implausible.
        BusFaultError: the bus itself fails.
    """
    _close_muxes(bus)
    router = MuxRouter(bus, (tile.mux for tile in tiles))
    return tuple(_identify_tile(bus, router, tile) for tile in tiles)


def _identify_tile(bus: I2cBus, router: MuxRouter, tile: TileSection) -> TileInfo:
    chip = get_chip(tile.chip)
    where = f"tile {tile.serial} (mux 0x{tile.mux:02x} channel {tile.channel})"
    try:
        router.connect_single_channel(tile.mux, tile.channel)
        registers = _identify_and_start_up(bus, chip, tile.chip_address, tile.chip_settings, where)
    except NoAcknowledgeError as error:
        raise TileSetupError(
            f"does not answer: {error}",
            where=where,
            remedy="Plug it in, or take it out of the scene file",
        ) from error
    return make_tile_info(tile, registers)


def make_tile_info(tile: TileSection, registers: Registers) -> TileInfo:
    """Make the description of a scene's tile from its registers, with its usual conversion time."""
    settings = tile.chip_settings
    return TileInfo(
        serial=tile.serial,
        mux=tile.mux,
        channel=tile.channel,
        chip=tile.chip,
        address=tile.chip_address,
        registers=registers,
        settings=settings,
        x_m=tile.x_m,
        y_m=tile.y_m,
        z_m=tile.z_m,
        reference=tile.reference,
        conversion_ms=get_chip(tile.chip).compute_conversion_ns(settings)[0] / 1e6,
    )


def _identify_and_start_up(
    bus: I2cBus, chip: PressureChip, address: int, settings: Registers, where: str
) -> Registers:
    driver = chip.make_driver(bus, address)
    registers = driver.identify(
        where=where
    )  # first: another chip at this address is not written to
    driver.start_up(settings)
    return registers


@dataclass(frozen=True)
class FoundTile:
    """Device found at a pressure chip's address behind a channel of a mux.

    Attributes:
        mux: address of the mux.
        channel: 0 to 7.
        chip: kind of chip that has this address.
        address: of the part.
        registers: the part's registers; None if they are implausible.
        problem: fault of the part; empty if it is sound.
    """

    mux: int
    channel: int
    chip: str
    address: int
    registers: Registers | None
    problem: str = ""


Place = tuple[int, int, str, int]
"""Mux, channel, kind of chip and address of a tile."""


def find_tiles_on_all_channels(
    bus: I2cBus, settings: Mapping[Place, Registers]
) -> tuple[FoundTile, ...]:
    """Search all muxes, channels and chip addresses for tiles, one at a time.

    Args:
        bus: the bus.
        settings: settings of the tiles that are expected; others have their chip's usual ones.

    Raises:
        BusFaultError: the bus itself fails, or acknowledges everything and returns only zeros.
    """
    muxes = _close_muxes(bus)
    router = MuxRouter(bus, muxes)
    if muxes and not router.check_any_mux_works():
        raise BusFaultError(
            f"{len(muxes)} multiplexers acknowledge, but none stores a mask",
            where=bus.name,
            remedy="SDA is stuck low: pull the tiles' plugs one by one, or cycle their supply",
        )
    kinds = [(chip, address) for chip in PRESSURE_CHIPS.values() for address in chip.addresses]
    plugs = []
    for mux, channel, (chip, address) in product(muxes, CHANNELS, kinds):
        place = (mux, channel, chip.name, address)
        try:
            router.connect_single_channel(mux, channel)
            registers = _identify_and_start_up(
                bus,
                chip,
                address,
                settings.get(place) or chip.encode_settings(ChipSettings()),
                f"mux 0x{mux:02x} channel {channel}",
            )
            plugs.append(FoundTile(*place, registers))
        except NoAcknowledgeError:
            continue
        except TileSetupError as error:
            plugs.append(FoundTile(*place, None, str(error)))
    return tuple(plugs)


def _close_muxes(bus: I2cBus) -> list[int]:
    """Close all muxes and return the addresses of those present.

    A tile behind an open mux would answer together with the addressed one.
    """
    return [address for address in ADDRESSES if _close_mux(bus, address)]


def _close_mux(bus: I2cBus, address: int) -> bool:
    try:
        Tca9548a(bus, address).write_mask(0)
    except NoAcknowledgeError:
        return False
    return True


@dataclass(frozen=True)
class WireTiming:
    """Measured bus clock, and overhead of a transaction beyond its bits.

    Where the adapter's own time hides the bits, as on USB, the clock is taken to be the fastest.
    """

    scl_hz: float
    transaction_overhead_s: float
    is_scl_measured: bool = True


def measure_wire_timing(bus: I2cBus, clock: Clock, tile: TileInfo) -> WireTiming:
    """Measure SCL from the time difference of a long and a short read: nine periods per byte.

    The adapter's nominal rate is unreliable: on a Raspberry Pi it follows the core's clock
    (hardware.md 3.2). The rest of the short read's time is the overhead.

    Raises:
        I2cError: the tile does not answer.
    """
    router = MuxRouter(bus, _close_muxes(bus))
    router.connect_single_channel(tile.mux, tile.channel)
    point = i2c_msg.write(tile.address, [get_chip(tile.chip).readable_register])
    took_ns: dict[int, list[int]] = {n: [] for n in _SCL_BYTES}
    reads = {n: i2c_msg.read(tile.address, n) for n in _SCL_BYTES}
    for _ in range(_SCL_READS):
        for n, read in reads.items():  # in turn, so that a drift of the load touches both
            begin_ns = clock.now_ns()
            bus.transfer(point, read)
            took_ns[n].append(clock.now_ns() - begin_ns)
    parts_ns = [
        _find_undisturbed(took_ns[_SCL_BYTES[1]][part::4])
        - _find_undisturbed(took_ns[_SCL_BYTES[0]][part::4])
        for part in range(4)
    ]
    # On USB the ends of transfers keep to frames of 1 ms, which would look like a slow clock.
    is_on_usb = find_adapter(bus.name) is not None
    is_measured = not is_on_usb and 0 < max(parts_ns) < _SCL_AGREE * min(parts_ns)
    short_ns, long_ns = (_find_undisturbed(took_ns[n]) for n in _SCL_BYTES)
    periods = 9 * (_SCL_BYTES[1] - _SCL_BYTES[0])
    scl_hz = 1e9 * periods / (long_ns - short_ns) if is_measured else _SCL_MAX_HZ
    overhead_s = short_ns * 1e-9 - count_read_bits(_SCL_BYTES[0]) / scl_hz
    return WireTiming(scl_hz, max(0.0, overhead_s), is_measured)


def _find_undisturbed(took_ns: Sequence[int]) -> int:
    """Find a time that hardly anything else on the machine has prolonged."""
    return sorted(took_ns)[round(_UNDISTURBED * len(took_ns))]


def measure_conversion_ns(
    bus: I2cBus, clock: Clock, tile: TileInfo, wires: WireTiming
) -> int | None:
    """Measure the longest conversion time of a part; None if its counts do not show it.

    Bisects the delay from CONVERT to the read. Each trial has two conversions: one read after the
    longest possible time, and one read after the delay under test. If their temperatures differ,
    the second conversion had finished, because the temperature is loaded last: that is proof. Many
    equal readings count as unfinished; an error there makes the time too long, never too short. The
    address of a read takes time on the wires before the data are latched. That time is included:
    callers begin a read only after the result. Through an adapter that hides the bus clock it is
    the data sheet's longest.

    Raises:
        I2cError: the part does not answer.
    """
    router = MuxRouter(bus, _close_muxes(bus))
    router.connect_single_channel(tile.mux, tile.channel)
    chip = get_chip(tile.chip)
    driver = chip.make_driver(bus, tile.address)
    typical_ns, longest_ns = chip.compute_conversion_ns(tile.settings)
    if chip.has_status:
        return _measure_by_status(driver, clock, longest_ns, chip.is_free_running(tile.settings))
    settled_ns = longest_ns + _SPARE_NS

    wires_ns = round(
        1e9
        * (CONVERT_BITS + count_read_bits(*chip.compute_read_bytes(tile.settings)[1]))
        / wires.scl_hz
    )
    wires_ns += round(2e9 * wires.transaction_overhead_s)

    def convert_and_read(delay_ns: int) -> tuple[Counts, int]:
        """Return the counts, and the longest possible delay from CONVERT to their read.

        A busy machine may pause before either transaction, so all time off the wires counts.
        """
        begin_ns = clock.now_ns()
        driver.start_conversion()
        stop_ns = clock.now_ns()
        clock.sleep_until_ns(stop_ns + delay_ns)
        counts = driver.read_counts()
        waited_ns = max(delay_ns, clock.now_ns() - begin_ns - wires_ns)
        clock.sleep_until_ns(stop_ns + settled_ns)
        return counts, waited_ns

    def finished_within(delay_ns: int, known_ns: int) -> int | None:
        """Return a wait after which a conversion had finished; None if none had.

        Waits of `known_ns`, known to be sufficient, or more prove nothing new. With too few shorter
        waits the result is `known_ns`.
        """
        in_time = 0
        pressure_changed = False
        for _ in range(_TEMPERATURE_SAME_MAX):
            settled, _ = convert_and_read(settled_ns)
            counts, waited_ns = convert_and_read(delay_ns)
            if waited_ns >= known_ns and counts != settled:
                continue
            if counts[1] != settled[1]:
                return waited_ns
            in_time += 1
            pressure_changed |= counts[0] != settled[0]
            if in_time >= _SAME_MAX and not pressure_changed:
                return None
        return None if in_time >= _SAME_MAX else known_ns

    if not wires.is_scl_measured:  # nor can waits be timed through such an adapter
        return longest_ns if finished_within(longest_ns, _NEVER_NS) is not None else None
    delay_ns = _bisect_conversion_ns(typical_ns, longest_ns, finished_within)
    if delay_ns is None:
        return None
    waits_ns = round((delay_ns + ADDRESS_BITS * 1e9 / wires.scl_hz) * MARGIN)
    return min(longest_ns, waits_ns)


def _measure_by_status(
    driver: ChipDriver, clock: Clock, longest_ns: int, is_free_running: bool
) -> int | None:
    """Measure a conversion of a part with a status: the period of free ones, else the longest."""
    ended_ns: list[int] = []
    took_ns: list[int] = []
    conversions = _STATUS_CONVERSIONS
    if is_free_running:
        conversions = min(
            conversions, max(_FREE_CONVERSIONS_MIN, _FREE_CONVERSIONS_NS // longest_ns)
        )
    for _ in range(conversions):
        begin_ns = clock.now_ns()
        if not is_free_running:
            driver.start_conversion()
        while not driver.has_new_counts():
            if clock.now_ns() - begin_ns > 2 * longest_ns:
                return None
        ended_ns.append(clock.now_ns())
        took_ns.append(ended_ns[-1] - begin_ns)
    if is_free_running:
        # A busy machine may miss the end of one: their number follows from the time between two.
        apart_ns = [later - earlier for earlier, later in pairwise(ended_ns[1:])]
        numbers = [0, *accumulate(round(each / median(apart_ns)) for each in apart_ns)]
        return min(longest_ns, round(linear_regression(numbers, ended_ns[1:]).slope))
    return min(longest_ns, round(max(took_ns) * MARGIN))


def _bisect_conversion_ns(
    typical_ns: int, longest_ns: int, finished_within: Callable[[int, int], int | None]
) -> int | None:
    if finished_within(longest_ns, _NEVER_NS) is None:
        return None
    unfinished_ns = typical_ns // _SHORTEST_DIVISOR
    finished_ns = longest_ns
    while finished_ns - unfinished_ns > typical_ns // _RESOLUTION_DIVISOR:
        middle_ns = (unfinished_ns + finished_ns) // 2
        waited_ns = finished_within(middle_ns, finished_ns)
        if waited_ns is None:
            unfinished_ns = middle_ns
        elif waited_ns < finished_ns:
            finished_ns = waited_ns  # a sleep ends late: use the real wait
        else:
            break  # limit of this machine's sleep resolution
    return finished_ns
