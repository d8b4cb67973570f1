"""A tare between two steps is that of a dome that has recovered."""

from __future__ import annotations

from functools import partial

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.chips.pressure_chips import Compensation
from devices.frames import FrameBatch
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import TareFrames
from service.estimation.tare_recovery import remove_recovery
from tests.builders.arrays import COUNT_KPA, UNLOADED_KPA, make_array
from tests.builders.calibrations import make_calibration, make_effects, newton_tile
from tests.builders.frames import loaded_frames

RATE_HZ = 500
PARTS, TAUS_S = (0.05, 0.04), (0.06, 1.1)  # those of `make_effects`
INFO = make_array(1, models=("static", "rubber"))
CALIBRATION: Calibration = make_calibration(newton_tile("T01", effects=make_effects()))


def stepped(load_n: float, *, seed: int) -> FrameBatch:
    """Rest, a step of two seconds, and two seconds in the air, as a creeping dome reads them."""
    force_n = np.repeat([0.0, load_n, 0.0], [RATE_HZ, 2 * RATE_HZ, 2 * RATE_HZ])
    apparent_n = force_n.copy()
    for part, tau_s in zip(PARTS, TAUS_S, strict=True):
        crept_n = 0.0
        for i, now_n in enumerate(force_n):
            crept_n += (now_n - crept_n) * -np.expm1(-1.0 / (tau_s * RATE_HZ))
            apparent_n[i] -= part * (now_n - crept_n)
    noise_n = np.random.default_rng(seed).normal(0.0, 0.9, len(force_n))
    return loaded_frames((apparent_n + noise_n)[:, None])


def tare_of(frames: FrameBatch, since_s: float) -> tuple[Tare, TareFrames]:
    """The tare of a quarter second, so long after the step, as it is read."""
    removal = partial(
        remove_recovery, info=INFO, calibration=CALIBRATION, models=("static", "rubber")
    )
    seen = TareFrames(frames, Compensation(INFO.tiles), CALIBRATION, INFO.serials, removal)
    first = round((3.0 + since_s) * RATE_HZ)
    return seen.compute_tare(slice(first, first + RATE_HZ // 4), "unloaded"), seen


@given(load_n=st.floats(50.0, 140.0), since_s=st.floats(0.1, 1.5), seed=st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_between_two_steps_the_baseline_is_within_its_interval(
    load_n: float, since_s: float, seed: int
) -> None:
    frames = stepped(load_n, seed=seed)
    raw, seen = tare_of(frames, since_s)
    tare = seen.remove_recovery(raw)
    off_kpa = tare.baseline_kpa[0] - UNLOADED_KPA
    raw_kpa = raw.baseline_kpa[0] - UNLOADED_KPA
    assert abs(off_kpa) < 0.1 * raw_kpa + 3.0 * raw.baseline_sigma_kpa[0] + 0.05 * COUNT_KPA
    assert abs(off_kpa) < 4.0 * tare.baseline_sigma_kpa[0]
    assert tare.baseline_sigma_kpa[0] > raw.baseline_sigma_kpa[0]


def test_without_a_load_before_it_a_tare_stays() -> None:
    frames = stepped(0.0, seed=1)
    raw, seen = tare_of(frames, 0.5)
    tare = seen.remove_recovery(raw)
    assert abs(tare.baseline_kpa - raw.baseline_kpa) < raw.baseline_sigma_kpa
