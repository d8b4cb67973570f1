"""Diagnosis of a bus: its parts, the frame rate it allows, and advice in words.

All values are measured over the bus; a scene only gives the expected parts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress

from devices.array.schedules import (
    BusTiming,
    choose_schedule,
    compute_frame_s,
    compute_rates_hz,
    count_broadcast_channels,
)
from devices.array.self_test import (
    FoundTile,
    Place,
    WireTiming,
    find_tiles_on_all_channels,
    make_tile_info,
    measure_conversion_ns,
    measure_wire_timing,
)
from devices.array.startup import choose_scene_schedule, compute_bus_timing
from devices.buses.device_files import find_programs_using
from devices.buses.i2c import I2cBus, RetryingBus
from devices.buses.serial_line import check_latency_timer, find_stable_path, read_latency_timer_ms
from devices.chips.dynamixel.servo_setup import BAUDRATES, FoundServo, find_servos
from devices.chips.pressure_chips import get_chip
from devices.chips.tca9548a import SCL_MAX_HZ
from devices.clock import Clock
from devices.errors import I2cError, ServoSetupError
from devices.frames import TileInfo
from devices.scene.hardware_sections import ArraySection, ScheduleName, ServoSection, TileSection
from devices.scene.scene_file import Scene

_MIN_CLOCK_SHARE = 0.95
_PI_CLOCK_RATIO = 0.625  # core clock 250 MHz where the kernel believes in 400 MHz (hardware.md 3.2)
_PI_CLOCK_TOLERANCE = 0.03
_RATE_MARGIN = 0.98
_MIN_NOTABLE_GAIN = 1.05


@dataclass(frozen=True)
class TileFinding(FoundTile):
    """Finding for one tile position, also where nothing answers.

    Attributes:
        serial: serial in the scene; empty if the scene has no such tile.
        conversion_ms: measured conversion time; None if unmeasurable.
    """

    serial: str = ""
    conversion_ms: float | None = None


@dataclass(frozen=True)
class BusDiagnosis:
    """Result of a bus diagnosis.

    Attributes:
        tiles: findings for all tiles of the scene and all others found.
        scl_hz: measured bus clock; None without a working tile, or where the adapter's own time
            hides it.
        configured_scl_hz: configured bus clock.
        transaction_overhead_s: overhead of a transaction beyond its bits.
        rates_hz: frames per second by schedule; None if it would open too many channels.
        fastest_schedule: fastest schedule; None without tiles.
        is_rate_reached: True if all tiles work and the requested rate is reached.
        verdict: summary in a few sentences, with advice.
    """

    tiles: tuple[TileFinding, ...]
    scl_hz: float | None
    configured_scl_hz: float
    transaction_overhead_s: float
    rates_hz: Mapping[ScheduleName, float | None]
    fastest_schedule: ScheduleName | None
    is_rate_reached: bool
    verdict: str


def diagnose_bus(
    bus: I2cBus, clock: Clock, scene: Scene | None, *, requested_hz: float = 0.0
) -> BusDiagnosis:
    """Diagnose a bus.

    Args:
        bus: the bus.
        clock: virtual or real clock.
        scene: expected parts; None: accept any.
        requested_hz: requested frames per second; 0: the highest possible.

    Raises:
        BusFaultError: the bus itself does not work.
        BusSetupError: the bus cannot be used.
    """
    array = scene.array if scene is not None else ArraySection()
    bus = RetryingBus(bus)
    expected: dict[Place, TileSection] = {
        (tile.mux, tile.channel, tile.chip, tile.chip_address): tile
        for tile in (scene.tile if scene is not None else ())
    }
    settings = {place: tile.chip_settings for place, tile in expected.items()}
    findings = _match_tiles(find_tiles_on_all_channels(bus, settings), expected)
    sound = [finding for finding in findings if not finding.problem]
    sections = [expected.get(_place(finding)) or _make_section(finding) for finding in sound]
    tiles = [
        make_tile_info(section, finding.registers or ())
        for section, finding in zip(sections, sound, strict=True)
    ]
    if not tiles:
        return BusDiagnosis(
            findings,
            None,
            array.scl_hz,
            0.0,
            {},
            None,
            is_rate_reached=False,
            verdict=_describe_no_tiles(findings),
        )
    wires = measure_wire_timing(bus, clock, tiles[0])
    conversions_ns, measured = _measure_conversions(bus, clock, sound, tiles, wires)
    by_place = {_place(finding): finding for finding in measured}
    findings = tuple(by_place.get(_place(f), f) for f in findings)
    timing = compute_bus_timing(array, wires, tiles, conversions_ns)
    rates: dict[ScheduleName, float | None] = {
        name: rate
        if count_broadcast_channels(name, timing.muxes) <= array.broadcast_channels
        else None
        for name, rate in compute_rates_hz(timing).items()
    }
    requested_hz = requested_hz or (scene.rate_hz if scene is not None else 0.0)
    choice = choose_schedule(
        timing, requested_rate_hz=requested_hz, channels_max=array.broadcast_channels
    )
    schedule = choice.schedule
    if scene is not None:
        has_reference = scene.reference is not None
        schedule = choose_scene_schedule(
            scene, timing, has_reference=has_reference, requested_rate_hz=requested_hz
        ).schedule
    advice = _make_advice(findings, timing, rates, array, requested_hz, choice.schedule, schedule)
    hints = (
        *advice.hints,
        _describe_slowest_tile(measured, timing, schedule, rates[schedule]),
        _advise_oversampling(
            tiles,
            sections,
            conversions_ns,
            lambda changed, times_ns: (
                1.0 / compute_frame_s(schedule, compute_bus_timing(array, wires, changed, times_ns))
            ),
            requested_hz,
        ),
        _describe_disturbance(bus.retried_transfers),
    )
    return BusDiagnosis(
        findings,
        wires.scl_hz if wires.is_scl_measured else None,
        array.scl_hz,
        wires.transaction_overhead_s,
        rates,
        choice.schedule,
        is_rate_reached=not advice.wrong,
        verdict=" ".join(filter(None, (advice.summary, *advice.wrong, *hints))),
    )


def _measure_conversions(
    bus: I2cBus,
    clock: Clock,
    findings: Sequence[TileFinding],
    tiles: Sequence[TileInfo],
    wires: WireTiming,
) -> tuple[list[int | None], tuple[TileFinding, ...]]:
    """Measure each tile's conversion time; return the times, and the findings with them."""
    conversions_ns: list[int | None] = []
    measured: list[TileFinding] = []
    for finding, info in zip(findings, tiles, strict=True):
        try:
            conversion_ns = measure_conversion_ns(bus, clock, info, wires)
            never = "its readings never change: it may not be converting"
            problem = "" if conversion_ns is not None else never
        except I2cError as error:
            conversion_ns, problem = None, f"it stopped responding during the measurement: {error}"
        conversions_ns.append(conversion_ns)
        conversion_ms = None if conversion_ns is None else conversion_ns / 1e6
        measured.append(replace(finding, conversion_ms=conversion_ms, problem=problem))
    return conversions_ns, tuple(measured)


