"""Array of tiles behind multiplexers: scans frames in spite of faults on the bus.

A schedule (`devices.array.schedules`) orders the transfers of a frame; this module runs them and
handles their faults. A fault is a tile flag in its frame, never an exception. A bad tile must not
slow down the others: retries share a time budget in each frame, and a silent tile is probed with a
backoff. When it answers again its registers are checked first: they are the only identity of a
part, and a part that answers with others is another part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

from devices.array.bus_recovery import BusMonitor, BusRecovery
from devices.array.free_running import FreeRunningTiles
from devices.array.plausibility import ConversionMonitor, PlausibilityCheck
from devices.array.schedules import (
    SCHEDULES,
    BusTiming,
    check_broadcast_channels,
    compute_frame_s,
    compute_turns_s,
)
from devices.array.tile import HELD_UP_NS, Scan, TileHealth, TileIo
from devices.buses.i2c import I2cBus
from devices.clock import Clock
from devices.errors import BusFaultError, NoAcknowledgeError, TileSetupError
from devices.flags import TileFlag
from devices.frames import NOT_READ, TileInfo
from devices.scene.hardware_sections import ScheduleName


class TileReconnector:
    """Prober of the lost tiles of an array, with a backoff for each."""

    def __init__(self, tile_io: TileIo, clock: Clock, health: Sequence[TileHealth]) -> None:
        self._tile_io = tile_io
        self._clock = clock
        self._health = health

    def flag_absence(self, scan: Scan, tile: int) -> None:
        """Flag a lost tile in a frame."""
        replaced = self._health[tile].is_replaced
        scan.add_flag(tile, TileFlag.IMPLAUSIBLE if replaced else TileFlag.NO_ANSWER)

    def probe_if_due(self, scan: Scan, tile: int) -> None:
        """Probe a lost tile if a probe is due; a tile that is back is sampled in the next frame."""
        self.flag_absence(scan, tile)
        health = self._health[tile]
        if not health.is_probe_due(self._clock.now_ns()):
            return
        with scan.charge_retry(self._clock):
            try:
                if self._verify_identity(tile):
                    health.mark_present()
                    return
            except TileSetupError:
                scan.add_flag(tile, TileFlag.IMPLAUSIBLE)
            except NoAcknowledgeError:
                self._tile_io.invalidate_muxes([tile])
            health.mark_lost(self._clock.now_ns())

    def _verify_identity(self, tile: int) -> bool:
        """Return whether the registers are the tile's own; mark another part as replaced."""
        health = self._health[tile]
        self._tile_io.connect_tile(tile)
        if self._tile_io.read_registers(tile) == health.registers:
            self._tile_io.start_up(tile)
            health.is_replaced = False
            return True
        # A flipped bit, in the reading or the select before it, must not look like another part.
        readings = set()
        for _ in range(2):
            self._tile_io.router.invalidate_cache()
            self._tile_io.connect_tile(tile)
            readings.add(self._tile_io.identify(tile))
        if readings == {health.registers}:
            self._tile_io.start_up(tile)
            health.is_replaced = False
            return True
        # Equal, plausible readings of other registers: another part.
        health.is_replaced = len(readings) == 1 and not self._tile_io.router.silent_addresses
        return False


AUDIT_NS = 1_000_000_000
"""Interval at which the muxes' control registers are read back."""

_REREAD_FRAMES_MIN, _REREAD_TIME_PART = 10, 0.008
"""Shortest interval in frames, and largest part of the time, for re-reading a tile."""

_BUDGET_PART = 8
_BUDGET_MIN_NS = 500_000
"""Retry budget: an eighth of a frame, but at least one reading and one check of coefficients."""
_LEARN_NS, _FORGET_NS = 10_000, 2_000
"""Largest increase, and fixed decrease, of a tile's learnt turn in each frame."""
_REPEATS_MAX = 10
"""Repeated readings of a chip with a status from which its part is set up anew."""
_DISTURBED_BUDGETS = 4
"""Factor of the retry budget on a line with flipped bits: correct readings before rate."""


