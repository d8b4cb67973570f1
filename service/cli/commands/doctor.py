"""`foottile doctor`: tiles, timing and frame rate of a bus."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from devices.buses.i2c import I2cBus, open_bus
from devices.buses.usb_adapters import UsbAdapter, find_adapter
from devices.clock import Clock, SystemClock, VirtualClock
from devices.errors import UsageError, require_extra
from devices.scene.hardware_sections import EMULATED, ServoSection
from devices.scene.scene_file import Scene, load_scene
from devices.vitals import Vitals, VitalsWarnings, read_vitals
from service.cli.options import (
    EXIT_INCOMPLETE,
    BusOption,
    JsonOption,
    ServoOption,
    echo,
    print_json,
    show_progress,
    stdout,
)

if TYPE_CHECKING:
    from service.offline.doctor import BusDiagnosis, ServoDiagnosis

_EMULATED_SCENE = "standing"


@require_extra("emulation", "an emulated bus or servo")
def doctor_command(
    scene: Annotated[
        str | None,
        typer.Option(help="Scene with the expected tiles; default: accept any."),
    ] = None,
    bus: BusOption = None,
    rate_hz: Annotated[
        float, typer.Option(min=0.0, help="Required frame rate; 0: the scene's, or the highest.")
    ] = 0.0,
    servo: ServoOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the tiles of a bus, measure it, and predict its frame rate.

    It scans every multiplexer, reads each tile's registers three times, measures the bus clock
    and every part's conversion time, and predicts the frame rate of every schedule. It searches a
    servo with both protocols at the usual baud rates. An emulated bus is examined in virtual time.
    Exit codes: 0 ready, 1 no working bus, 2 wrong usage, 3 something has to be changed.
    """
    from service.offline.doctor import diagnose_bus, diagnose_servo

    the_scene = load_scene(scene) if scene is not None else None
    name = bus or (the_scene.array.bus if the_scene is not None else None)
    if name is None:
        raise UsageError(
            "no bus is named", remedy="Add --bus /dev/i2c-1, --bus emulated, or --scene"
        )
    if name == EMULATED and the_scene is None:
        the_scene = load_scene(_EMULATED_SCENE)
    with ExitStack() as stack, show_progress(f"examining {name}"):
        opened, clock = _open_bus(name, the_scene)
        stack.callback(opened.close)
        adapter = find_adapter(name)
        diagnosis = diagnose_bus(opened, clock, the_scene, requested_hz=rate_hz)
    wanted = the_scene.servo if the_scene is not None else None
    port = servo or (wanted.port if wanted is not None else "none")
    found = None
    if port != "none":
        with ExitStack() as stack, show_progress(f"asking for a servo at {port}"):
            opened_port = port
            if port == EMULATED:
                opened_port = stack.enter_context(_open_servo(the_scene, wanted))
            found = diagnose_servo(opened_port, SystemClock(), wanted)
    vitals = read_vitals(None) if name != EMULATED else Vitals()
    if as_json:
        content = _make_json(name, adapter, diagnosis, port, found)
        print_json(content | {"vitals": vitals.model_dump()})
    else:
        _print_diagnosis(name, adapter, diagnosis, the_scene)
        if found is not None:
            echo(f"Servo at {port}: {found.verdict}")
        for warning in VitalsWarnings().update(vitals):
            echo(f"Machine: {warning}")
    if not diagnosis.rates_hz:
        raise typer.Exit(1)
    if not diagnosis.is_rate_reached or (found is not None and not found.is_well):
        raise typer.Exit(EXIT_INCOMPLETE)


@contextmanager
def _open_servo(scene: Scene | None, wanted: ServoSection | None) -> Iterator[str]:
    if scene is None or wanted is None:
        raise UsageError(
            "the scene of the emulated servo has no servo", remedy="Add --scene rolling"
        )
    from devices.emulation.world import World

    clock = SystemClock()
    with World(scene, clock).open_servo(wanted, clock) as emulated:
        yield emulated.port


def _open_bus(name: str, scene: Scene | None) -> tuple[I2cBus, Clock]:
    if name != EMULATED or scene is None:
        return open_bus(name), SystemClock()
    from devices.emulation.world import World

    clock = VirtualClock()
    if scene.ground.kind == "trace":  # examined unloaded, so the load does not matter
        scene = scene.model_copy(update={"ground": load_scene(_EMULATED_SCENE).ground})
    world = World(scene, clock, begins_now=False)
    return open_bus(name, world.i2c_adapter), clock


def _make_json(
    name: str,
    adapter: UsbAdapter | None,
    diagnosis: BusDiagnosis,
    port: str,
    servo: ServoDiagnosis | None,
) -> dict[str, object]:
    return {
        "bus": name,
        "adapter": None if adapter is None else asdict(adapter),
        "tiles": [asdict(tile) for tile in diagnosis.tiles],
        "scl_hz": diagnosis.scl_hz,
        "asked_scl_hz": diagnosis.configured_scl_hz,
        "transaction_us": diagnosis.transaction_overhead_s * 1e6,
        "rates_hz": dict(diagnosis.rates_hz),
        "schedule": diagnosis.fastest_schedule,
        "holds": diagnosis.is_rate_reached,
        "verdict": diagnosis.verdict,
        "servo": None if servo is None else {**asdict(servo), "port": port},
    }


def _print_diagnosis(
    name: str, adapter: UsbAdapter | None, diagnosis: BusDiagnosis, scene: Scene | None
) -> None:
    where = f"{name}, scene {scene.name}" if scene is not None else name
    if name == EMULATED:
        where += ", in virtual time"
    echo(f"Bus {where}")
    if adapter is not None:
        echo(f"Adapter {adapter} at {adapter.bus}; its name in a scene stays when it is replugged")
    tiles = Table("tile", "mux", "channel", "chip", "registers", "conversion", "problem")
    for tile in diagnosis.tiles:
        words = tile.registers
        tiles.add_row(
            tile.serial or "not in the scene" if scene is not None else "-",
            f"0x{tile.mux:02x}",
            str(tile.channel),
            tile.chip,
            " ".join(f"{word:04x}" for word in words) if words is not None else "-",
            f"{tile.conversion_ms:.3f} ms" if tile.conversion_ms is not None else "-",
            tile.problem or "none",
        )
    stdout.print(tiles)
    if diagnosis.rates_hz:
        scl = "SCL hidden by the adapter's own time"
        if diagnosis.scl_hz is not None:
            scl = f"SCL {diagnosis.scl_hz / 1e3:.1f} kHz measured"
        echo(
            f"{scl}, {diagnosis.configured_scl_hz / 1e3:.0f} asked for; "
            f"{diagnosis.transaction_overhead_s * 1e6:.0f} us per transaction beyond its bits"
        )
        rates = Table("schedule", "frames/s predicted", "")
        for schedule, rate in diagnosis.rates_hz.items():
            rates.add_row(
                schedule,
                f"{rate:.1f}" if rate is not None else "too many channels at once",
                "best" if schedule == diagnosis.fastest_schedule else "",
            )
        stdout.print(rates)
    echo(diagnosis.verdict)
