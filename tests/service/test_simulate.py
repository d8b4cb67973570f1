"""A simulated session's servo, from the emulated shaft to the angle."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.frames import FrameStatus
from devices.scene import load_scene
from service.estimation.geometry import angle_rad
from service.simulate import SimulateOptions, Simulation


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
        options = SimulateOptions(scene=scene, seconds=1.0, lead_s=0.2, truth=True)
        simulation = Simulation(options, stack)
        ((frames, truth),) = simulation.pieces()
        info = simulation.info.servo
    assert info is not None
    known = (frames.frame_status & FrameStatus.SERVO_STALE) == 0
    assert known.sum() > 200
    error_rad = angle_rad(info, frames.servo_counts.astype(np.float64)) - truth["true_angle_rad"]
    # 0.13 rad/s for 13 ms at most, and half a count of 0.15 mrad
    assert np.abs(error_rad[known]).max() < 2.5e-3
    assert np.ptp(frames.servo_counts[known]) > 300, "it has turned"
