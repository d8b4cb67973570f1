"""Plays a story with real processes, and gathers the facts."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress

import httpx

from tests.faults.clock_step import HOUR_NS
from tests.faults.facts import Facts
from tests.faults.machines import Machine, RoundError, wait_for
from tests.faults.players import Players
from tests.faults.proxy import Quality
from tests.faults.stories import Fault
from tests.waiting import PATIENCE_S

_POINTS_OF_SEALING = 20
"""So many files and folders are synced or renamed, about, from stop to sealed."""


class Stage(Players):
    """Plays a story, fault by fault; made as `Players` are."""

    def play(self) -> list[Facts]:
        """All of the story, to the sealed session; nearly always one.

        Raises:
            RoundError: something that has to happen does not.
        """
        self.begin()
        for fault in self.story.faults:
            time.sleep(fault.after_s)
            self.note(f"{fault}")
            with self._timed(fault.kind):
                getattr(self, f"_{fault.kind}")(fault)
        if not self._stopped:
            time.sleep(self.story.in_the_end_s)
        return self.end()

    def begin(self) -> None:
        """Start everything and record.

        Raises:
            RoundError: it cannot be.
        """
        with self._timed("start"):
            self.server.start()
            self.node.start()
            self.server.wait_ready()
            self.wait_back()
        with self._timed("record"):
            self._start_session()

    def end(self) -> list[Facts]:
        """Stop if that has not been done, wait for the sealed session, and fetch it.

        Raises:
            RoundError: it cannot be.
        """
        if not self._stopped:
            with self._timed("stop"):
                self.stop()
        with self._timed("seal"):
            self._wait_sealed()
        with self._timed("fetch"):
            self._fetch()
        return [self.facts]

    # --- kills and power ----------------------------------------------------------------------

    def _kill_node(self, fault: Fault) -> None:
        self._go_down(fault.length_s, self.node)

    def _kill_node_parent(self, fault: Fault) -> None:
        stream_id = self._end_node("killed", self.node.kill_first)
        time.sleep(fault.length_s)
        self._start_again(stream_id, self.node)

    def _kill_server(self, fault: Fault) -> None:
        self._go_down(fault.length_s, self.server)

    def _kill_both(self, fault: Fault) -> None:
        self._go_down(fault.length_s, self.node, self.server)

    def _power_node(self, fault: Fault) -> None:
        self._go_down(fault.length_s, self.node, how="power")

    def _power_server(self, fault: Fault) -> None:
        self._go_down(fault.length_s, self.server, how="power")

    def _power_both(self, fault: Fault) -> None:
        self._go_down(fault.length_s, self.node, self.server, how="power")

    def _go_down(self, length_s: float, *machines: Machine, how: str = "killed") -> None:
        """Kill machines, or cut their power, and start them again after a while."""
        stream_id = None
        if self.node in machines:
            stream_id = self._end_node(how, self.node.kill)
        for machine in machines:
            machine.kill()
            if how == "power":
                self._cut(machine)
        time.sleep(length_s)
        self._start_again(stream_id, *machines)

    def _kill_acquisition(self, fault: Fault) -> None:
        children = self.node.children()
        if not children:
            raise RoundError("the node has no acquisition process to kill")
        stream_id = self._stream_id()
        os.kill(children[-1], signal.SIGKILL)

        def noticed() -> bool:
            return not self.node.is_alive or self._stream_id() != stream_id

        wait_for("the node notices that its acquisition is dead", noticed, PATIENCE_S)
        self._end_node("killed", lambda: None, only=stream_id)
        if not self.node.is_alive:
            self.node.kill()
            time.sleep(fault.length_s)
            self.node.start()
        self.wait_back(stream_id)

    def _restart_node_twice(self, fault: Fault) -> None:
        stream_id = self._end_node("killed", self.node.kill)
        self.node.start()
        time.sleep(0.3 + 2.5 * fault.amount)
        self._start_again(self._end_node("killed", self.node.kill) or stream_id, self.node)

    def _hold_up_node(self, fault: Fault) -> None:
        self.node.stop_for(fault.length_s)

    def _hold_up_server(self, fault: Fault) -> None:
        self.server.stop_for(fault.length_s)
        self.wait_back()

    # --- the link ---------------------------------------------------------------------------------

    def _cut_link(self, fault: Fault) -> None:
        self._lose_link(self.proxy.cut, fault)

    def _black_hole(self, fault: Fault) -> None:
        self._lose_link(self.proxy.black_hole, fault)

    def _lose_link(self, lose: Callable[[], None], fault: Fault) -> None:
        lose()
        time.sleep(fault.length_s)
        self.proxy.mend()
        self.wait_back()

    def _corrupt_link(self, fault: Fault) -> None:
        every = 2_000 + 60_000 * fault.amount
        self._bad_link(Quality(flip_every_bytes=every), 0.5 + fault.length_s)

    def _throttle_link(self, fault: Fault) -> None:
        # Four tiles at 200 Hz are some 25 kB/s.
        self._bad_link(Quality(bytes_per_s=5_000 + 45_000 * fault.amount), 0.5 + fault.length_s)

    def _delay_link(self, fault: Fault) -> None:
        quality = Quality(delay_s=0.2 * fault.amount, jitter_s=0.3 * fault.amount)
        self._bad_link(quality, 0.5 + fault.length_s)

    def _bad_link(self, quality: Quality, length_s: float) -> None:
        self.proxy.quality = quality
        time.sleep(length_s)
        self.proxy.quality = Quality()
        self.note(f"{self.proxy.flips} bits flipped so far")
        self.wait_back()

    # --- disks and clocks -------------------------------------------------------------------------

    def _slow_fsync(self, fault: Fault) -> None:
        """A slow card; half of the time its machine then loses power."""
        machine = self._rng.choice(self._machines())
        slow_s = 0.1 + fault.amount
        machine.slow.set_s(slow_s)
        if machine is self.node:
            self._slow_s = slow_s
            # Frames that come while one fsync runs wait for the next one, too.
            self._longest_wait_s = max(self._longest_wait_s, 2 * slow_s)
        time.sleep(1.0 + fault.length_s)
        if self._rng.random() < 0.5:
            self._go_down(0.0, machine, how="power")
        machine.slow.set_s(0.0)
        self._slow_s = 0.0

    def _clock_of_node(self, fault: Fault) -> None:
        self._step_clock(self.node, fault)
        if fault.amount > 0.5:
            self._kill_node(fault)

    def _clock_of_server(self, fault: Fault) -> None:
        self._step_clock(self.server, fault)
        if fault.amount > 0.5:
            self._kill_server(fault)

    def _step_clock(self, machine: Machine, fault: Fault) -> None:
        machine.clock.step_to(self._rng.choice((HOUR_NS, -HOUR_NS)))
        time.sleep(fault.length_s)

    def _full_disk(self, fault: Fault) -> None:
        """Of the machine whose disk is small in this story."""
        assert self._small is not None
        self._small.fill(leave_bytes=round(64e3 * fault.amount))
        time.sleep(1.0 + fault.length_s)
        self._small.free()
        if self.story.small_disk_of == "node":
            self._longest_wait_s = max(self._longest_wait_s, 1.0 + fault.length_s)
        time.sleep(1.0)  # it is noticed that there is room again

    _full_disk_of_server = _full_disk_of_node = _full_disk

    # --- at the end -------------------------------------------------------------------------------

    def _stop_while_away(self, fault: Fault) -> None:
        self.proxy.cut()
        time.sleep(fault.length_s)
        self.stop()
        time.sleep(0.2)
        self.proxy.mend()
        self.wait_back()

    def _stop_while_away_and_kill_node(self, fault: Fault) -> None:
        self.proxy.cut()
        time.sleep(fault.length_s)
        self.stop()
        time.sleep(0.2)
        stream_id = self._end_node("killed", self.node.kill)
        self.proxy.mend()
        self._start_again(stream_id, self.node)

    def _kill_while_sealing(self, fault: Fault) -> None:
        self._die_while_sealing(fault, self.server.kill)

    def _power_while_sealing(self, fault: Fault) -> None:
        self._die_while_sealing(fault, lambda: self._cut(self.server))

    def _die_while_sealing(self, fault: Fault, die: Callable[[], None]) -> None:
        number = 1 + int(fault.amount * _POINTS_OF_SEALING)
        when = self._rng.choice(("before", "after"))
        self.server.kill_at(f"fsync+replace@sessions/:{number}:{when}")
        with suppress(httpx.HTTPError):
            self.stop()
        with suppress(RoundError):  # sealing may make fewer calls than that
            wait_for("the server kills itself", lambda: not self.server.is_alive, 2.0)
        die()
        self._start_again(None, self.server)
        if self.server.get(f"/sessions/{self.session_id}")["state"] == "recording":
            self.note("the stop was not kept: stopped again")
            self.stop()
