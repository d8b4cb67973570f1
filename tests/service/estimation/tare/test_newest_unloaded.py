"""A tare while the stream runs: the newest unloaded window, and none of a foot under load."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.chips.pressure_chips import Compensation
from devices.errors import TareError
from devices.frames import FrameBatch
from service.estimation.calibration import Calibration, make_paper_shape_preset
from service.estimation.tare.automatic import HISTORY_NS, WINDOW_NS, compute_newest_unloaded_tare
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import FRAMES_MIN, TareFrames
from tests.builders.arrays import COUNT_KPA, UNLOADED_KPA, make_array
from tests.builders.calibrations import make_calibration, make_tare, newton_tile
from tests.builders.frames import loaded_frames
from tests.service.estimation.tare.stretches import KINDS, RATE_HZ, draw_noise, draw_stretches

WINDOW = round(WINDOW_NS * 1e-9 * RATE_HZ)
MOVED = "moved or was loaded all the time"


def tare_newest(
    forces_n: np.ndarray | FrameBatch,
    *,
    present: Tare | None = None,
    calibration: Calibration | None = None,
    **on_rig: Any,
) -> Tare:
    """Tare these frames; on the rig every tile read 500 counts with one count of noise."""
    frames = loaded_frames(forces_n) if isinstance(forces_n, np.ndarray) else forces_n
    info = make_array(frames.tile_count)
    if calibration is None:
        calibration = make_calibration(*(newton_tile(s, **on_rig) for s in info.serials))
    recent = TareFrames(frames, Compensation(info.tiles), calibration, info.serials)
    return compute_newest_unloaded_tare(recent, present=present)


def present_tare(counts: float = 0.0) -> Tare:
    """Make an earlier tare, so many counts above 500."""
    baseline_kpa = UNLOADED_KPA + counts * COUNT_KPA
    return make_tare(
        2, baseline_kpa=baseline_kpa, baseline_sigma_kpa=0.01, noise_kpa=COUNT_KPA, t_ns=0
    )


KNOWN: dict[str, dict[str, Any]] = {
    "rig": {},
    "present tare": {"present": present_tare(), "baseline_kpa": None},
    "rig and present tare": {"present": present_tare()},
    "preset": {"calibration": make_paper_shape_preset()},
    "preset and present tare": {
        "calibration": make_paper_shape_preset(),
        "present": present_tare(),
    },
}
"""Options by the sources of an unloaded tile's pressure and noise."""


def assert_unloaded(tare: Tare) -> None:
    off_kpa = np.abs(tare.baseline_kpa - UNLOADED_KPA)
    assert (off_kpa < 6 * tare.baseline_sigma_kpa).all()


# --- found ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kpa_per_s", "is_quiet"), [(0.1, True), (1.0, False)])
def test_a_quiet_chip_is_quiet_while_its_rubber_recovers(kpa_per_s: float, is_quiet: bool) -> None:
    frames, info = loaded_frames(np.zeros((WINDOW, 2))), make_array(2)
    recent = TareFrames(frames, Compensation(info.tiles), make_calibration("T01"), info.serials)
    recent.kpa = UNLOADED_KPA - kpa_per_s * 1e-9 * recent.since_ns[:, None] * [1.0, 0.0]
    noise_kpa = np.full(2, 0.001)  # of a BMP581 on the rig
    assert bool(recent.select_quiet_windows([slice(0, WINDOW)], noise_kpa)) == is_quiet


def test_a_foot_in_the_air_is_tared_in_its_newest_window() -> None:
    frames = loaded_frames(draw_noise(2000))
    tare = tare_newest(frames)
    assert (tare.source, tare.t_ns, tare.frames) == ("unloaded", frames.t_ns[-1], WINDOW + 1)
    assert tare.end_s - tare.begin_s == pytest.approx(WINDOW_NS * 1e-9)
    rows = 500 - frames.pressure_raw[-tare.frames :].astype(np.float64)
    expected_kpa = UNLOADED_KPA + rows.mean(axis=0) * COUNT_KPA
    assert tare.baseline_kpa == pytest.approx(expected_kpa, abs=1e-9)