def _place(tile: FoundTile) -> Place:
    return tile.mux, tile.channel, tile.chip, tile.address


def _match_tiles(
    plugs: tuple[FoundTile, ...], expected: Mapping[Place, TileSection]
) -> tuple[TileFinding, ...]:
    places = {place: tile.serial for place, tile in expected.items()}
    there = {_place(plug): plug for plug in plugs}
    found = [
        TileFinding(**vars(plug), serial=places.get(place, "")) for place, plug in there.items()
    ]
    absent = [
        TileFinding(*place, None, "it does not answer", serial)
        for place, serial in places.items()
        if place not in there
    ]
    return tuple(sorted((*found, *absent), key=_place))


def _make_section(finding: TileFinding) -> TileSection:
    """Make the section of a tile that no scene has."""
    mux, channel, chip, address = _place(finding)
    place = {"mux": mux, "channel": channel, "chip": chip, "address": address}
    at = dict.fromkeys(("x_m", "y_m", "z_m"), 0.0)
    return TileSection.model_validate({"serial": f"0x{mux:02x}.{channel}", **place, **at})


def _describe_no_tiles(findings: tuple[TileFinding, ...]) -> str:
    if any(finding.registers or "answer" not in finding.problem for finding in findings):
        return "No tile works: look at the problems above."
    return (
        "Nothing answers at 0x70 to 0x77. Check the multiplexers' supply, that SDA and SCL are not "
        "swapped, and that this is the right bus."
    )


@dataclass(frozen=True)
class _Advice:
    summary: str
    wrong: tuple[str, ...]
    hints: tuple[str, ...]


