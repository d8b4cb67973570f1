"""An array of tiles behind multiplexers: takes frames, whatever happens on the bus.

The order of a frame's transfers is a schedule's (`devices.array.schedules`); here is what a
transfer does and what becomes of it when it fails. A fault is a bit of `TileStatus` in the frame in
which the bus shows it, never an exception. The bad tile is left alone so that the others keep their
rate: second attempts share a budget of time in each frame, and a tile that has fallen silent is
looked for now and then. Before it is believed again its coefficients are read: it may be another
part.
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
"""In one of so many frames, and for no more than this part of the time, a tile is read again."""

_BUDGET_PART = 8
_BUDGET_MIN_NS = 500_000
"""Second attempts may take an eighth of a frame, but always one reading and a look at who it is."""
_LEARN_NS, _FORGET_NS = 10_000, 2_000
"""In each frame so much more of the driver's own time is taken for granted, and so much less."""
_DISTURBED_BUDGETS = 4
"""On a line with flipped bits, correct readings are worth some of the rate."""


class TileArray:
    """Tiles of one bus, addressed by their index in the frame.

    Args:
        bus: what they hang on.
        tiles: as identified at start-up (`devices.array.startup`).
        clock: virtual or real.
        schedule: the order of transfers.
        timing: of bus and parts, for the length of a frame.
        temperature_every: temperature is read in every so many frames.
        broadcast_channels: how many channels may be open at once.
        recovery: frees a stuck bus; None: there is none.
        reference_n: gives the reference force in newtons; called once in a frame at the first
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
        """From the STOP of a tile's CONVERT to the instant its pressure is taken to be sampled."""
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
        # A tile that is started again right after its read has nothing to be read again.
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
        """Serials of the tiles that another part than the identified one now answers for."""
        return tuple(
            tile.serial
            for tile, health in zip(self.tiles, self.health, strict=True)
            if health.replaced
        )

    def begin(self) -> None:
        """A stream begins: its first frame reads all temperatures, and nothing has gone wrong."""
        self._frames = 0
        self._ports.router.forget()
        for health in self.health:
            health.counts.clear()

    def resume(self) -> None:
        """The stream goes on after something else used the bus.

        Nothing is taken to be as it was left, and what was converting is too old to be read.
        """
        self._ports.router.forget()
        self._running = [False] * len(self.tiles)

    def troubles(self) -> dict[str, str]:
        """What is wrong now, in words, by serial; the bus's trouble is under ""."""
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
        """Take one frame. A fault of a tile or the bus is a status bit in it, never an exception.

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
            # No tile answers, so nothing was waited for: do not run faster because of it.
            self._clock.sleep_until_ns(begin_ns + self._frame_ns)
        self._frames += 1
        return scan

    # What schedules are made of

    def convert(self, scan: Scan, tiles: Sequence[int]) -> None:
        """Start a conversion in all `tiles` at once, except in those that are lost."""
        if len(tiles) == 1 and self._running[tiles[0]]:
            return  # a slow part still converts: do not wait for it or disturb it
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
            # A tile that is not known to be there may have missed a broadcast.
            self._running[i] = i in called and self.health[i].present

    def _worth_calling(self, tiles: Sequence[int]) -> tuple[int, ...]:
        """Tiles behind a mux that has a tile present: a broadcast names muxes, not tiles."""
        if all(self.health[i].present for i in tiles):
            return tuple(tiles)
        muxes = {self.tiles[i].mux for i in tiles if self.health[i].present}
        return tuple(i for i in tiles if self.tiles[i].mux in muxes)

    def close_ranks(self) -> None:
        """Wait until all tiles can be read and started again one right after the other.

        A tile that was read late once, because another one was asked twice, would stay late: its
        samples would drift away from those of the others.
        """
        due_ns = 0
        for i in self.indices:
            if self._running[i] and (self._waits_for_slow_ones or not self.health[i].slow):
                ready_ns = self._started_ns[i] + self._watch.wait_ns[i]
                due_ns = max(due_ns, ready_ns - self._turns_ns[i])
        self._clock.sleep_until_ns(due_ns)

    def collect(self, scan: Scan, tile: int) -> None:
        """Read the conversion of a tile as soon as it is finished."""
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

    # What becomes of a transfer

    def _attempt(self, scan: Scan, tiles: Sequence[int], transfers: Callable[[], None]) -> bool:
        """Run `transfers` for `tiles`, a second time if the frame's budget allows."""
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
        """Is there time left in this frame for more than one reading of a tile?

        Each tile in turn has a frame where the answer is always yes; else the first tiles would
        use up the time that the last ones need.
        """
        return scan.budget_ns > 0 or tile == self._frames % len(self.tiles)

    def _wait(self, scan: Scan, ready_ns: int) -> None:
        """Sleep until a conversion is finished, and do what is to be done at the sample instant."""
        if self._reference_n is not None and scan.reference_ns is None:
            scan.reference_ns = self._started_ns[0] + self.sample_delay_ns[0]
            self._clock.sleep_until_ns(scan.reference_ns)
            scan.reference_n = self._reference_n()
        self._clock.sleep_until_ns(ready_ns)
        self._busy_since_ns = self._clock.now_ns()  # waiting spends nothing

    # Frame by frame

    def _learn_turns(self) -> None:
        """How long after a frame's begin each tile has its turn, if nothing holds the frame up.

        Beside the wires' time that is the driver's own, in which a conversion goes on as well. It
        is believed little by little, where nothing was asked twice, and forgotten again: else a
        tile that was late once would be waited for as one that always is.
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
        """Now and then, at the end of a frame, check the muxes, and try a suspect's conversion."""
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
        except NoAcknowledgeError:  # the next frame will see who it is
            self._ports.router.forget()
        except BusFaultError:
            scan.note_bus_fault()

    def _look_again(self, scan: Scan, tiles: Sequence[int]) -> None:
        """Check one tile before the next start: were the words read from it its final result?"""
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
        """Judge from this frame whether tiles are stale and whether the bus works."""
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
