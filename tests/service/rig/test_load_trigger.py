"""The lead of an emulated load ends when enough was read, not by the clock alone."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import VirtualClock
from devices.emulation.world import World
from devices.flags import TileFlag
from service.estimation.tare.unloaded_windows import FRAMES_MIN
from service.rig.rig import LEAD_TIMEOUT_NS, USABLE_FRAMES_MIN, LoadTrigger
from tests.builders.frames import make_frames
from tests.builders.scenes import make_scene

SECOND_NS = 1_000_000_000


def world_of(clock: VirtualClock) -> World:
    return World(make_scene(), clock, lead_s=1.0, begins_now=False)


def test_what_a_lead_reads_is_enough_to_tare_from() -> None:
    assert USABLE_FRAMES_MIN >= FRAMES_MIN


@given(period_s=st.floats(0.002, 0.35), batch=st.integers(1, 12))
def test_a_machine_however_late_reads_enough_before_the_load_comes(
    period_s: float, batch: int
) -> None:
    clock = VirtualClock(5 * SECOND_NS)
    lead = LoadTrigger(world_of(clock), 1.0)
    read, t_ns = 0, clock.now_ns()
    while t_ns < lead.end_ns:
        seq = np.arange(read, read + batch)
        t_mono_ns = t_ns + np.arange(1, batch + 1) * round(period_s * 1e9)
        read, t_ns = read + batch, int(t_mono_ns[-1])
        clock.sleep_until_ns(t_ns)
        lead.add_batch(make_frames(seq, 2, t_mono_ns=t_mono_ns))
    assert read >= USABLE_FRAMES_MIN


def test_a_quick_machine_waits_for_the_seconds_that_were_asked_for() -> None:
    clock = VirtualClock()
    lead = LoadTrigger(world_of(clock), 1.0)
    lead.add_batch(
        make_frames(np.arange(USABLE_FRAMES_MIN), 2, t_mono_ns=1 + np.arange(USABLE_FRAMES_MIN))
    )
    assert lead.end_ns == SECOND_NS


def test_without_a_lead_the_load_comes_at_once() -> None:
    clock = VirtualClock(7)
    assert LoadTrigger(world_of(clock), 0.0).end_ns == 7


def test_a_tile_that_gives_nothing_holds_the_load_back_for_a_while_only() -> None:
    clock = VirtualClock()
    lead = LoadTrigger(world_of(clock), 1.0)
    for seq in range(120):
        clock.sleep_until_ns((seq + 1) * SECOND_NS // 10)
        frame = make_frames(
            [seq], 2, t_mono_ns=[clock.now_ns()], tile_flags=[[0, TileFlag.NO_ANSWER]]
        )
        lead.add_batch(frame)
    assert LEAD_TIMEOUT_NS < lead.end_ns < LEAD_TIMEOUT_NS + 2 * SECOND_NS