def _make_advice(
    findings: tuple[TileFinding, ...],
    timing: BusTiming,
    rates: Mapping[ScheduleName, float | None],
    array: ArraySection,
    requested_hz: float,
    best: ScheduleName,
    chosen: ScheduleName,
) -> _Advice:
    wrong: list[str] = []
    hints: list[str] = []
    ill = [f for f in findings if f.problem]
    if ill:
        names = ", ".join(f.serial or f"0x{f.mux:02x} channel {f.channel}" for f in ill)
        wrong.append(f"{names} {'needs' if len(ill) == 1 else 'need'} attention first.")
    if array.scl_hz > SCL_MAX_HZ:
        hints.append(f"The multiplexers are rated for {SCL_MAX_HZ / 1e3:.0f} kHz only.")
    part = timing.scl_hz / array.scl_hz  # of a hidden clock it is more than one
    if part < _MIN_CLOCK_SHARE:
        slow = f"The bus runs at {timing.scl_hz / 1e3:.0f} kHz where {array.scl_hz / 1e3:.0f} are"
        if abs(part - _PI_CLOCK_RATIO) < _PI_CLOCK_TOLERANCE:
            slow += (
                " requested: this Raspberry Pi derives it from a core that idles at 250 MHz. Fix "
                "the core's clock in config.txt (core_freq and core_freq_min alike, or "
                "enable_uart=1)."
            )
        else:
            slow += " requested: check dtparam=i2c_arm_baudrate in config.txt."
        hints.append(slow)
    rate = rates[chosen]
    best_hz = rates[best] or 0.0
    tiles = f"{len(timing.muxes)} tile{'s' * (len(timing.muxes) > 1)}"
    if rate is None:
        wrong.append(
            f"{chosen} would open more than {array.broadcast_channels} channels at once: "
            f"use {best}."
        )
        mux_count = len(timing.tile_counts_by_mux)
        summary = f"{tiles} on {mux_count} mux{'es' * (mux_count > 1)}."
        return _Advice(summary, tuple(wrong), tuple(hints))
    summary = f"{tiles}: {chosen} gives {rate:.0f} frames/s."
    if requested_hz and rate < requested_hz:
        change = f"ask for {_RATE_MARGIN * best_hz:.0f} or less"
        if best_hz >= requested_hz:
            change = f"use schedule {best}"
        wrong.append(f"The {requested_hz:g} frames/s requested will not hold: {change}.")
    elif requested_hz:
        summary += f" The {requested_hz:g} frames/s requested will hold."
    elif chosen != best:
        hints.append(f"Schedule {best} would give {best_hz:.0f}.")
    return _Advice(summary, tuple(wrong), tuple(hints))