@settings(max_examples=40, deadline=None)
@given(
    kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=6),
    known=st.sampled_from(["rig", "present tare", "rig and present tare"]),
    seed=st.integers(0, 9),
)
def test_the_newest_unloaded_stretch_is_found(kinds: list[str], known: str, seed: int) -> None:
    forces_n = draw_stretches(kinds, seed)
    if "unloaded" not in kinds:
        with pytest.raises(TareError):
            tare_newest(forces_n, **KNOWN[known])
        return
    tare = tare_newest(forces_n, **KNOWN[known])
    newest = len(kinds) - 1 - kinds[::-1].index("unloaded")
    assert newest <= tare.begin_s < newest + 0.9 <= tare.end_s <= newest + 1
    assert_unloaded(tare)


def test_a_foot_that_stands_lightly_after_a_flight_is_tared_in_the_flight() -> None:
    # 11 counts on each tile, as light as a foot can stand.
    forces_n = draw_noise(3000)
    forces_n[500:] += 11.0
    forces_n[1000:1200] -= 11.0
    tare = tare_newest(forces_n)
    assert 2.0 <= tare.begin_s < tare.end_s <= 2.4
    assert_unloaded(tare)


def test_a_flight_of_a_third_of_a_second_is_enough() -> None:
    for begin in range(1000, 1040, 7):
        forces_n = draw_noise(2500, seed=begin) + 30.0
        forces_n[begin : begin + 165] -= 30.0
        assert_unloaded(tare_newest(forces_n))


def test_a_tare_does_not_depend_on_the_start_of_time() -> None:
    frames = loaded_frames(draw_stretches(["loaded", "unloaded", "loaded"]))
    later = replace(frames, t_ns=frames.t_ns + 10**15, t_mono_ns=frames.t_mono_ns + 10**15)
    one, two = tare_newest(frames), tare_newest(later)
    assert one.baseline_kpa.tobytes() == two.baseline_kpa.tobytes()
    assert two.t_ns - one.t_ns == 10**15
    assert HISTORY_NS >= 4 * WINDOW_NS


@pytest.mark.parametrize("known", ["preset", "preset and present tare"])
def test_a_preset_finds_the_lowest_window(known: str) -> None:
    tare = tare_newest(draw_stretches(["loaded", "unloaded", "moving"]), **KNOWN[known])
    assert 1.0 <= tare.begin_s < tare.end_s <= 2.0
    assert_unloaded(tare)


def test_a_tile_may_be_colder_than_at_the_present_tare_and_on_the_rig() -> None:
    tare = tare_newest(draw_noise(1000) - 60.0, present=present_tare())
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA - 60 * COUNT_KPA] * 2, abs=0.05)


@pytest.mark.parametrize(("period_ms", "seconds"), [(4, 0.25), (15, 0.375), (39, 0.975)])
def test_a_slow_array_has_a_longer_window(period_ms: int, seconds: float) -> None:
    t_mono_ns = 1_000_000 * period_ms * np.arange(400)
    tare = tare_newest(loaded_frames(draw_noise(400), t_mono_ns=t_mono_ns))
    assert tare.frames >= FRAMES_MIN
    assert tare.end_s - tare.begin_s == pytest.approx(seconds, abs=1e-3 * period_ms)


# --- refused --------------------------------------------------------------------------------------


@pytest.mark.parametrize("counts", [25.0, 100.0])
@pytest.mark.parametrize("known", ["rig", "present tare"])
def test_a_foot_under_load_is_refused_with_a_remedy(known: str, counts: float) -> None:
    # 3 kPa are 23.6 counts
    with pytest.raises(TareError, match=r"T0.*seems to be loaded") as caught:
        tare_newest(draw_noise(2000) + counts, **KNOWN[known])
    assert caught.value.remedy


