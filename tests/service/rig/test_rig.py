"""An emulated array on a real clock: what the machine does before the stream costs no lead."""

from __future__ import annotations

import time
from contextlib import ExitStack

import pytest

from devices.array.array import TileArray
from devices.frames import FrameStatus
from devices.scene.file import load_scene
from service.rig.emulated import EmulatedFoot
from service.rig.rig import Rig, RigOptions


@pytest.mark.slow
def test_a_machine_that_is_busy_during_the_trial_frames_does_not_use_up_the_lead(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A hundred trial frames took as long as the lead; no frame was marked, and nothing was tared.
    measured = Rig._bus_hz

    def slow(rig: Rig, array: TileArray) -> float:
        time.sleep(0.6)
        return measured(rig, array)

    monkeypatch.setattr(Rig, "_bus_hz", slow)
    with ExitStack() as stack:
        rig = Rig(RigOptions(load_scene("standing"), "busy", EmulatedFoot(lead_s=0.5)), stack)
        first = next(rig.batches(lambda: False))
    assert first.frame_status[0] & FrameStatus.LEAD
