"""The LSL bridge, received by LSL's own inlets."""

from __future__ import annotations

import time

import numpy as np
import pylsl
import pytest

import foottile as client
from devices.flags import EstimateFlag
from service.bridges.follower import Event, LiveClock, Reporter
from service.bridges.lsl import TIME_BOUND, LslOutlet, limit_to_this_machine
from storage.schema import UNKNOWN_T_NS, map_flat_columns
from tests.service.bridges.readers import make_live_frames
from tests.service.fake_node import FakeNode, Play
from tests.service.process import Process, Start
from tests.service.running import Running
from tests.waiting import PATIENCE_S

limit_to_this_machine()


def open_inlet(name: str) -> pylsl.StreamInlet:
    (info,) = pylsl.resolve_byprop("name", name, timeout=PATIENCE_S)
    inlet = pylsl.StreamInlet(info, recover=False)
    inlet.open_stream(timeout=PATIENCE_S)
    return inlet


def pull(inlet: pylsl.StreamInlet, n: int) -> tuple[np.ndarray, np.ndarray]:
    """So many samples, and their instants by the clock of the inlet's machine."""
    rows, at_s = zip(*(inlet.pull_sample(timeout=PATIENCE_S) for _ in range(n)), strict=True)
    return np.array(rows), np.array(at_s) + inlet.time_correction(timeout=PATIENCE_S)


def test_samples_have_all_values_with_units_and_their_instant_within_the_stated_bound() -> None:
    outlet = LslOutlet(Reporter(pytest.fail))
    ahead_ns, now_ns = 7_000_000_000_123, time.monotonic_ns()
    clock = LiveClock()
    clock.add(now_ns - 3_000_000_000, ahead_ns + 400, 500)  # wrong by 400 ns, within its bound
    true_ns = now_ns - 1_000_000_000 + np.arange(40) * 2_000_000
    outlet.write_frames(make_live_frames((true_ns + ahead_ns)[:1], "law"), clock)
    inlet = open_inlet("law frames")
    info = inlet.info(timeout=PATIENCE_S)
    frames = make_live_frames(true_ns + ahead_ns, "law")
    outlet.write_frames(frames, clock)
    values, at_s = pull(inlet, 40)
    labels, units = info.get_channel_labels(), info.get_channel_units()
    assert labels is not None
    assert units is not None
    assert info.nominal_srate() == frames.info.nominal_rate_hz
    quantities = map_flat_columns(2)
    for label, unit, found in zip(labels[:-1], units, values.T, strict=False):
        assert unit == quantities[label].unit
        expected = frames.columns[label].astype(float)
        if label == "contact":
            expected[expected == 255] = np.nan
        np.testing.assert_array_equal(found, expected)
    assert labels[-1] == TIME_BOUND
    bound_s = values[:, -1]
    # The offset's bound, its drift of two seconds at 100 ppm, and the node's bound.
    assert (bound_s > 800e-9).all()
    assert (bound_s < 350e-6).all()
    correction_s = 20e-6  # of LSL itself, over loopback
    assert (np.abs(at_s - true_ns * 1e-9) <= bound_s + correction_s).all()
    outlet.close()


def test_a_frame_without_a_compared_clock_is_no_sample_and_that_is_said_once() -> None:
    said: list[str] = []
    outlet = LslOutlet(Reporter(said.append))
    unknown = make_live_frames(np.full(3, UNKNOWN_T_NS), "unmeasured")
    clock = LiveClock()
    outlet.write_frames(unknown, clock)
    clock.add(time.monotonic_ns(), 0, 1)
    outlet.write_frames(unknown, clock)
    assert len(said) == 1
    assert "clock of unmeasured" in said[0]
    outlet.close()


def test_a_marker_has_its_own_instant() -> None:
    outlet = LslOutlet(Reporter(pytest.fail))
    inlet = open_inlet("foottile markers")
    clock, now_ns = LiveClock(), time.monotonic_ns()
    clock.add(now_ns, 5_000_000_000, 1)
    outlet.write_event(Event("marker", "left", "s", "a “stone”", now_ns + 4_000_000_000), clock)
    outlet.write_event(Event("recording_started", "left", "s", "mud", now_ns), clock)
    label, at_s = inlet.pull_sample(timeout=PATIENCE_S)
    assert label == ["a “stone”"]
    assert inlet.pull_sample(timeout=PATIENCE_S)[0] == ["recording started: mud"]
    assert at_s == pytest.approx((now_ns - 1_000_000_000) * 1e-9, abs=1e-4)
    outlet.close()


@pytest.fixture
def bridge(running: Running, tared: FakeNode, foottile: Start) -> Process:
    bridge = foottile("bridge", "lsl", "--server", running.url)
    bridge.said("LSL")
    return bridge


@pytest.mark.process
def test_frames_of_a_node_are_samples_at_the_time_of_their_measurement(
    running: Running, tared: FakeNode, bridge: Process
) -> None:
    with Play(tared, [20.0, 160.0]):  # the other tile is beyond its calibrated range
        inlet = open_inlet("bench frames")
        labels = inlet.info(timeout=PATIENCE_S).get_channel_labels()
        values, at_s = pull(inlet, 100)
    channel = {label: values[:, number] for number, label in enumerate(labels or [])}
    sent = {int(seq): int(t) for b in tared.sent for seq, t in zip(b.seq, b.t_mono_ns, strict=True)}
    true_s = np.array([sent[int(seq)] for seq in channel["seq"]]) * 1e-9  # of this machine's clock
    assert (np.abs(at_s - true_s) <= channel[TIME_BOUND] + 20e-6).all()
    assert (channel[TIME_BOUND] < 1.0).all()  # a ping takes so long on a busy machine
    assert (channel["estimate_flags"].astype(int) & EstimateFlag.SATURATED).all()
    assert np.isnan(channel["grf_n"]).all()
    np.testing.assert_allclose(channel["force_n_0"], 20.0, rtol=0.01)
    with client.connect(running.url) as server, server.live("bench", from_seq=70) as live:
        rows = {row["seq"]: row for batch in [next(live)] for row in batch.to_pylist()}
    for index, seq in enumerate(channel["seq"]):
        if (row := rows.get(int(seq))) is not None:
            np.testing.assert_equal(channel["force_n_1"][index], row["force_n_1"])
