"""A force plate does to a load what its data say, and no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from devices.emulation import plates
from devices.emulation.parts import make_rng
from devices.emulation.plates import ForcePlate, PlateClock

Array = npt.NDArray[np.float64]
STEP = plates.RANGE / 2 ** (plates.BITS - 1)


def drawn(number: int = 0) -> ForcePlate:
    return ForcePlate.draw(make_rng(f"plate {number}"), make_rng(f"trial {number}"))


def ideal() -> ForcePlate:
    """One that mixes nothing and starts at once; what is left is noise, filter and converter."""
    return ForcePlate(PlateClock(1000.0, 0.0, 0.0), np.eye(6), np.zeros(6), np.zeros(6))


def constant(load: Array) -> object:
    return lambda t_s: np.tile(load, (len(t_s), 1))


def recorded(plate: ForcePlate, wrench: object, end_s: float = 4.0) -> tuple[Array, Array]:
    return plate.simulate_recording(wrench, end_s, make_rng("noise"))  # type: ignore[arg-type]  # a function, typed where it is made


@pytest.mark.parametrize("load", range(6))
def test_each_load_is_seen_in_every_channel_as_the_plate_mixes_it(load: int) -> None:
    plate = replace(drawn(), creep_per_s=np.zeros(6))
    wrench = np.zeros(6)
    wrench[load] = 0.4 * plates.RANGE[load]
    _, channels = recorded(plate, constant(wrench), 20.0)
    expected = plate.sensitivity @ wrench + plate.offset
    # Slow noise lasts 3 s: of 20 s its mean keeps about half of its deviation.
    assert channels.mean(axis=0) == pytest.approx(
        expected, abs=2 * plates.SLOW * plates.RANGE.max()
    )
    assert (np.abs(channels.mean(axis=0) - expected) < 2.0 * plates.SLOW * plates.RANGE).all()


def test_no_plate_mixes_more_than_its_data_sheet_allows() -> None:
    for number in range(50):
        mixing = drawn(number).sensitivity
        off = mixing - np.diag(np.diag(mixing))
        assert (np.abs(np.diag(mixing) - 1.0) <= plates.GAIN).all()
        assert (np.abs(off[:, 2][:2]) <= plates.CROSSTALK_OF_VERTICAL).all()
        assert (np.abs(off[:3, :2]) <= plates.CROSSTALK).all()
        assert (np.abs(off[3:, :3]) <= plates.LEVER_M).all()
        assert (off[:3, 3:] == 0.0).all(), "no force is made of a moment"


def test_noise_is_as_large_as_stated_and_partly_slow() -> None:
    _, channels = recorded(ideal(), constant(np.zeros(6)), 100.0)
    white = np.std(np.diff(channels, axis=0), axis=0) / np.sqrt(2.0)
    assert white == pytest.approx(np.hypot(plates.WHITE * plates.RANGE, STEP / 12**0.5), rel=0.02)
    of_seconds = channels.reshape(-1, 500, 6).mean(axis=1)
    # Six channels of some thirty times its memory each.
    slow = np.sqrt(((of_seconds / plates.RANGE) ** 2).mean())
    assert slow == pytest.approx(plates.SLOW, rel=0.3)


def test_every_reading_is_a_step_of_the_converter_and_none_is_beyond_its_end() -> None:
    _, channels = recorded(drawn(), constant(2.0 * plates.RANGE), 1.0)
    steps = channels / STEP
    assert steps == pytest.approx(np.rint(steps), abs=1e-6)
    assert (channels <= plates.RANGE).all()
    assert channels[-1, 2] == pytest.approx(plates.RANGE[2], abs=1.5 * STEP[2])


def test_a_ramp_is_shown_as_late_as_the_plate_says() -> None:
    plate = ideal()

    def ramp(t_s: Array) -> Array:
        return np.outer(100.0 * t_s, [0, 0, 1, 0, 0, 0])

    time_s, channels = recorded(plate, ramp, 2.0)
    behind_n = 100.0 * time_s - channels[:, 2]
    assert behind_n[200:1800].mean() == pytest.approx(100.0 * plate.delay_s, abs=0.03)


def test_a_step_rings_at_the_plates_own_frequency() -> None:
    plate = replace(ideal(), clock=PlateClock(8000.0, 0.0, 0.0))  # to see what 1 kHz cannot show

    def step(t_s: Array) -> Array:
        return np.outer(np.where(t_s >= 0.5, 100.0, 0.0), [0, 0, 1, 0, 0, 0])

    time_s, channels = recorded(plate, step, 1.0)
    ringing = channels[(time_s > 0.503) & (time_s < 0.52), 2] - 100.0
    crossings = np.flatnonzero(np.diff(np.sign(ringing)) > 0)
    hz = 8000.0 * (len(crossings) - 1) / (crossings[-1] - crossings[0])
    assert hz == pytest.approx(plates.NATURAL_HZ, rel=0.03)


def test_its_clock_starts_late_and_goes_as_fast_as_it_drifts() -> None:
    clock = PlateClock(1000.0, start_s=0.25, drift_ppm=100.0)
    time_s, t_s = clock.compute_sample_times(100.25)
    assert len(time_s) == 100_010
    assert t_s[0] == 0.25
    assert (time_s[-1] - (t_s[-1] - t_s[0])) / (t_s[-1] - t_s[0]) == pytest.approx(1e-4, rel=1e-3)
    assert t_s[-1] <= 100.25


def test_one_that_is_stopped_before_it_starts_has_seen_nothing() -> None:
    time_s, channels = recorded(drawn(), constant(np.ones(6)), 0.01)
    assert time_s.shape == (0,)
    assert channels.shape == (0, 6)