def _describe_slowest_tile(
    requested: tuple[TileFinding, ...],
    timing: BusTiming,
    schedule: ScheduleName,
    rate_hz: float | None,
) -> str:
    """Describe the tile that limits the rate, if one does; `requested`: tiles of `timing`."""
    slowest_s = max(timing.conversions_s)
    slow = requested[timing.conversions_s.index(slowest_s)]
    if rate_hz is None or slow.conversion_ms is None:
        return ""
    usual_s = sorted(timing.conversions_s)[len(timing.conversions_s) // 2]
    like_others = replace(
        timing, conversions_s=tuple(min(wait_s, usual_s) for wait_s in timing.conversions_s)
    )
    without_hz = 1.0 / compute_frame_s(schedule, like_others)
    if without_hz < _MIN_NOTABLE_GAIN * rate_hz:
        return ""
    name = slow.serial or f"The tile at 0x{slow.mux:02x} channel {slow.channel}"
    return (
        f"{name} converts slowest ({slowest_s * 1e3:.2f} ms) and sets the pace: with a part like "
        f"the others it would be {without_hz:.0f}."
    )


_NEARLY = 0.85
"""Part of the best rate for which less noise is worth the rest."""


def _advise_oversampling(
    tiles: Sequence[TileInfo],
    sections: Sequence[TileSection],
    conversions_ns: Sequence[int | None],
    predict_hz: Callable[[Sequence[TileInfo], Sequence[int | None]], float],
    requested_hz: float,
) -> str:
    """Advise the oversampling with which free-running tiles convert in about a frame.

    Longer conversions would set the pace, and of shorter ones several have to be read.
    """
    free = [get_chip(tile.chip).is_free_running(tile.settings) for tile in tiles]
    rates_hz: dict[int, float] = {}
    for number in get_chip(tiles[free.index(True)].chip).oversamplings if any(free) else ():
        changed = [
            make_tile_info(section.model_copy(update={"oversampling": number}), tile.registers)
            if is_free
            else tile
            for tile, section, is_free in zip(tiles, sections, free, strict=True)
        ]
        times_ns = [
            known and round(known * new.conversion_ms / tile.conversion_ms)
            for known, new, tile in zip(conversions_ns, changed, tiles, strict=True)
        ]
        rates_hz[number] = predict_hz(changed, times_ns)
    if not rates_hz:
        return ""
    best_hz = max(rates_hz.values())
    least_hz = requested_hz if 0 < requested_hz <= best_hz else _NEARLY * best_hz
    advised = max(number for number, rate_hz in rates_hz.items() if rate_hz >= least_hz)
    if all(section.oversampling == advised for section in compress(sections, free)):
        return ""
    return (
        f"Set oversampling = {advised}: {rates_hz[advised]:.0f} frames/s, with the least noise at "
        "this rate."
    )


def _describe_disturbance(repeated: int) -> str:
    """Describe disturbed wiring from the number of transfers acknowledged only on retry."""
    if not repeated:
        return ""
    transfers = "1 transfer was" if repeated == 1 else f"{repeated} transfers were"
    return (
        f"{transfers} acknowledged only when repeated: look for a loose plug, and keep the leads "
        "short and away from motors."
    )


TIMEOUTS_S = (0.05, 0.25)
"""Response timeouts; the second one is used if no servo answered, because a busy machine may read
late, and a working servo must not be reported as missing."""


@dataclass(frozen=True)
class ServoDiagnosis:
    """Result of a serial line's diagnosis.

    Attributes:
        found: every servo that answered.
        latency_timer_ms: latency timer of the adapter; None if it has none.
        is_well: True if the expected servo is present with the scene's settings, and the adapter
            is fast.
        verdict: summary in a few sentences, with advice.
    """

    found: tuple[FoundServo, ...]
    latency_timer_ms: int | None
    is_well: bool
    verdict: str


def diagnose_servo(port: str, clock: Clock, expected: ServoSection | None) -> ServoDiagnosis:
    """Search for a servo in both protocols at the usual baud rates.

    Args:
        port: serial port.
        clock: a real clock.
        expected: the scene's servo; None: any with id 1.
    """
    servo_id = expected.id if expected is not None else 1
    rates = dict.fromkeys((*((expected.baudrate,) if expected is not None else ()), *BAUDRATES))
    found: tuple[FoundServo, ...] = ()
    try:
        for timeout_s in TIMEOUTS_S:
            found = found or tuple(
                find_servos(port, clock, servo_ids=[servo_id], baudrates=rates, timeout_s=timeout_s)
            )
    except ServoSetupError as error:
        holders = ", ".join(find_programs_using(port))
        held = f" It is open in {holders}." if holders else ""
        return ServoDiagnosis((), None, is_well=False, verdict=f"{error}.{held}")
    found_texts = [
        f"{servo.model or f'model {servo.model_number}'}, protocol {servo.protocol}, "
        f"{servo.baudrate} baud, id {servo.servo_id}."
        for servo in found
    ]
    wrong = []
    if not found:
        wrong.append(
            f"No servo answers as id {servo_id}. Check power, cable and id; an MX leaves the "
            "factory with id 1 at 57600 baud."
        )
    elif expected is not None and not any(_is_expected(servo, expected) for servo in found):
        wrong.append(
            f"The scene says {expected.model}, protocol {expected.protocol}, "
            f"{expected.baudrate} baud: change the scene's [servo], or the servo."
        )
    if remark := check_latency_timer(port):
        wrong.append(remark)
    if (lasting := find_stable_path(port)) != port:
        found_texts.append(
            f"Name it {lasting} in the scene: {port} may be another adapter's next time."
        )
    return ServoDiagnosis(
        found, read_latency_timer_ms(port), not wrong, " ".join((*found_texts, *wrong))
    )


def _is_expected(servo: FoundServo, wanted: ServoSection) -> bool:
    return (servo.model, servo.protocol, servo.baudrate) == (
        wanted.model,
        wanted.protocol,
        wanted.baudrate,
    )
