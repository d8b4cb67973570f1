"""An emulated array on a real clock: what the machine does before the stream costs no lead."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from devices.array.startup import ReadyArray
from devices.flags import FrameFlag
from devices.scene.scene_file import load_scene
from service.rig.emulated_foot import EmulatedFoot, PlateFiles, RigOptions
from service.rig.rig import Rig
from storage.formats.reference import ReferenceOptions, read_reference


@pytest.mark.slow
def test_a_machine_that_is_busy_during_the_trial_frames_does_not_use_up_the_lead(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A hundred trial frames took as long as the lead; no frame was marked, and nothing was tared.
    measured = Rig._estimate_max_rate_hz

    def slow(rig: Rig, ready: ReadyArray) -> float:
        time.sleep(0.6)
        return measured(rig, ready)

    monkeypatch.setattr(Rig, "_estimate_max_rate_hz", slow)
    with ExitStack() as stack:
        rig = Rig(RigOptions(load_scene("standing"), "busy", EmulatedFoot(lead_s=0.5)), stack)
        first = next(rig.acquire_batches(lambda: False))
    assert first.frame_flags[0] & FrameFlag.LEAD


@pytest.mark.slow
def test_a_stream_that_is_faster_than_its_bus_was_measured_to_be_goes_on_as_one_that_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        Rig, "_estimate_max_rate_hz", lambda rig, ready: 30.0
    )  # the start was that busy
    with ExitStack() as stack:
        rig = Rig(RigOptions(load_scene("standing"), "busy", EmulatedFoot(lead_s=0.2)), stack)
        first, stream_id = list(rig.acquire_batches(lambda: False)), rig.info.stream_id
        assert not first[-1].frame_flags[-1] & FrameFlag.LEAD, "a lead is never broken off"
        second = next(rig.acquire_batches(lambda: False))
    assert rig.info.nominal_rate_hz > 40.0
    assert rig.info.stream_id == stream_id
    assert second.seq[0] == 0
    assert second.t_mono_ns[0] > first[-1].t_mono_ns[-1]


@pytest.mark.slow
def test_plates_under_a_foot_in_real_time_write_when_it_is_closed_and_say_what_they_cannot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plates = PlateFiles(tmp_path / "plate.csv", tmp_path / "gone" / "plate.npz")
    foot = EmulatedFoot(lead_s=0.2, plates=plates)
    with ExitStack() as stack:
        rig = Rig(RigOptions(load_scene("standing"), "stands", foot), stack)
        end_ns = time.monotonic_ns() + 1_500_000_000
        for _ in rig.acquire_batches(lambda: time.monotonic_ns() > end_ns):
            pass
        assert not (tmp_path / "plate.csv").exists()
    force_n = read_reference(tmp_path / "plate.csv", ReferenceOptions({"grf_n": "fz_n"})).grf_n
    assert force_n[-1] == pytest.approx(40.0, abs=2.0), "it stands on the plate"
    assert str(tmp_path / "gone" / "plate.npz") in capsys.readouterr().err
