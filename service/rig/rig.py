"""Rig on a real clock: array, servo, reference force sensor and recovery lines, ready to stream.

Each may be real or emulated.

The rate of a trial is estimated from its fastest runs of frames; a stream that is faster than its
nominal rate disproves that rate.

A busy machine reads few frames in a second, so a load that begins after a fixed time alone could
begin too early.
"""

from __future__ import annotations

import math
import sys
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np

from devices.acquisition import Acquisition
from devices.array.bus_recovery import BusRecovery, GpioRecovery, open_gpio_recovery
from devices.array.startup import ReadyArray, prepare_array, reidentify_replaced_tiles
from devices.buses.i2c import open_bus
from devices.buses.spi import open_spi
from devices.chips.dynamixel.position_sources import ThreadedServoSource
from devices.chips.dynamixel.protocol import COUNTS_PER_TURN
from devices.chips.dynamixel.servo_setup import open_servo
from devices.chips.mcp3208 import COUNTS_MAX, COUNTS_PER_VREF, Mcp3208
from devices.clock import Clock, DriverClock, SpinningClock, SystemClock, UtcAnchor, WireClock
from devices.errors import FootTileError, I2cError, SpiError, TileSetupError, UsageError
from devices.flags import FrameFlag, TileFlag
from devices.frames import ArrayInfo, Edge, FrameBatch, ServoInfo, TileInfo
from devices.realtime import is_clock_set, set_timer_slack, use_realtime_priority
from devices.scene.hardware_sections import EMULATED, ReferenceSection, ScheduleName, ServoSection
from devices.scene.scene_file import Scene
from devices.sync_lines import EdgeReader, SyncInput
from service.rig.emulated_foot import RigOptions
from service.version import SOFTWARE_VERSION
from storage.journal.node.in_flight import InFlightWriter, try_create_in_flight_writer

if TYPE_CHECKING:
    from devices.emulation.world import World


def make_array_info(
    scene: Scene,
    tiles: tuple[TileInfo, ...],
    anchor: UtcAnchor,
    *,
    node: str,
    stream_id: str,
    schedule: ScheduleName,
    rate_hz: float,
) -> ArrayInfo:
    """Compose the array description of a stream.

    Args:
        scene: the scene file.
        tiles: tiles as identified on the bus.
        anchor: UTC anchor of the stream.
        node: name of the node.
        stream_id: id of the stream.
        schedule: schedule of the bus.
        rate_hz: expected frame rate.
    """
    servo = None
    if scene.servo is not None:
        servo = ServoInfo(
            model=scene.servo.model,
            counts_per_turn=COUNTS_PER_TURN,
            zero_counts=scene.servo.zero_counts,
            sign=scene.servo.sign,
            ratio=scene.servo.ratio,
            ankle_travel_m_per_rad=scene.servo.ankle_travel_m_per_rad,
        )
    return ArrayInfo(
        node=node,
        stream_id=stream_id,
        tiles=tiles,
        servo=servo,
        schedule=schedule,
        nominal_rate_hz=rate_hz,
        utc_offset_ns=anchor.offset_ns,
        clock_set=anchor.clock_set,
        software=SOFTWARE_VERSION,
        scene=scene.name,
        models=scene.models,
    )


_RUN_FRAMES = 10
"""Frames in a run, which averages out an early frame after a pause."""
_FASTEST_PERCENTILE = 10  # percentile of the runs' durations: most runs may be disturbed
_EXCESS_RATIO = 1.02
"""Ratio to the nominal rate, over `_EXCESS_WINDOW_NS`, that exceeds jitter."""
_EXCESS_WINDOW_NS = 2_000_000_000


def estimate_undisturbed_rate_hz(t_ns: Sequence[int]) -> float:
    """Estimate the frame rate from the fastest runs of frames.

    Args:
        t_ns: end of each frame of a trial, rising, more than ten frames.
    """
    instants_ns = np.asarray(t_ns, dtype=np.int64)
    took_ns = instants_ns[_RUN_FRAMES:] - instants_ns[:-_RUN_FRAMES]
    return float(1e9 * _RUN_FRAMES / np.percentile(took_ns, _FASTEST_PERCENTILE))


