"""Rig on a real clock: array, servo, reference force sensor and recovery lines, ready to stream.

Each may be real or emulated.
"""

from __future__ import annotations

import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

from devices.acquisition import Acquisition
from devices.array.startup import Ready, make_ready, renew
from devices.buses.i2c import open_bus
from devices.buses.spi import open_spi
from devices.chips.dynamixel.reader import open_servo
from devices.chips.dynamixel.servo import ServoReader
from devices.chips.mcp3208 import Mcp3208
from devices.clock import Clock, SpinningClock, SystemClock, UtcAnchor
from devices.errors import FootTileError, I2cError, TileSetupError, UsageError
from devices.frames import ArrayInfo, FrameBatch, FrameStatus
from devices.realtime import clock_is_set, run_before_others, sharpen_timers
from devices.recovery.recovery import BusRecovery, GpioRecovery, open_recovery
from devices.reference import ReferenceForce
from devices.scene.file import Scene
from devices.scene.hardware import EMULATED, ServoScene
from service.rig.description import describe
from service.rig.lead import Lead
from service.rig.options import RigOptions
from service.rig.pace import Pace, undisturbed_hz
from storage.journal.node.in_flight import InFlight, open_in_flight

if TYPE_CHECKING:
    from devices.emulation.world import World


def open_reference_sensor(
    scene: Scene, world: World | None, stack: ExitStack
) -> ReferenceForce | None:
    """Open the scene's reference force sensor; None if it has none.

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
        if world is None or mill is None:
            raise UsageError(
                f"scene {scene.name!r} has an emulated reference sensor and no emulated mill",
                remedy='Set ground.kind = "indentation", or reference.port to a device',
            )
        emulated = mill.adc(reference, world.clock)
    device = open_spi(reference.port, emulated)
    stack.callback(device.close)
    return ReferenceForce(Mcp3208(device, where=reference.port), reference)


def open_recovery_lines(scene: Scene, clock: Clock, world: World | None) -> BusRecovery | None:
    """Open the recovery of the scene's bus; None if no lines are wired.

    Raises:
        BusSetupError: the lines cannot be requested.
    """
    if scene.recovery is None or world is None or scene.array.bus != EMULATED:
        return open_recovery(scene.recovery, clock)
    from devices.emulation.buses.gpio import EmulatedLines

    return GpioRecovery(EmulatedLines(world.i2c_adapter, clock), clock)


_TRIAL_FRAMES = 100
"""Frames of the rate measurement: a fifth of a second with four tiles."""
_RENEW_AGAIN_NS = 2_000_000_000
"""Interval of attempts to identify a replaced part."""

# Python's switch interval: an emulated servo's thread may hold the lock for about a bit at most.
_SWITCH_S = 0.0002


class Rig:
    """Open array, identified and measured, with its servo and reference sensor.

    Args:
        options: options of the rig.
        stack: closes all opened devices.

    Raises:
        I2cError, TileSetupError, ServoSetupError, LoadTraceError, UsageError: a device cannot be
            opened.
    """

    def __init__(self, options: RigOptions, stack: ExitStack) -> None:
        scene = options.scene
        sharpen_timers()
        self._options = options
        self._clock: Clock = SpinningClock()
        # Other threads, and the emulated wires, must not spin on the loop's core.
        self._line_clock = SystemClock()
        self._lead: Lead | None = None
        world = self._world(options, stack)
        self._bus = open_bus(scene.array.bus, world.i2c_adapter if world is not None else None)
        stack.callback(self._bus.close)
        self._recovery = open_recovery_lines(scene, self._clock, world)
        self._reference = open_reference_sensor(scene, world, stack)
        self._reference_n = None if self._reference is None else self._reference.read_n
        self._ready = make_ready(
            self._bus,
            scene,
            self._clock,
            recovery=self._recovery,
            reference_n=self._reference_n,
        )
        self.remarks = [f"schedule {self._ready.choice.schedule}: {self._ready.choice.reason}"]
        """Start-up messages for the user."""
        self.remarks += [
            f"the conversion time of tile {serial} could not be measured; 3 ms is assumed"
            for serial in self._ready.unmeasured
        ]
        self._servo_source = (
            self._servo(scene.servo, world, stack) if scene.servo is not None else None
        )
        self._renew_at_ns = 0
        self._in_flight: InFlight | None = None
        bus_hz = self._bus_hz(self._ready)
        # Last: on a busy machine the start-up before would use up the lead.
        if world is not None and options.emulated:
            self._lead = Lead(world, options.foot.lead_s)
            stack.callback(self._write_plates, world)
        elif world is not None:
            world.begin()
        self._begin_stream(bus_hz, is_new=False)
        if not options.emulated:
            # Last, and only this thread: an emulated world would starve the rest of the machine.
            run_before_others()

    def _begin_stream(self, bus_hz: float, *, is_new: bool) -> None:
        scene, ready = self._options.scene, self._ready
        anchor = UtcAnchor.now(clock_set=clock_is_set())
        self.info: ArrayInfo = describe(
            scene,
            ready.tiles,
            anchor,
            node=self._options.node,
            boot_id=uuid.uuid4().hex,
            schedule=ready.choice.schedule,
            rate_hz=min(scene.rate_hz or bus_hz, bus_hz),
        )
        if self._in_flight is not None:
            self._in_flight.close()
        streams = self._options.streams
        folder = None if streams is None else streams / self.info.boot_id
        self._in_flight = open_in_flight(folder, self.info)
        if folder is not None and self._in_flight is None:
            self.remarks.append("no room for frames in flight: a crash may cost the last batches")
        self.acquisition = Acquisition(
            ready.array,
            ready.tiles,
            self._clock,
            anchor,
            rate_hz=scene.rate_hz,
            expected_hz=bus_hz,
            servo=self._servo_source,
            is_new=is_new,
            keeper=self._in_flight,
            lead_end_ns=None if self._lead is None else self._lead.end_ns,
        )
        self._pace = Pace(self.info.nominal_rate_hz)

    def batches(self, stop: Callable[[], bool]) -> Iterator[FrameBatch]:
        """Acquire batches of one stream until `stop()` returns True.

        Frames before the begin of an emulated load are flagged as lead. The stream also ends when a
        part was replaced, or when it is faster than its nominal rate: then `info` describes a new
        stream, which the next call acquires.
        """
        while not stop():
            for batch in self.acquisition.run(lambda: stop() or self._is_renewal_due()):
                if self._lead is not None:
                    self._lead.see(batch)
                    self.acquisition.lead_end_ns = self._lead.end_ns
                if not batch.frame_status[-1] & FrameStatus.LEAD:  # a lead is of one stream
                    self._pace.see(batch)
                yield batch
                if self._pace.found_hz is not None:
                    self._begin_stream(self._pace.found_hz, is_new=False)
                    return
            if not stop() and self._renew():
                return

    def troubles(self) -> dict[str, str]:
        """Return the present warnings, by tile's serial or device."""
        found = self._ready.array.troubles()
        if self._reference is not None and self._reference.trouble:
            found["reference"] = self._reference.trouble
        if self._servo_source is not None and self._servo_source.trouble:
            found["servo"] = f"servo: {self._servo_source.trouble}"
        return found

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the fault counts of the stream, by serial and reason."""
        array = self._ready.array
        return {
            tile.serial: dict(health.counts)
            for tile, health in zip(array.tiles, array.health, strict=True)
            if health.counts
        }

    def _is_renewal_due(self) -> bool:
        return bool(self._ready.array.replaced) and self._clock.now_ns() >= self._renew_at_ns

    def _renew(self) -> bool:
        try:
            self._ready = renew(
                self._bus,
                self._options.scene,
                self._clock,
                self._ready,
                recovery=self._recovery,
                reference_n=self._reference_n,
            )
        except (I2cError, TileSetupError):  # perhaps half plugged in: go on with the others
            self._renew_at_ns = self._clock.now_ns() + _RENEW_AGAIN_NS
            self._ready.array.resume()
            return False
        self._begin_stream(self._bus_hz(self._ready), is_new=True)
        return True

    def _world(self, options: RigOptions, stack: ExitStack) -> World | None:
        scene = options.scene
        if not options.emulated and (scene.servo is None or scene.servo.port != EMULATED):
            return None
        sys.setswitchinterval(_SWITCH_S)
        pressed = options.foot.pressed_on(scene)
        clock: Clock = self._line_clock
        if options.emulated:
            from devices.emulation.hosted_clock import HostedClock, WireClock

            self._clock = driver = HostedClock(self._clock)
            clock = WireClock(driver, self._line_clock)
        return options.foot.world(scene, clock, pressed, looped=True, in_real_time=True)

    def _write_plates(self, world: World) -> None:
        """Write the plates' files on closing; print errors, as no caller can handle them."""
        try:
            self._options.foot.write_plates(world, self._clock.now_ns())
        except FootTileError as error:
            sys.stderr.write(f"foottile: {error}\n")

    def _servo(self, scene: ServoScene, world: World | None, stack: ExitStack) -> ServoReader:
        port: str | Callable[[], str] = scene.port
        if port == EMULATED and world is not None:
            emulated = stack.enter_context(world.servo(scene, self._line_clock))
            port = lambda: emulated.port  # noqa: E731
        servo = open_servo(
            port,
            baudrate=scene.baudrate,
            clock=self._line_clock,
            servo_id=scene.id,
            model=scene.model,
            protocol=scene.protocol,
            waits=True,
        )
        stack.callback(servo.close)
        self.remarks += servo.remarks
        return stack.enter_context(ServoReader(servo, self._line_clock, rate_hz=scene.rate_hz))

    def _bus_hz(self, ready: Ready) -> float:
        """Estimate the highest frame rate of the bus: the predicted or a measured one.

        The prediction uses timings measured under the machine's other load. Trial frames that are
        faster disprove it.
        """
        t_ns = [self._clock.now_ns()]
        for _ in range(_TRIAL_FRAMES):
            ready.array.scan()
            t_ns.append(self._clock.now_ns())
        return max(ready.predicted_hz, undisturbed_hz(t_ns))
