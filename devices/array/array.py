"""Array of tiles behind multiplexers: scans frames in spite of faults on the bus.

A schedule (`devices.array.schedules`) orders the transfers of a frame; this module runs them and
handles their faults. A fault is a tile flag in its frame, never an exception. A bad tile must not
slow down the others: retries share a time budget in each frame, and a silent tile is probed with a
backoff. When it answers again its coefficients are checked first: it may be another part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from devices.array.budget import BusTiming, check_broadcast, frame_s, turns_s
from devices.array.bus_watch import BusWatch
from devices.array.conversion_watch import ConversionWatch
from devices.array.health import TileHealth
from devices.array.judge import Judge
from devices.array.ports import Scan, TilePorts
from devices.array.schedules import SCHEDULES
from devices.array.search import Search
from devices.buses.i2c import I2cBus
from devices.chips.mpl115a2 import SAMPLE_PART_OF_CONVERSION
from devices.clock import Clock
from devices.errors import BusFaultError, NoAcknowledgeError
from devices.frames import NOT_READ, TileInfo, TileStatus
from devices.recovery.recovery import BusRecovery
from devices.scene.hardware import ScheduleName

AUDIT_NS = 1_000_000_000
"""Interval at which the muxes' control registers are read back."""

_LOOK_FRAMES, _LOOK_PART = 10, 0.008
"""Shortest interval in frames, and largest part of the time, for re-reading a tile."""

