"""What is wired beside an array: its reference force sensor, and lines that free its bus."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING

from devices.buses.spi import open_spi
from devices.chips.mcp3208 import Mcp3208
from devices.clock import Clock
from devices.errors import UsageError
from devices.recovery.recovery import BusRecovery, GpioRecovery, open_recovery
from devices.reference import ReferenceForce
from devices.scene.file import Scene
from devices.scene.hardware import EMULATED

if TYPE_CHECKING:
    from devices.emulation.world import World


def open_reference_sensor(
    scene: Scene, clock: Clock, world: World | None, stack: ExitStack
) -> Callable[[], float] | None:
    """A function that reads the scene's reference force in newtons; None if it has no sensor.

    Raises:
        UsageError: an emulated sensor for a ground that has none.
        SpiError: the converter's port cannot be opened.
    """
    reference = scene.reference
    if reference is None:
        return None
    emulated = None
    if reference.port == EMULATED:
        mill = world.mill if world is not None else None
        if mill is None:
            raise UsageError(
                f"scene {scene.name!r} has an emulated reference sensor and no emulated mill",
                remedy='Set ground.kind = "indentation", or reference.port to a device',
            )
        emulated = mill.adc(reference, clock)
    device = open_spi(reference.port, emulated)
    stack.callback(device.close)
    return ReferenceForce(Mcp3208(device, where=reference.port), reference).read_n


def open_recovery_lines(scene: Scene, clock: Clock, world: World | None) -> BusRecovery | None:
    """Lines that can free the scene's bus; None if none are wired.

    Raises:
        BusSetupError: the lines cannot be had.
    """
    if scene.recovery is None or world is None or scene.array.bus != EMULATED:
        return open_recovery(scene.recovery, clock)
    from devices.emulation.buses.gpio import EmulatedLines

    return GpioRecovery(EmulatedLines(world.i2c_adapter, clock), clock)