class FrameRateMonitor:
    """Monitor of a stream that detects frames faster than the nominal rate.

    Args:
        nominal_hz: nominal rate, the assumed maximum.
    """

    def __init__(self, nominal_hz: float) -> None:
        self._nominal_hz = nominal_hz
        self._passed: deque[tuple[int, int]] = deque()
        self.exceeding_rate_hz: float | None = None
        """Measured rate that exceeds the nominal one; None until then."""

    def add_batch(self, batch: FrameBatch) -> None:
        """Update with the next batch."""
        passed = self._passed
        passed.append((int(batch.t_mono_ns[-1]), int(batch.seq[-1])))
        (begin_ns, first), (end_ns, last) = passed[0], passed[-1]
        if end_ns - begin_ns < _EXCESS_WINDOW_NS:
            return
        rate_hz = 1e9 * (last - first) / (end_ns - begin_ns)
        if rate_hz > _EXCESS_RATIO * self._nominal_hz:
            self.exceeding_rate_hz = rate_hz
        passed.popleft()


USABLE_FRAMES_MIN = 25
"""Usable readings of each tile before the scene's time begins: more than a tare needs."""
LEAD_TIMEOUT_NS = 10_000_000_000
"""Timeout after which the load begins without usable readings of all tiles."""
_NOT_YET_NS = 2**62


class LoadTrigger:
    """Trigger of an emulated load; frames before `end_t_mono_ns` are its lead.

    Args:
        world: world whose time this begins; until then it stays at its first instant.
        lead_s: seconds without load after that; 0: no lead, and no waiting.
    """

    def __init__(self, world: World, lead_s: float) -> None:
        self._world = world
        self._lead_ns = round(lead_s * 1e9)
        self._usable_frames = 0
        self._since_ns: int | None = None
        self.end_ns = _NOT_YET_NS
        """End of the lead on the node's clock; far in the future while unknown."""
        if not self._lead_ns:
            self._begin_world()

    def add_batch(self, batch: FrameBatch) -> None:
        """Count usable readings of the next batch; begin the world's time if there are enough."""
        if self.end_ns != _NOT_YET_NS:
            return
        if self._since_ns is None:
            self._since_ns = int(batch.t_mono_ns[0])
        # Of all tiles at once: a tare needs frames in which all tiles are usable.
        self._usable_frames += int(((batch.tile_flags & TileFlag.UNUSABLE) == 0).all(axis=1).sum())
        waited_ns = int(batch.t_mono_ns[-1]) - self._since_ns
        if self._usable_frames >= USABLE_FRAMES_MIN or waited_ns > LEAD_TIMEOUT_NS:
            self._begin_world()

    def _begin_world(self) -> None:
        self._world.begin_scene_time()
        self.end_ns = self._world.epoch_ns + self._lead_ns


class ReferenceForceSensor:
    """Reference force of a calibration rig: a load cell's amplifier, read through an MCP3208.

    A failed reading is NaN and never an exception. The scene gives the newtons per volt: the scale
    of the paper's sensor and amplifier is not known (hardware.md 6), so there is no default.
    """

    def __init__(self, adc: Mcp3208, scene: ReferenceSection) -> None:
        self.warning = ""
        """Reason why the last reading gave no force; empty if it gave one."""
        self._adc = adc
        self._channel = scene.channel
        self._zero_v = scene.zero_v
        self._n_per_v = scene.n_per_v
        self._volts_per_count = scene.vref_v / COUNTS_PER_VREF

    def read_force_n(self) -> float:
        """Convert now and return the force in newtons.

        NaN if the reading failed or is at either rail: an open, shorted or overloaded amplifier
        must never give a plausible force.
        """
        try:
            counts = self._adc.read_counts(self._channel)
        except SpiError as error:
            self.warning = f"no reference force: {error}"
            return math.nan
        if counts in (0, COUNTS_MAX):
            self.warning = "no reference force: the amplifier is off, unplugged or overloaded"
            return math.nan
        self.warning = ""
        return (counts * self._volts_per_count - self._zero_v) * self._n_per_v


def open_reference_sensor(
    scene: Scene, world: World | None, stack: ExitStack
) -> ReferenceForceSensor | None:
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
        indenter = world.indenter if world is not None else None
        if world is None or indenter is None:
            raise UsageError(
                f"scene {scene.name!r} has an emulated reference sensor and no emulated indenter",
                remedy='Set ground.kind = "indentation", or reference.port to a device',
            )
        emulated = indenter.make_adc(reference, world.clock)
    device = open_spi(reference.port, emulated)
    stack.callback(device.close)
    return ReferenceForceSensor(Mcp3208(device, where=reference.port), reference)


def open_scene_recovery(scene: Scene, clock: Clock, world: World | None) -> BusRecovery | None:
    """Open the recovery of the scene's bus; None if no lines are wired.

    Raises:
        BusSetupError: the lines cannot be requested.
    """
    if scene.recovery is None or world is None or scene.array.bus != EMULATED:
        return open_gpio_recovery(scene.recovery, clock)
    from devices.emulation.i2c_bus import EmulatedGpioLines

    return GpioRecovery(EmulatedGpioLines(world.i2c_adapter, clock), clock)