_BUDGET_PART = 8
_BUDGET_MIN_NS = 500_000
"""Retry budget: an eighth of a frame, but at least one reading and one check of coefficients."""
_LEARN_NS, _FORGET_NS = 10_000, 2_000
"""Largest increase, and fixed decrease, of a tile's learnt turn in each frame."""
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
        reference_n: reads the reference force in newtons; called once in a frame at the first
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
        reference_n: Callable[[], float] | None = None,
    ) -> None:
        muxes = [tile.mux for tile in tiles]
        check_broadcast(schedule, muxes, broadcast_channels)
        self.tiles = tuple(tiles)
        self.indices = range(len(tiles))
        self.by_mux = tuple(
            tuple(i for i in self.indices if muxes[i] == mux) for mux in sorted(set(muxes))
        )
        self.sample_delay_ns = tuple(
            round(tile.conversion_ms * 1e6) // SAMPLE_PART_OF_CONVERSION for tile in tiles
        )
        """Delay from the STOP of a tile's CONVERT to the assumed sample instant of its pressure."""
        self.health = tuple(TileHealth(tile) for tile in tiles)
        self._clock = clock
        self._ports = TilePorts(bus, tiles)
        self.bus = BusWatch(self._ports.router, clock, recovery)
        self._judge = Judge(self._ports, clock, self.health, self.bus)
        self._search = Search(self._ports, clock, self.health)
        self._watch = ConversionWatch(self._ports, clock, self.health, timing)
        self._schedule = SCHEDULES[schedule]
        self._audit_due_ns = clock.now_ns() + AUDIT_NS
        self._wire_turns_ns = [round(turn_s * 1e9) for turn_s in turns_s(timing)]
        self._turns_ns = list(self._wire_turns_ns)
        self._waits_for_slow_ones = schedule != "pipelined" or len(tiles) == 1
        self._temperature_every = temperature_every
        self._reference_n = reference_n
        self._frame_ns = round(frame_s(schedule, timing) * 1e9)
        # A tile that restarts right after its read has no finished conversion to re-read.
        self._look_frames = 0
        if schedule != "pipelined" and len(tiles) > 1:
            look_ns = (timing.select_s + timing.read_s) * 1e9
            self._look_frames = max(_LOOK_FRAMES, round(look_ns / (_LOOK_PART * self._frame_ns)))
        self._budget_ns = max(_BUDGET_MIN_NS, self._frame_ns // _BUDGET_PART)
        self._started_ns = [clock.now_ns()] * len(tiles)
        self._running = [False] * len(tiles)
        self._words = [(NOT_READ, NOT_READ)] * len(tiles)
        self._busy_since_ns = 0
        self._frames = 0

    @property
    def replaced(self) -> tuple[str, ...]:
        """Serials of the tiles in whose place another part answers."""
        return tuple(
            tile.serial
            for tile, health in zip(self.tiles, self.health, strict=True)
            if health.replaced
        )

    def begin(self) -> None:
        """Begin a stream: clear fault counts and mux state; the first frame reads temperatures."""
        self._frames = 0
        self._ports.router.forget()
        for health in self.health:
            health.counts.clear()

    def resume(self) -> None:
        """Continue the stream after another user of the bus.

        Discards the cached mux state and all running conversions.
        """
        self._ports.router.forget()
        self._running = [False] * len(self.tiles)

    def troubles(self) -> dict[str, str]:
        """Return the present warnings by serial; the bus's warning is under ""."""
        found: dict[str, str] = {}
        if self.bus.trouble:
            found[""] = self.bus.trouble
        for tile, health in zip(self.tiles, self.health, strict=True):
            where = f"tile {tile.serial} (mux 0x{tile.mux:02x} channel {tile.channel})"
            if health.replaced:
                found[tile.serial] = f"another part answers in place of {where}"
            elif not health.present and not self.bus.is_down:
                found[tile.serial] = f"{where} does not answer"
            elif health.is_repeating:
                found[tile.serial] = f"{where} never finishes a conversion"
            elif health.slow:
                found[tile.serial] = f"{where} converts more slowly than it was measured to"
        return found

    def scan(self) -> Scan:
        """Scan one frame. A fault of a tile or the bus is a flag in it, never an exception.

        Raises:
            BusMisuseError: the adapter refuses our transfers: a bug, not a fault of the field.
        """
        begin_ns = self._clock.now_ns()
        budget_ns = self._budget_ns * (_DISTURBED_BUDGETS if self._judge.is_disturbed else 1)
        scan = Scan.blank(len(self.tiles), begin_ns, budget_ns)
        if not self.bus.is_down or self._bus_comes_back(scan):
            self._schedule(self, scan)
            if not scan.bus_fault:
                self._audit(scan)
        self._conclude(scan)
        if scan.budget_ns == budget_ns:
            self._learn_turns()
        if all(padc == NOT_READ for padc in scan.padc):
            # Without any answer a frame takes no time: keep the frame rate.
            self._clock.sleep_until_ns(begin_ns + self._frame_ns)
        self._frames += 1
        return scan

    # Operations of schedules

    def convert(self, scan: Scan, tiles: Sequence[int]) -> None:
        """Start a conversion in all `tiles` at once, except behind lost muxes."""
        if len(tiles) == 1 and self._running[tiles[0]]:
            return  # a slow part still converts
        if self._look_frames and self._frames % self._look_frames == self._look_frames - 1:
            self._look_again(scan, tiles)
        called = self._worth_calling(tiles)
        while called and not self._attempt(scan, called, partial(self._ports.convert, called)):
            # A mux that does not answer must not keep the others from starting.
            silent = self._ports.router.refused
            gone = [i for i in called if silent in (None, self.tiles[i].mux)]
            for i in gone:
                scan.flag(i, TileStatus.NO_ANSWER)
                self.health[i].lose(self._clock.now_ns())
            called = () if scan.given_up else tuple(i for i in called if i not in gone)
        now_ns = self._clock.now_ns()
        for i in tiles:
            self._started_ns[i] = now_ns
            # A lost tile may have missed the broadcast.
            self._running[i] = i in called and self.health[i].present

    def _worth_calling(self, tiles: Sequence[int]) -> tuple[int, ...]:
        """Return the tiles whose mux has a tile present: a broadcast addresses muxes."""
        if all(self.health[i].present for i in tiles):
            return tuple(tiles)
        muxes = {self.tiles[i].mux for i in tiles if self.health[i].present}
        return tuple(i for i in tiles if self.tiles[i].mux in muxes)

    def close_ranks(self) -> None:
        """Wait until all tiles can be read and restarted back to back.

        Otherwise a tile read late once, after a retry of another one, would stay late, and its
        sample instants would drift away from the others.
        """
        due_ns = 0
        for i in self.indices:
            if self._running[i] and (self._waits_for_slow_ones or not self.health[i].slow):
                ready_ns = self._started_ns[i] + self._watch.wait_ns[i]
                due_ns = max(due_ns, ready_ns - self._turns_ns[i])
        self._clock.sleep_until_ns(due_ns)

    def collect(self, scan: Scan, tile: int) -> None:
        """Read a tile's conversion as soon as it is finished; flag faults in `scan`."""
        health = self.health[tile]
        scan.convert_stop_ns[tile] = self._started_ns[tile]
        if scan.given_up:
            scan.flag(tile, TileStatus.NO_ANSWER)
            return
        if not health.present:
            if self._may_spend(scan, tile):
                self._search.look_for(scan, tile)
            else:
                self._search.note_absence(scan, tile)
            return
        ready_ns = self._started_ns[tile] + self._watch.wait_ns[tile]
        if not self._running[tile] or (
            health.slow and not self._waits_for_slow_ones and self._clock.now_ns() < ready_ns
        ):
            scan.flag(tile, TileStatus.NOT_CONVERTED)
            return
        with_temperature = self._frames % self._temperature_every == 0 or health.wants_temperature(
            self._clock.now_ns()
        )
        words = (NOT_READ, NOT_READ)

        def transfers() -> None:
            nonlocal words
            self._ports.connect(tile)
            self._wait(scan, ready_ns)
            words = self._ports.read(with_temperature)

        answers = self._attempt(scan, [tile], transfers)
        self._running[tile] = False
        self._words[tile] = words
        if answers:
            may_ask = self._may_spend(scan, tile)
            self._judge.judge(scan, tile, words, with_temperature=with_temperature, may_ask=may_ask)
        else:
            scan.flag(tile, TileStatus.NO_ANSWER)
            health.lose(self._clock.now_ns())

    # Retries

    def _attempt(self, scan: Scan, tiles: Sequence[int], transfers: Callable[[], None]) -> bool:
        """Run `transfers` for `tiles`; retry once if the frame's budget allows."""
        for attempt in range(2):
            self._busy_since_ns = self._clock.now_ns()
            try:
                if scan.given_up:
                    break
                transfers()
            except NoAcknowledgeError:
                self._ports.forget(tiles)
                scan.budget_ns -= self._clock.now_ns() - self._busy_since_ns
            except BusFaultError:
                self._ports.router.forget()
                scan.note_bus_fault()
            else:
                if attempt:
                    for i in tiles:
                        scan.flag(i, TileStatus.RETRIED)
                return True
            if not self._may_spend(scan, tiles[0]):
                break
        return False

    def _may_spend(self, scan: Scan, tile: int) -> bool:
        """Return whether the frame has time left for a retry of a tile.

        Each tile in turn has a frame in which it may always retry; otherwise the first tiles would
        use up the budget.
        """
        return scan.budget_ns > 0 or tile == self._frames % len(self.tiles)

    def _wait(self, scan: Scan, ready_ns: int) -> None:
        """Sleep until a conversion is finished; read the reference at the sample instant."""
        if self._reference_n is not None and scan.reference_ns is None:
            scan.reference_ns = self._started_ns[0] + self.sample_delay_ns[0]
            self._clock.sleep_until_ns(scan.reference_ns)
            scan.reference_n = self._reference_n()
        self._clock.sleep_until_ns(ready_ns)
        self._busy_since_ns = self._clock.now_ns()  # waiting is not charged to the budget

    # Once per frame

    def _learn_turns(self) -> None:
        """Update each tile's turn: the delay from the frame's begin to its start, undisturbed.

        It contains the time on the wires and the driver's own, in which conversions go on. It rises
        slowly, in frames without retries only, and falls slowly: a single late tile must not become
        the norm.
        """
        begin_ns = self._started_ns[0] - self._wire_turns_ns[0]
        for i, started_ns in enumerate(self._started_ns):
            known_ns = min(started_ns - begin_ns, self._turns_ns[i] + _LEARN_NS)
            self._turns_ns[i] = max(self._wire_turns_ns[i], known_ns - _FORGET_NS)

    def _bus_comes_back(self, scan: Scan) -> bool:
        if self.bus.comes_back():
            for health in self.health:
                if not health.replaced:
                    health.doubt(self._clock.now_ns())
            return True
        scan.bus_fault = True
        for i in self.indices:
            scan.flag(i, TileStatus.NO_ANSWER)
        return False

    def _audit(self, scan: Scan) -> None:
        """Audit the muxes at intervals, and test the conversion time of a suspect tile."""
        now_ns = self._clock.now_ns()
        try:
            if now_ns >= self._audit_due_ns:
                self._audit_due_ns = now_ns + AUDIT_NS
                self._ports.router.audit()
            tile = self._watch.to_try()
            if tile is not None:
                self._watch.try_conversion(tile)
                self._running[tile] = False
                self.convert(scan, [tile])
        except NoAcknowledgeError:  # the next frame will show the tile
            self._ports.router.forget()
        except BusFaultError:
            scan.note_bus_fault()

    def _look_again(self, scan: Scan, tiles: Sequence[int]) -> None:
        """Re-read one tile before its next start, to check that its conversion had finished."""
        tile = self._frames // self._look_frames % len(self.tiles)
        if tile not in tiles:
            return
        if not self.health[tile].present or self._running[tile] or self._words[tile][0] == NOT_READ:
            return
        try:
            self._watch.look_again(tile, self._words[tile])
        except NoAcknowledgeError:  # the next read will show it
            self._ports.forget([tile])
        except BusFaultError:
            scan.note_bus_fault()

    def _conclude(self, scan: Scan) -> None:
        """Flag stale tiles, count faults, and check the bus after a frame without any answer."""
        for i, health in enumerate(self.health):
            if health.is_stale(scan.padc[i], scan.tadc[i]):
                scan.flag(i, TileStatus.STALE)
                if health.wants_trial:
                    self._watch.suspect(i)
            if scan.status[i]:
                health.note(scan.status[i])
        if self.bus.is_down:
            return
        if not scan.given_up and not any(h.present or h.replaced for h in self.health):
            self.bus.look(scan)
        if scan.given_up:
            self.bus.fall()
            self._running = [False] * len(self.tiles)
