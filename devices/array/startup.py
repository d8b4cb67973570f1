"""Start-up of an array: identify and measure the tiles of a scene, choose the schedule."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from devices.array.bus_recovery import BusRecovery, RecoveryResult, recover_bus
from devices.array.schedules import (
    BROADCASTS,
    BusTiming,
    ScheduleChoice,
    choose_schedule,
    compute_frame_s,
    count_read_bits,
)
from devices.array.self_test import (
    MARGIN,
    WireTiming,
    identify_tiles,
    measure_conversion_ns,
    measure_wire_timing,
)
from devices.array.tile_array import TileArray
from devices.buses.i2c import I2cBus, RetryingBus
from devices.chips.pressure_chips import get_chip
from devices.chips.tca9548a import MuxRouter
from devices.clock import Clock
from devices.errors import BusFaultError, SceneError
from devices.frames import TileInfo
from devices.scene.hardware_sections import AnySchedule, ArraySection
from devices.scene.scene_file import Scene


@dataclass(frozen=True)
class MeasuredTiles:
    """Tiles of a scene as identified and measured on its bus.

    Attributes:
        tiles: identified tiles, with measured conversion times.
        timing: timing of the bus and the parts.
        unmeasured_serials: serials whose conversion time could not be measured; the longest is
            assumed.
    """

    tiles: tuple[TileInfo, ...]
    timing: BusTiming
    unmeasured_serials: tuple[str, ...]


@dataclass(frozen=True)
class ReadyArray(MeasuredTiles):
    """Array that is identified, measured and ready to scan frames.

    Attributes:
        array: the array.
        choice: its schedule, and the reason for it.
    """

    array: TileArray
    choice: ScheduleChoice

    @property
    def predicted_rate_hz(self) -> float:
        """Predicted frame rate."""
        return 1.0 / compute_frame_s(self.choice.schedule, self.timing)


def prepare_array(
    bus: I2cBus,
    scene: Scene,
    clock: Clock,
    *,
    schedule: AnySchedule | None = None,
    recovery: BusRecovery | None = None,
    read_reference_n: Callable[[], float] | None = None,
) -> ReadyArray:
    """Free the bus, identify and measure the tiles of a scene, and choose the schedule.

    Args:
        bus: bus of the tiles.
        scene: expected tiles.
        clock: virtual or real clock.
        schedule: schedule, instead of the scene's.
        recovery: frees a stuck bus.
        read_reference_n: as for `TileArray`.

    Raises:
        TileSetupError, I2cError: a tile or the bus does not work.
        SceneError: the schedule does not suit the tiles.
    """
    ensure_bus_works(bus, scene, recovery)
    found = identify_and_measure(bus, scene, clock)
    choice = choose_scene_schedule(
        scene, found.timing, schedule, has_reference=read_reference_n is not None
    )
    return _build_array(bus, scene, clock, found, choice, recovery, read_reference_n)


def ensure_bus_works(bus: I2cBus, scene: Scene, recovery: BusRecovery | None) -> None:
    """Check that the bus works, and free it if need be: a slave may hang in a byte.

    Raises:
        BusFaultError: SDA or SCL is stuck low, and could not be freed.
    """
    router = MuxRouter(bus, [tile.mux for tile in scene.tile])
    fault: BusFaultError | None = None

    def moves() -> bool:
        nonlocal fault
        try:
            # Without any mux the bus works: identification will name the missing tile.
            if router.check_any_mux_works() or router.refused_address is not None:
                return True
            fault = BusFaultError(
                "the multiplexers acknowledge, but none stores a mask",
                where=bus.name,
                remedy="SDA is stuck low: pull the tiles' plugs one by one, cycle their supply, or "
                "wire [recovery]",
            )
        except BusFaultError as error:
            fault = error
        return False

    given = RecoveryResult(succeeded=moves())
    if not given.succeeded and recovery is not None:
        given = recover_bus(recovery, moves)
    if not given.succeeded and fault is not None:
        if given.problem:
            fault.remedy += f". It could not be freed: {given.problem}"
        raise fault


def reidentify_replaced_tiles(
    bus: I2cBus,
    scene: Scene,
    clock: Clock,
    ready_array: ReadyArray,
    *,
    recovery: BusRecovery | None = None,
    read_reference_n: Callable[[], float] | None = None,
) -> ReadyArray:
    """Identify and measure replaced parts, and return an array with the new ones.

    The other parts are not measured again, so that the interruption is short.

    Raises:
        TileSetupError, I2cError: a new part is gone again, or is of another kind.
    """
    replaced = ready_array.array.replaced_serials
    new = [tile for tile in scene.tile if tile.serial in replaced]
    found = identify_and_measure(bus, scene.model_copy(update={"tile": tuple(new)}), clock)
    waits_s = dict(zip((tile.serial for tile in new), found.timing.conversions_s, strict=True))
    by_serial = {tile.serial: tile for tile in found.tiles}
    serials = [tile.serial for tile in ready_array.tiles]
    old_s = dict(zip(serials, ready_array.timing.conversions_s, strict=True))
    parts = MeasuredTiles(
        tiles=tuple(by_serial.get(tile.serial, tile) for tile in ready_array.tiles),
        timing=replace(
            ready_array.timing, conversions_s=tuple((old_s | waits_s)[serial] for serial in serials)
        ),
        unmeasured_serials=(
            *(s for s in ready_array.unmeasured_serials if s not in by_serial),
            *found.unmeasured_serials,
        ),
    )
    return _build_array(bus, scene, clock, parts, ready_array.choice, recovery, read_reference_n)


def _build_array(
    bus: I2cBus,
    scene: Scene,
    clock: Clock,
    found: MeasuredTiles,
    choice: ScheduleChoice,
    recovery: BusRecovery | None,
    read_reference_n: Callable[[], float] | None,
) -> ReadyArray:
    array = TileArray(
        bus,
        found.tiles,
        clock,
        schedule=choice.schedule,
        timing=found.timing,
        temperature_every=scene.array.temperature_every,
        broadcast_channels=scene.array.broadcast_channels,
        recovery=recovery,
        read_reference_n=read_reference_n,
    )
    # A pipelined schedule reads conversions started in the previous frame.
    array.scan_frame()
    return ReadyArray(found.tiles, found.timing, found.unmeasured_serials, array, choice)


def choose_scene_schedule(
    scene: Scene,
    timing: BusTiming,
    schedule: AnySchedule | None = None,
    *,
    has_reference: bool,
    requested_rate_hz: float = 0.0,
) -> ScheduleChoice:
    """Choose the schedule for a scene on a bus with this timing.

    Args:
        scene: requested schedule and rate.
        timing: measured timing.
        schedule: schedule, instead of the scene's.
        has_reference: True if a reference force is read with the tiles.
        requested_rate_hz: frame rate, instead of the scene's.

    Raises:
        SceneError: the schedule does not suit a reference sensor, or tiles that run freely.
    """
    requested = schedule or scene.array.schedule
    is_any_commanded, are_all_commanded = any(timing.commanded), all(timing.commanded)
    if requested in BROADCASTS and not are_all_commanded:
        raise SceneError(
            f"tiles that convert by themselves in schedule {requested!r}, which starts all at once",
            where="array.schedule",
            expected='tiles with mode = "forced", or "auto"',
        )
    if has_reference and is_any_commanded and not are_all_commanded:
        raise SceneError(
            "a reference sensor beside tiles that convert by themselves and tiles that do not",
            where="tile",
            expected="tiles of one kind: the reference is read at their sample instant",
        )
    if has_reference and requested == "auto" and not are_all_commanded:
        return ScheduleChoice("sequential", "the reference force is followed between two reads")
    if has_reference and requested in ("auto", "simultaneous"):
        return ScheduleChoice(
            "simultaneous", "the reference force is read while all tiles convert at once"
        )
    if has_reference and requested != "sequential":
        raise SceneError(
            f"schedule {requested!r} beside a reference sensor: its tiles are sampled in turn",
            where="array.schedule",
            expected='"simultaneous" or "sequential": the reference is read with the tiles',
        )
    if requested == "auto":
        return choose_schedule(
            timing,
            requested_rate_hz=requested_rate_hz or scene.rate_hz,
            channels_max=scene.array.broadcast_channels,
        )
    return ScheduleChoice(requested, "as the scene says" if schedule is None else "as requested")


def identify_and_measure(bus: I2cBus, scene: Scene, clock: Clock) -> MeasuredTiles:
    """Identify the tiles of a scene and measure their timing.

    With `array.wait_ms` only parts with a status are measured: the clock of a free-running one must
    be known. A part that cannot be measured is assigned the data sheet's longest time.

    Raises:
        TileSetupError, I2cError: as for `prepare_array`.
    """
    bus = RetryingBus(bus)
    tiles = list(identify_tiles(bus, scene.tile))
    wires = measure_wire_timing(bus, clock, tiles[0])
    unmeasured = []
    conversions_ns: list[int | None] = [None] * len(tiles)
    for index, tile in enumerate(tiles):
        if scene.array.wait_ms is None or get_chip(tile.chip).has_status:
            conversion_ns = measure_conversion_ns(bus, clock, tile, wires)
            conversions_ns[index] = conversion_ns
            if conversion_ns is None:
                unmeasured.append(tile.serial)
            else:
                tiles[index] = tile.model_copy(update={"conversion_ms": conversion_ns / 1e6})
    timing = compute_bus_timing(scene.array, wires, tiles, conversions_ns)
    return MeasuredTiles(tuple(tiles), timing, tuple(unmeasured))


def compute_bus_timing(
    array: ArraySection,
    wires: WireTiming,
    tiles: Sequence[TileInfo],
    conversions_ns: Sequence[int | None],
) -> BusTiming:
    """Compute the bus timing, with the scene's waits, else the measured ones.

    Args:
        array: section of the scene.
        wires: measured timing of the wires.
        tiles: identified tiles.
        conversions_ns: measured conversion time of each tile; None: unknown, so the data sheet's
            longest.
    """
    if array.wait_ms is not None:
        conversions_ns = [round(array.wait_ms * 1e6)] * len(tiles)
    chips = [get_chip(tile.chip) for tile in tiles]
    waits_ns = [
        chip.compute_conversion_ns(tile.settings)[1] if known is None else known
        for tile, chip, known in zip(tiles, chips, conversions_ns, strict=True)
    ]
    free_running = tuple(
        chip.is_free_running(tile.settings) for tile, chip in zip(tiles, chips, strict=True)
    )
    reads = [
        chip.compute_read_bytes(tile.settings) for tile, chip in zip(tiles, chips, strict=True)
    ]
    part = 1 / array.temperature_every
    return BusTiming(
        scl_hz=wires.scl_hz,
        # Reads come a little slower than free conversions, so that each finds a new one.
        conversions_s=tuple(
            wait_ns * 1e-9 * (MARGIN if is_free else 1.0)
            for wait_ns, is_free in zip(waits_ns, free_running, strict=True)
        ),
        muxes=tuple(tile.mux for tile in tiles),
        channels=tuple(tile.channel for tile in tiles),
        addresses=tuple(tile.address for tile in tiles),
        free_running=free_running,
        read_bits=fmean(
            (1 - part) * count_read_bits(*alone) + part * count_read_bits(*whole)
            for alone, whole in reads
        ),
        bits_per_conversion=fmean(
            count_read_bits(chip.bytes_per_conversion) - count_read_bits(0) if is_free else 0.0
            for chip, is_free in zip(chips, free_running, strict=True)
        ),
        reads_per_sample=fmean(
            (1 - part) * len(alone) + part * len(whole) for alone, whole in reads
        ),
        transaction_overhead_s=wires.transaction_overhead_s,
    )