_TRIAL_FRAMES = 100
"""Frames of the rate measurement: a fifth of a second with four tiles."""
_REIDENTIFY_INTERVAL_NS = 2_000_000_000
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
        set_timer_slack()
        self._options = options
        self._clock: Clock = SpinningClock()
        # Other threads, and the emulated wires, must not spin on the loop's core.
        self._line_clock = SystemClock()
        self._lead: LoadTrigger | None = None
        world = self._make_world(options)
        self._bus = open_bus(scene.array.bus, world.i2c_adapter if world is not None else None)
        stack.callback(self._bus.close)
        self._recovery = open_scene_recovery(scene, self._clock, world)
        self._reference = open_reference_sensor(scene, world, stack)
        self._read_reference_n = None if self._reference is None else self._reference.read_force_n
        self._ready = prepare_array(
            self._bus,
            scene,
            self._clock,
            recovery=self._recovery,
            read_reference_n=self._read_reference_n,
        )
        self.startup_messages = [
            f"schedule {self._ready.choice.schedule}: {self._ready.choice.reason}"
        ]
        """Start-up messages for the user."""
        self.startup_messages += [
            f"the conversion time of tile {serial} could not be measured; the longest is assumed"
            for serial in self._ready.unmeasured_serials
        ]
        self._servo_source = (
            self._open_servo_source(scene.servo, world, stack) if scene.servo is not None else None
        )
        self._sync: SyncInput | None = None
        self._edge_reader: EdgeReader | None = None
        if scene.sync is not None and scene.sync.input_line is not None:
            self._sync = SyncInput(scene.sync, scene.sync.input_line)
            stack.callback(self._sync.close)
        self._reidentify_at_ns = 0
        self._in_flight: InFlightWriter | None = None
        bus_hz = self._estimate_max_rate_hz(self._ready)
        # Last: on a busy machine the start-up before would use up the lead.
        if world is not None and options.is_emulated:
            self._lead = LoadTrigger(world, options.foot.lead_s)
            stack.callback(self._write_plates, world)
        elif world is not None:
            world.begin_scene_time()
        self._begin_stream(bus_hz, is_reidentified=False)
        if not options.is_emulated:
            # Last, and only this thread: an emulated world would starve the rest of the machine.
            use_realtime_priority()

    def _begin_stream(self, bus_hz: float, *, is_reidentified: bool) -> None:
        scene, ready = self._options.scene, self._ready
        anchor = UtcAnchor.measure(clock_set=is_clock_set())
        self.info: ArrayInfo = make_array_info(
            scene,
            ready.tiles,
            anchor,
            node=self._options.node_name,
            stream_id=uuid.uuid4().hex,
            schedule=ready.choice.schedule,
            rate_hz=min(scene.rate_hz or bus_hz, bus_hz),
        )
        if self._in_flight is not None:
            self._in_flight.close()
        streams = self._options.journals_folder
        folder = None if streams is None else streams / self.info.stream_id
        self._in_flight = try_create_in_flight_writer(folder, self.info)
        if self._sync is not None:
            self._edge_reader = EdgeReader(self._sync, self._in_flight)
        if folder is not None and self._in_flight is None:
            self.startup_messages.append(
                "no room for frames in flight: a crash may cost the last batches"
            )
        self.acquisition = Acquisition(
            ready.array,
            ready.tiles,
            self._clock,
            anchor,
            rate_hz=scene.rate_hz,
            expected_rate_hz=bus_hz,
            servo=self._servo_source,
            is_reidentified=is_reidentified,
            frame_sink=self._edge_reader or self._in_flight,
            lead_end_ns=None if self._lead is None else self._lead.end_ns,
        )
        self._rate_monitor = FrameRateMonitor(self.info.nominal_rate_hz)

    def acquire_batches(self, should_stop: Callable[[], bool]) -> Iterator[FrameBatch]:
        """Acquire batches of one stream until `should_stop()` returns True.

        Frames before the begin of an emulated load are flagged as lead. The stream also ends when a
        part was replaced, or when it is faster than its nominal rate: then `info` describes a new
        stream, which the next call acquires.
        """
        while not should_stop():
            for batch in self.acquisition.acquire_batches(
                lambda: should_stop() or self._is_reidentification_due()
            ):
                if self._lead is not None:
                    self._lead.add_batch(batch)
                    self.acquisition.lead_end_ns = self._lead.end_ns
                if not batch.frame_flags[-1] & FrameFlag.LEAD:  # a lead is of one stream
                    self._rate_monitor.add_batch(batch)
                yield batch
                if self._rate_monitor.exceeding_rate_hz is not None:
                    self._begin_stream(self._rate_monitor.exceeding_rate_hz, is_reidentified=False)
                    return
            if not should_stop() and self._reidentify():
                return

    def take_edges(self) -> tuple[Edge, ...]:
        """Return the edges of the sync line up to the last frame, since the last call."""
        return () if self._edge_reader is None else self._edge_reader.take_batch()

    def get_warnings(self) -> dict[str, str]:
        """Return the present warnings, by tile's serial or device."""
        found = self._ready.array.get_warnings()
        if self._reference is not None and self._reference.warning:
            found["reference"] = self._reference.warning
        if self._servo_source is not None and self._servo_source.warning:
            found["servo"] = f"servo: {self._servo_source.warning}"
        if self._sync is not None and self._sync.warning:
            found["sync"] = self._sync.warning
        return found

    def get_fault_counts(self) -> dict[str, dict[str, int]]:
        """Return the fault counts of the stream by serial, `sync` for the sync line, and reason."""
        array = self._ready.array
        dropped = 0 if self._sync is None else self._sync.dropped_edges
        return ({"sync": {"dropped_edges": dropped}} if dropped else {}) | {
            tile.serial: dict(health.fault_counts)
            for tile, health in zip(array.tiles, array.health, strict=True)
            if health.fault_counts
        }

    def _is_reidentification_due(self) -> bool:
        return (
            bool(self._ready.array.replaced_serials)
            and self._clock.now_ns() >= self._reidentify_at_ns
        )

    def _reidentify(self) -> bool:
        try:
            self._ready = reidentify_replaced_tiles(
                self._bus,
                self._options.scene,
                self._clock,
                self._ready,
                recovery=self._recovery,
                read_reference_n=self._read_reference_n,
            )
        except (I2cError, TileSetupError):  # perhaps half plugged in: go on with the others
            self._reidentify_at_ns = self._clock.now_ns() + _REIDENTIFY_INTERVAL_NS
            self._ready.array.discard_bus_state()
            return False
        self._begin_stream(self._estimate_max_rate_hz(self._ready), is_reidentified=True)
        return True

    def _make_world(self, options: RigOptions) -> World | None:
        scene = options.scene
        if not options.is_emulated and (scene.servo is None or scene.servo.port != EMULATED):
            return None
        sys.setswitchinterval(_SWITCH_S)
        pressed = options.foot.compute_tile_load(scene)
        clock: Clock = self._line_clock
        if options.is_emulated:
            self._clock = driver = DriverClock(self._clock)
            clock = WireClock(driver, self._line_clock)
        return options.foot.make_world(scene, clock, pressed, is_repeated=True, in_real_time=True)

    def _write_plates(self, world: World) -> None:
        """Write the plates' files on closing; print errors, as no caller can handle them."""
        try:
            self._options.foot.write_plate_recordings(world, self._clock.now_ns())
        except FootTileError as error:
            sys.stderr.write(f"foottile: {error}\n")

    def _open_servo_source(
        self, scene: ServoSection, world: World | None, stack: ExitStack
    ) -> ThreadedServoSource:
        port: str | Callable[[], str] = scene.port
        if port == EMULATED and world is not None:
            emulated = stack.enter_context(world.open_servo(scene, self._line_clock))
            port = lambda: emulated.port  # noqa: E731  # read again at each opening
        servo = open_servo(
            port,
            baudrate=scene.baudrate,
            clock=self._line_clock,
            servo_id=scene.id,
            model=scene.model,
            protocol=scene.protocol,
            allows_missing_port=True,
        )
        stack.callback(servo.close)
        self.startup_messages += servo.opening_warnings
        return stack.enter_context(
            ThreadedServoSource(servo, self._line_clock, rate_hz=scene.rate_hz)
        )

    def _estimate_max_rate_hz(self, ready: ReadyArray) -> float:
        """Estimate the highest frame rate of the bus: the predicted or a measured one.

        The prediction uses timings measured under the machine's other load. Trial frames that are
        faster disprove it.
        """
        t_ns = [self._clock.now_ns()]
        for _ in range(_TRIAL_FRAMES):
            ready.array.scan_frame()
            t_ns.append(self._clock.now_ns())
        return max(ready.predicted_rate_hz, estimate_undisturbed_rate_hz(t_ns))