@pytest.mark.parametrize("tile", [0, 1])
def test_a_tile_above_the_present_tare_is_refused_until_that_is_undone(tile: int) -> None:
    # 1.5 kPa are 11.8 counts
    forces_n = draw_noise(1000)
    forces_n[:, tile] += 11.0
    assert tare_newest(forces_n, present=present_tare()).source == "unloaded"
    forces_n[:, tile] += 1.6
    with pytest.raises(TareError, match=rf"T0{tile + 1} reads 1\.\d\d kPa more") as caught:
        tare_newest(forces_n, present=present_tare())
    assert "1.5 kPa" in caught.value.expected
    assert "undo the last tare" in caught.value.remedy
    assert tare_newest(forces_n).source == "unloaded"


@pytest.mark.parametrize("hertz", [2.0, 3.0, 8.0, 13.0, 40.0])
@pytest.mark.parametrize("known", KNOWN)
def test_a_moving_foot_is_refused(hertz: float, known: str) -> None:
    # With a preset alone only these frames show the noise of the tiles: steps of 40 N.
    top_n = 20.0 if known == "preset" else 10.0
    swing_n = top_n * (1.0 + np.sin(2 * np.pi * hertz * np.arange(3000) / RATE_HZ))
    with pytest.raises(TareError, match=MOVED) as caught:
        tare_newest(draw_noise(3000) + swing_n[:, None], **KNOWN[known])
    assert "Lift the foot" in caught.value.remedy


@pytest.mark.parametrize("newtons_per_second", [1.0, -1.0])
def test_a_slowly_moving_load_is_refused(newtons_per_second: float) -> None:
    # 0.63 kPa/s, 1.2 counts in a window: more than the mean of its halves can differ by chance
    forces_n = draw_noise(3000) + np.linspace(0.0, newtons_per_second * 60.0, 3000)[:, None]
    with pytest.raises(TareError, match=MOVED):
        tare_newest(forces_n, present=present_tare(100.0))


@pytest.mark.parametrize(("silent", "serials"), [([1], "T02"), ([0, 1], "T01, T02")])
def test_a_silent_tile_is_refused_by_serial(silent: list[int], serials: str) -> None:
    forces_n = draw_noise(1000)
    forces_n[:, silent] = np.nan
    with pytest.raises(TareError, match=f"tile {serials} gave no readings") as caught:
        tare_newest(forces_n)
    assert caught.value.remedy


def test_too_few_frames_are_refused() -> None:
    for n in (0, 1, FRAMES_MIN - 1, FRAMES_MIN, WINDOW - 1):
        with pytest.raises(TareError):
            tare_newest(draw_noise(n))
    assert tare_newest(draw_noise(WINDOW + 1)).frames == WINDOW + 1
    with pytest.raises(TareError):  # 16 frames a second
        tare_newest(loaded_frames(draw_noise(300), t_mono_ns=60_000_000 * np.arange(300)))


def test_tiles_that_are_unloaded_one_after_another_are_refused() -> None:
    forces_n = draw_noise(2000)
    forces_n[:1000, 0] += 8.0
    forces_n[1000:, 1] += 8.0
    with pytest.raises(TareError, match="no tile was unloaded while all others were") as caught:
        tare_newest(forces_n)
    assert "whole foot" in caught.value.remedy


def test_a_stuck_tile_is_refused_by_serial() -> None:
    forces_n = draw_noise(1000)
    forces_n[:, 1] = 0.0
    with pytest.raises(TareError, match=r"T02 gave 500 counts 126 times"):
        tare_newest(forces_n, present=present_tare())


def test_a_changing_temperature_is_refused_because_the_gas_lags() -> None:
    frames = loaded_frames(draw_noise(1000))
    fall = np.linspace(0.0, 10.0, 1000)[:, None].astype(np.uint16) * np.array([0, 1], np.uint16)
    moving = replace(frames, temperature_raw=frames.temperature_raw + fall)
    match = r"temperature of tile T02 has moved by \d\.\d K"
    with pytest.raises(TareError, match=match) as caught:
        tare_newest(moving, present=present_tare())
    assert "Wait" in caught.value.remedy
    assert tare_newest(frames, present=present_tare()).frames > 0
