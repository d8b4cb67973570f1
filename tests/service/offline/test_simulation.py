"""Simulated sessions: the servo, from the emulated shaft to the angle, and hops to their end."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.chips.pressure_chips import Compensation
from devices.flags import FrameFlag
from devices.frames import NO_SERVO_COUNTS, FrameBatch
from devices.scene.emulation_sections import FaultSection
from devices.scene.scene_file import load_scene
from service.estimation.foot import compute_segment_rad_per_count
from service.offline.simulation import EmulatedRun, SimulationOptions
from service.rig.emulated_foot import EmulatedFoot


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(
    protocol=st.sampled_from([1, 2]),
    zero_counts=st.integers(-25_000, 25_000) | st.sampled_from([0, 4095]),
    sign=st.sampled_from([-1, 1]),
)
def test_any_turn_of_the_servo_reaches_frames_and_angle_unharmed(
    protocol: int, zero_counts: int, sign: int
) -> None:
    rolling = load_scene("rolling")
    assert rolling.servo is not None
    servo = rolling.servo.model_copy(
        update={"protocol": protocol, "zero_counts": zero_counts, "sign": sign}
    )
    scene = rolling.model_copy(update={"servo": servo})
    with ExitStack() as stack:
        options = SimulationOptions(
            scene=scene, seconds=1.0, with_truth=True, foot=EmulatedFoot(lead_s=0.2)
        )
        simulation = EmulatedRun(options, stack)
        ((frames, truth),) = simulation.run_frames()
        info = simulation.info.servo
    assert info is not None
    known = (frames.frame_flags & FrameFlag.SERVO_STALE) == 0
    assert known.sum() > 200
    angle_rad = (frames.servo_counts - info.zero_counts) * compute_segment_rad_per_count(info)
    error_rad = angle_rad - truth["true_angle_rad"]
    # 0.13 rad/s for 13 ms at most, and half a count of 0.15 mrad
    assert np.abs(error_rad[known]).max() < 2.5e-3
    assert np.ptp(frames.servo_counts[known]) > 300, "it has turned"


def test_a_servo_that_goes_away_and_one_that_restarts_are_in_the_frames() -> None:
    rolling = load_scene("rolling")
    assert rolling.servo is not None
    faults = (
        FaultSection(kind="servo_unplugged", t_s=0.5, duration_s=0.3),
        FaultSection(kind="servo_restart", t_s=2.5, duration_s=0.3),
    )
    # Beyond its turn, so that the restart leaves no angle.
    servo = rolling.servo.model_copy(update={"zero_counts": 9000})
    scene = rolling.model_copy(update={"servo": servo, "fault": faults})
    with ExitStack() as stack:
        options = SimulationOptions(scene=scene, seconds=3.5, foot=EmulatedFoot(lead_s=0.2))
        simulation = EmulatedRun(options, stack)
        frames = FrameBatch.concatenate([batch for batch, _ in simulation.run_frames()])
    t_s = (frames.t_mono_ns - frames.t_mono_ns[0]) * 1e-9
    stale = (frames.frame_flags & FrameFlag.SERVO_STALE) != 0
    turnless = (frames.frame_flags & FrameFlag.SERVO_TURN_UNKNOWN) != 0

    def within(begin_s: float, end_s: float) -> np.ndarray:
        return np.asarray((t_s > begin_s) & (t_s < end_s))

    away, back, restarted = within(0.55, 1.4), within(1.7, 2.4), within(3.1, 3.5)
    assert stale[away].all()
    assert (frames.servo_counts[away] == NO_SERVO_COUNTS).all()
    assert not (stale | turnless)[back].any()
    assert turnless[restarted].all()
    assert (np.abs(frames.servo_counts[restarted]) < 4096).all(), "it counts anew"


@pytest.mark.parametrize("name", ["poppy", "mud"])
def test_three_hops_come_to_their_own_end_and_every_frame_has_its_truth(name: str) -> None:
    scene = load_scene(name)
    with ExitStack() as stack:
        simulation = EmulatedRun(SimulationOptions(scene=scene, with_truth=True), stack)
        pieces = list(simulation.run_frames())
        tiles = simulation.info.tiles
    frames = FrameBatch.concatenate([batch for batch, _ in pieces])
    truth = {key: np.concatenate([extra[key] for _, extra in pieces]) for key in pieces[0][1]}
    loaded = truth["true_grf_n"] > 0.5
    lead = (frames.frame_flags & FrameFlag.LEAD) != 0
    assert not loaded[lead].any()
    landings = np.flatnonzero(loaded[1:] & ~loaded[:-1])
    assert len(landings) == 3
    last = int(np.flatnonzero(loaded)[-1])
    assert frames.t_ns[-1] - frames.t_ns[last] > 1_500_000_000, "in the air at the end"
    assert (frames.tile_flags == 0).all()
    assert truth["true_plate_n"].max() > truth["true_grf_n"].max()
    kpa = Compensation(tiles).compute_usable_kpa(frames)
    if name == "mud":  # the bare tile: nothing in the air, up to 0.8 kPa of head in the mud
        deep_kpa = kpa[loaded, 4].mean() - kpa[lead, 4].mean()
        assert deep_kpa == pytest.approx(16.5 * 0.037, abs=0.08)
        assert abs(kpa[-500:, 4].mean() - kpa[lead, 4].mean()) < 0.05
