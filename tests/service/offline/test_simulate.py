"""Simulated sessions: the servo, from the emulated shaft to the angle, and hops to their end."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.chips.compensation import Compensation
from devices.frames import FrameBatch, FrameStatus
from devices.scene.file import load_scene
from service.estimation.foot.geometry import rad_per_count
from service.offline.simulate import SimulateOptions, Simulation
from service.rig.emulated import EmulatedFoot


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
        options = SimulateOptions(
            scene=scene, seconds=1.0, truth=True, foot=EmulatedFoot(lead_s=0.2)
        )
        simulation = Simulation(options, stack)
        ((frames, truth),) = simulation.pieces()
        info = simulation.info.servo
    assert info is not None
    known = (frames.frame_status & FrameStatus.SERVO_STALE) == 0
    assert known.sum() > 200
    angle_rad = (frames.servo_counts - info.zero_counts) * rad_per_count(info)
    error_rad = angle_rad - truth["true_angle_rad"]
    # 0.13 rad/s for 13 ms at most, and half a count of 0.15 mrad
    assert np.abs(error_rad[known]).max() < 2.5e-3
    assert np.ptp(frames.servo_counts[known]) > 300, "it has turned"


@pytest.mark.parametrize("name", ["poppy", "mud"])
def test_three_hops_come_to_their_own_end_and_every_frame_has_its_truth(name: str) -> None:
    scene = load_scene(name)
    with ExitStack() as stack:
        simulation = Simulation(SimulateOptions(scene=scene, truth=True), stack)
        pieces = list(simulation.pieces())
        tiles = simulation.info.tiles
    frames = FrameBatch.concatenate([batch for batch, _ in pieces])
    truth = {key: np.concatenate([extra[key] for _, extra in pieces]) for key in pieces[0][1]}
    loaded = truth["true_grf_n"] > 0.5
    lead = (frames.frame_status & FrameStatus.LEAD) != 0
    assert not loaded[lead].any()
    landings = np.flatnonzero(loaded[1:] & ~loaded[:-1])
    assert len(landings) == 3
    last = int(np.flatnonzero(loaded)[-1])
    assert frames.t_ns[-1] - frames.t_ns[last] > 1_500_000_000, "in the air at the end"
    assert (frames.status == 0).all()
    assert truth["true_plate_n"].max() > truth["true_grf_n"].max()
    kpa = Compensation(tiles).readable_kpa(frames)
    if name == "mud":  # the bare tile: nothing in the air, up to 0.8 kPa of head in the mud
        deep_kpa = kpa[loaded, 4].mean() - kpa[lead, 4].mean()
        assert deep_kpa == pytest.approx(16.5 * 0.037, abs=0.08)
        assert abs(kpa[-500:, 4].mean() - kpa[lead, 4].mean()) < 0.05