class TileArray:
    """Tiles of one bus, addressed by their index in the frame.

    Args:
        bus: bus of the tiles.
        tiles: tiles as identified at start-up (`devices.array.startup`).
        clock: virtual or real clock.
        schedule: order of the transfers.
        timing: timing of bus and parts, for the duration of a frame.
        temperature_every: interval in frames at which temperature is read.
        broadcast_channels: largest number of channels open at once.
        recovery: frees a stuck bus; None: no recovery.
        read_reference_n: reads the reference force in newtons; called once in a frame at the first
            tile's sample instant, while the bus waits.

    Raises:
        SceneError: the schedule would open more channels than allowed.
    """

    def __init__(
        self,
        bus: I2cBus,
        tiles: Sequence[TileInfo],
        clock: Clock,
        *,
        schedule: ScheduleName,
        timing: BusTiming,
        temperature_every: int = 1,
        broadcast_channels: int = 8,
        recovery: BusRecovery | None = None,
        read_reference_n: Callable[[], float] | None = None,
    ) -> None:
        muxes = [tile.mux for tile in tiles]
        check_broadcast_channels(schedule, muxes, broadcast_channels)
        self.tiles = tuple(tiles)
        self.tile_indices = range(len(tiles))
        self.tiles_by_mux = tuple(
            tuple(i for i in self.tile_indices if muxes[i] == mux) for mux in sorted(set(muxes))
        )
        self.health = tuple(TileHealth(tile) for tile in tiles)
        self._clock = clock
        self._tile_io = TileIo(bus, tiles)
        self.sample_delay_ns = tuple(
            chip.compute_sample_delay_ns(tile.settings, conversion_ns)
            for tile, chip, conversion_ns in zip(
                tiles, self._tile_io.chips, self._tile_io.conversions_ns, strict=True
            )
        )
        """Delay from a conversion's begin, at the STOP of a CONVERT, to its assumed sample instant.
        """
        self.bus_monitor = BusMonitor(self._tile_io.router, clock, recovery)
        self._plausibility = PlausibilityCheck(self._tile_io, clock, self.health, self.bus_monitor)
        self._reconnector = TileReconnector(self._tile_io, clock, self.health)
        self._conversion_monitor = ConversionMonitor(self._tile_io, clock, self.health, timing)
        self._schedule = SCHEDULES[schedule]
        self._audit_due_ns = clock.now_ns() + AUDIT_NS
        self._wire_turns_ns = [round(turn_s * 1e9) for turn_s in compute_turns_s(timing)]
        self._turns_ns = list(self._wire_turns_ns)
        self._waits_for_slow_tiles = schedule != "pipelined" or len(tiles) == 1
        self._temperature_every = temperature_every
        self._read_reference_n = read_reference_n
        self.frame_ns = round(compute_frame_s(schedule, timing) * 1e9)
        """Frame period of the schedule."""
        # A tile that restarts right after its read has no finished conversion to re-read.
        self._reread_interval_frames = 0
        if schedule != "pipelined" and len(tiles) > 1:
            look_ns = (timing.select_s + timing.read_s) * 1e9
            self._reread_interval_frames = max(
                _REREAD_FRAMES_MIN, round(look_ns / (_REREAD_TIME_PART * self.frame_ns))
            )
        self._budget_ns = max(_BUDGET_MIN_NS, self.frame_ns // _BUDGET_PART)
        self._started_ns = [clock.now_ns()] * len(tiles)
        self._is_converting = [False] * len(tiles)
        self._last_counts = [(NOT_READ, NOT_READ)] * len(tiles)
        self._repeat_counts = [0] * len(tiles)
        self._free_running = FreeRunningTiles(
            self._tile_io, clock, timing, self.sample_delay_ns, self.frame_ns
        )
        self._busy_since_ns = 0
        self._frame_index = 0

    @property
    def replaced_serials(self) -> tuple[str, ...]:
        """Serials of the tiles in whose place another part answers."""
        return tuple(
            tile.serial
            for tile, health in zip(self.tiles, self.health, strict=True)
            if health.is_replaced
        )

    def begin_stream(self) -> None:
        """Begin a stream: clear fault counts and mux state; the first frame reads temperatures."""
        self._frame_index = 0
        self._tile_io.router.invalidate_cache()
        for health in self.health:
            health.fault_counts.clear()

    def discard_bus_state(self) -> None:
        """Continue the stream after another user of the bus.

        Discards the cached mux state and all running conversions.
        """
        self._tile_io.router.invalidate_cache()
        self._is_converting = [False] * len(self.tiles)

    def get_warnings(self) -> dict[str, str]:
        """Return the present warnings by serial; the bus's warning is under ""."""
        found: dict[str, str] = {}
        if self.bus_monitor.warning:
            found[""] = self.bus_monitor.warning
        for tile, health in zip(self.tiles, self.health, strict=True):
            where = f"tile {tile.serial} (mux 0x{tile.mux:02x} channel {tile.channel})"
            if health.is_replaced:
                found[tile.serial] = f"another part answers in place of {where}"
            elif not health.is_present and not self.bus_monitor.is_down:
                found[tile.serial] = f"{where} does not answer"
            elif health.has_stale_readings:
                found[tile.serial] = f"{where} never finishes a conversion"
            elif health.is_slow:
                found[tile.serial] = f"{where} converts more slowly than it was measured to"
        return found

    def scan_frame(self) -> Scan:
        """Scan one frame. A fault of a tile or the bus is a flag in it, never an exception.

        Raises:
            BusMisuseError: the adapter refuses our transfers: a bug, not a fault of the field.
        """
        begin_ns = self._clock.now_ns()
        budget_ns = self._budget_ns * (_DISTURBED_BUDGETS if self._plausibility.is_disturbed else 1)
        scan = Scan.empty(len(self.tiles), begin_ns, budget_ns)
        if not self.bus_monitor.is_down or self._reconnect_bus(scan):
            self._schedule(self, scan)
            if not scan.bus_fault:
                self._audit(scan)
        self._flag_stale_and_check_bus(scan)
        if scan.budget_ns == budget_ns:
            self._update_turns()
        if all(pressure_raw == NOT_READ for pressure_raw in scan.pressure_raw):
            # Without any answer a frame takes no time: keep the frame rate.
            self._clock.sleep_until_ns(begin_ns + self.frame_ns)
        self._frame_index += 1
        return scan

    # Operations of schedules

    def start_conversions(self, scan: Scan, tiles: Sequence[int]) -> None:
        """Start a conversion in all `tiles` at once, except behind lost muxes."""
        if len(tiles) == 1 and self._is_converting[tiles[0]]:
            return  # a slow part still converts
        if (
            self._reread_interval_frames
            and self._frame_index % self._reread_interval_frames == self._reread_interval_frames - 1
        ):
            self._check_read_in_time(scan, tiles)
        called = self._reachable_tiles(tiles)
        while called and not self._run_with_retry(
            scan, called, partial(self._tile_io.start_conversions, called)
        ):
            # A mux that does not answer must not keep the others from starting.
            silent = self._tile_io.router.refused_address
            gone = [
                i
                for i in called
                if self.tiles[i].mux == silent
                or (silent is None and i in self._tile_io.silent_tiles)
            ]
            for i in gone:
                scan.add_flag(i, TileFlag.NO_ANSWER)
                self.health[i].mark_lost(self._clock.now_ns())
            called = () if scan.is_abandoned else tuple(i for i in called if i not in gone)
        now_ns = self._clock.now_ns()
        is_held_up = now_ns - self._busy_since_ns > HELD_UP_NS
        for i in tiles:
            # A lost tile may have missed the broadcast.
            self._is_converting[i] = i in called and self.health[i].is_present
            self._started_ns[i] = now_ns
            if not self._tile_io.are_free_running[i]:
                self._is_converting[i] &= not is_held_up
            elif self.health[i].is_present:
                # The next conversion of such a part ends a conversion's time after its read.
                self._started_ns[i] = self._free_running.read_ns[i]

    def _reachable_tiles(self, tiles: Sequence[int]) -> tuple[int, ...]:
        """Return the tiles whose mux has a tile present: a broadcast addresses muxes."""
        if all(self.health[i].is_present for i in tiles):
            return tuple(tiles)
        muxes = {self.tiles[i].mux for i in tiles if self.health[i].is_present}
        return tuple(i for i in tiles if self.tiles[i].mux in muxes)

    def wait_for_back_to_back_reads(self) -> None:
        """Wait until all tiles can be read and restarted back to back.

        Otherwise a tile read late once, after a retry of another one, would stay late, and its
        sample instants would drift away from the others.
        """
        due_ns = 0
        for i in self.tile_indices:
            if self._is_converting[i] and (
                self._waits_for_slow_tiles or not self.health[i].is_slow
            ):
                ready_ns = self._started_ns[i] + self._conversion_monitor.wait_ns[i]
                due_ns = max(due_ns, ready_ns - self._turns_ns[i])
        self._clock.sleep_until_ns(due_ns)

    def read_conversion(self, scan: Scan, tile: int) -> None:
        """Read a tile's conversion as soon as it is finished; flag faults in `scan`."""
        health = self.health[tile]
        scan.convert_stop_ns[tile] = self._started_ns[tile]
        if scan.is_abandoned:
            scan.add_flag(tile, TileFlag.NO_ANSWER)
            return
        if not health.is_present:
            self._free_running.forget_phase(tile)
            if self._may_retry(scan, tile):
                self._reconnector.probe_if_due(scan, tile)
            else:
                self._reconnector.flag_absence(scan, tile)
            return
        ready_ns = self._started_ns[tile] + self._conversion_monitor.wait_ns[tile]
        if not self._is_converting[tile] or (
            health.is_slow and not self._waits_for_slow_tiles and self._clock.now_ns() < ready_ns
        ):
            scan.add_flag(tile, TileFlag.NOT_CONVERTED)
            return
        with_temperature = (
            self._frame_index % self._temperature_every == 0
            or health.is_temperature_due(self._clock.now_ns())
        )
        counts = (NOT_READ, NOT_READ)
        is_repeated = False

        def transfers() -> None:
            nonlocal counts, is_repeated
            self._tile_io.connect_tile(tile)
            self._wait_for_conversion(scan, ready_ns)
            if self._tile_io.are_free_running[tile]:
                counts = self._free_running.read_last_counts(scan, tile, with_temperature)
                is_repeated = counts[0] == NOT_READ
                return
            counts = self._tile_io.read_counts(tile, with_temperature)
            is_repeated = False
            if self._tile_io.chips[tile].has_status and counts[0] == self._last_counts[tile][0]:
                is_repeated = not self._tile_io.has_new_counts(tile)
                if not is_repeated:  # it may have ended behind the read, or long before it
                    counts = self._tile_io.read_counts(tile, with_temperature)
                    is_repeated = with_temperature and counts == self._last_counts[tile]

        answers = self._run_with_retry(scan, [tile], transfers)
        self._is_converting[tile] = False
        self._last_counts[tile] = counts
        self._repeat_counts[tile] = self._repeat_counts[tile] + 1 if is_repeated else 0
        if is_repeated:
            scan.add_flag(tile, TileFlag.NOT_CONVERTED)
            if self._repeat_counts[tile] >= _REPEATS_MAX:
                health.mark_lost(self._clock.now_ns())  # it is set up anew when it is looked for
        elif answers:
            may_ask = self._may_retry(scan, tile)
            self._plausibility.check_reading(
                scan, tile, counts, with_temperature=with_temperature, may_retry=may_ask
            )
            if self._tile_io.are_free_running[tile]:
                if scan.pressure_raw[tile] != counts[0]:
                    # A later conversion was read in its place: it has an instant of its own.
                    with scan.charge_retry(self._clock), suppress(NoAcknowledgeError):
                        self._free_running.read_last_counts(scan, tile, with_temperature=False)
                if self._free_running.is_held_up(self._busy_since_ns):
                    scan.discard_reading(tile)
                    self._free_running.forget_phase(tile)
        else:
            scan.add_flag(tile, TileFlag.NO_ANSWER)
            health.mark_lost(self._clock.now_ns())

    # Retries

    def _run_with_retry(
        self, scan: Scan, tiles: Sequence[int], transfers: Callable[[], None]
    ) -> bool:
        """Run `transfers` for `tiles`; retry once if the frame's budget allows."""
        for attempt in range(2):
            self._busy_since_ns = self._clock.now_ns()
            try:
                if scan.is_abandoned:
                    break
                transfers()
            except NoAcknowledgeError:
                self._tile_io.invalidate_muxes(tiles)
                scan.budget_ns -= self._clock.now_ns() - self._busy_since_ns
            except BusFaultError:
                self._tile_io.router.invalidate_cache()
                scan.count_bus_fault()
            else:
                if attempt:
                    for i in tiles:
                        scan.add_flag(i, TileFlag.RETRIED)
                return True
            if not self._may_retry(scan, tiles[0]):
                break
        return False

    def _may_retry(self, scan: Scan, tile: int) -> bool:
        """Return whether the frame has time left for a retry of a tile.

        Each tile in turn has a frame in which it may always retry; otherwise the first tiles would
        use up the budget.
        """
        return scan.budget_ns > 0 or tile == self._frame_index % len(self.tiles)

    def _wait_for_conversion(self, scan: Scan, ready_ns: int) -> None:
        """Sleep until a conversion is finished; read the reference at the sample instant."""
        if self._read_reference_n is not None and scan.reference_ns is None:
            scan.reference_ns = self._started_ns[0] + self.sample_delay_ns[0]
            if self._tile_io.are_free_running[0]:
                self._free_running.follow_reference(self._read_reference_n, ready_ns)
            else:
                self._clock.sleep_until_ns(scan.reference_ns)
                force_n = self._read_reference_n()
                if self._clock.now_ns() - scan.reference_ns < HELD_UP_NS:
                    scan.reference_n = force_n
        self._clock.sleep_until_ns(ready_ns)
        self._busy_since_ns = self._clock.now_ns()  # waiting is not charged to the budget

    # Once per frame

    def _update_turns(self) -> None:
        """Update each tile's turn: the delay from the frame's begin to its start, undisturbed.

        It contains the time on the wires and the driver's own, in which conversions go on. It rises
        slowly, in frames without retries only, and falls slowly: a single late tile must not become
        the norm.
        """
        begin_ns = self._started_ns[0] - self._wire_turns_ns[0]
        for i, started_ns in enumerate(self._started_ns):
            known_ns = min(started_ns - begin_ns, self._turns_ns[i] + _LEARN_NS)
            self._turns_ns[i] = max(self._wire_turns_ns[i], known_ns - _FORGET_NS)

    def _reconnect_bus(self, scan: Scan) -> bool:
        if self.bus_monitor.try_reconnect():
            for health in self.health:
                if not health.is_replaced:
                    health.mark_unverified(self._clock.now_ns())
            return True
        scan.bus_fault = True
        for i in self.tile_indices:
            scan.add_flag(i, TileFlag.NO_ANSWER)
        return False

    def _audit(self, scan: Scan) -> None:
        """Audit the muxes at intervals, and test the conversion time of a suspect tile."""
        now_ns = self._clock.now_ns()
        try:
            if now_ns >= self._audit_due_ns:
                self._audit_due_ns = now_ns + AUDIT_NS
                self._tile_io.router.verify_masks()
            tile = self._conversion_monitor.pop_due_trial()
            if tile is not None:
                self._conversion_monitor.test_conversion_time(tile)
                self._is_converting[tile] = False
                self.start_conversions(scan, [tile])
        except NoAcknowledgeError:  # the next frame will show the tile
            self._tile_io.router.invalidate_cache()
        except BusFaultError:
            scan.count_bus_fault()

    def _check_read_in_time(self, scan: Scan, tiles: Sequence[int]) -> None:
        """Re-read one tile before its next start, to check that its conversion had finished."""
        tile = self._frame_index // self._reread_interval_frames % len(self.tiles)
        if tile not in tiles:
            return
        if (
            not self.health[tile].is_present
            or self._is_converting[tile]
            or self._last_counts[tile][0] == NOT_READ
        ):
            return
        try:
            self._conversion_monitor.check_read_in_time(tile, self._last_counts[tile])
        except NoAcknowledgeError:  # the next read will show it
            self._tile_io.invalidate_muxes([tile])
        except BusFaultError:
            scan.count_bus_fault()

    def _flag_stale_and_check_bus(self, scan: Scan) -> None:
        """Flag stale tiles, count faults, and check the bus after a frame without any answer."""
        for i, health in enumerate(self.health):
            if health.update_staleness(scan.pressure_raw[i], scan.temperature_raw[i]):
                scan.add_flag(i, TileFlag.STALE)
                if health.is_trial_due:
                    self._conversion_monitor.queue_trial(i)
            if scan.tile_flags[i]:
                health.count_faults(scan.tile_flags[i])
        if self.bus_monitor.is_down:
            return
        if not scan.is_abandoned and not any(h.is_present or h.is_replaced for h in self.health):
            self.bus_monitor.check_bus(scan)
        if scan.is_abandoned:
            self.bus_monitor.mark_down()
            self._is_converting = [False] * len(self.tiles)
