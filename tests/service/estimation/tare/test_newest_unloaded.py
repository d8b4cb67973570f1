"""A tare while the stream runs: the newest unloaded window, and none from a foot that presses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.chips.compensation import Compensation
from devices.errors import TareError
from devices.frames import FrameBatch
from service.estimation.calibration import Calibration, make_paper_shape_preset
from service.estimation.tare.automatic import HISTORY_NS, WINDOW_NS, compute_newest_unloaded_tare
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import FRAMES_MIN, TareFrames
from tests.builders.arrays import COUNT_KPA, UNLOADED_KPA, make_array
from tests.builders.calibrations import make_calibration, make_tare, newton_tile
from tests.builders.frames import loaded_frames

RATE_HZ = 500
WINDOW = round(WINDOW_NS * 1e-9 * RATE_HZ)
MOVED = "moved or was loaded all the time"


def flight_of(
    frames: FrameBatch,
    *,
    present: Tare | None = None,
    calibration: Calibration | None = None,
    **bench: Any,
) -> Tare:
    """The tare in flight; the bench saw every tile at 500 counts with one count of noise."""
    info = make_array(frames.tile_count)
    if calibration is None:
        calibration = make_calibration(*(newton_tile(s, **bench) for s in info.serials))
    seen = TareFrames(frames, Compensation(info.tiles), calibration, info.serials)
    return compute_newest_unloaded_tare(seen, present=present)


def present(counts: float = 0.0, *, tiles: int = 2, noise_counts: float = 1.0) -> Tare:
    """A tare of an earlier time, so many counts above 500."""
    return make_tare(
        tiles,
        baseline_kpa=UNLOADED_KPA + counts * COUNT_KPA,
        baseline_sigma_kpa=0.01,
        noise_kpa=noise_counts * COUNT_KPA,
        t_ns=0,
        source="lead",
    )


def noise(n: int, tiles: int = 2, seed: int = 0) -> np.ndarray:
    """About one count with the rounding, as the bench saw it."""
    return np.random.default_rng(seed).normal(0.0, 0.9, (n, tiles))


def stretches(kinds: Sequence[str], seed: int = 0) -> np.ndarray:
    """Forces on two tiles, one second each."""
    forces_n = noise(RATE_HZ * len(kinds), seed=seed)
    t_s = np.arange(RATE_HZ) / RATE_HZ
    for i, kind in enumerate(kinds):
        second = forces_n[i * RATE_HZ : (i + 1) * RATE_HZ]
        if kind == "pressed":
            second += 40.0
        elif kind == "one pressed":
            second[:, 1] += 25.0  # 3.2 kPa
        elif kind == "moving":
            second[:, 0] += 15.0 * np.abs(np.sin(2 * np.pi * 3.0 * t_s)) + 3.0
        elif kind == "silent":
            second[::20, 1] = np.nan
    return forces_n


def assert_unloaded(tare: Tare) -> None:
    off_kpa = np.abs(tare.baseline_kpa - UNLOADED_KPA)
    assert (off_kpa < 6 * tare.baseline_sigma_kpa).all()


# --- what is found --------------------------------------------------------------------------------


def test_the_newest_window_of_a_foot_in_the_air_is_taken() -> None:
    frames = loaded_frames(noise(2000))
    tare = flight_of(frames)
    assert tare.source == "unloaded"
    assert tare.t_ns == frames.t_ns[-1]
    assert tare.frames == WINDOW + 1
    assert tare.end_s - tare.begin_s == pytest.approx(WINDOW_NS * 1e-9)
    rows = 500 - frames.pressure_raw[-tare.frames :].astype(np.float64)
    expected_kpa = UNLOADED_KPA + rows.mean(axis=0) * COUNT_KPA
    assert tare.baseline_kpa == pytest.approx(expected_kpa, abs=1e-9)


@settings(max_examples=40, deadline=None)
@given(
    kinds=st.lists(
        st.sampled_from(["unloaded", "pressed", "one pressed", "moving", "silent"]),
        min_size=1,
        max_size=6,
    ),
    known=st.sampled_from(["bench", "present", "both"]),
    seed=st.integers(0, 9),
)
def test_of_all_stretches_the_newest_unloaded_one_is_taken(
    kinds: list[str], known: str, seed: int
) -> None:
    frames = loaded_frames(stretches(kinds, seed))
    options: dict[str, Any] = {"present": None if known == "bench" else present()}
    if known == "present":
        options["baseline_kpa"] = None
    if "unloaded" not in kinds:
        with pytest.raises(TareError):
            flight_of(frames, **options)
        return
    tare = flight_of(frames, **options)
    newest = len(kinds) - 1 - kinds[::-1].index("unloaded")
    assert newest <= tare.begin_s < tare.end_s <= newest + 1
    assert tare.end_s >= newest + 0.9  # of that stretch, the end
    assert_unloaded(tare)


def test_a_foot_that_stands_still_after_a_flight_gives_the_flight() -> None:
    # As light as a foot can stand: 11 counts on each tile; 4 s later somebody presses the button.
    forces_n = noise(3000)
    forces_n[500:] += 11.0
    forces_n[1000:1200] -= 11.0
    tare = flight_of(loaded_frames(forces_n))
    assert 2.0 <= tare.begin_s < tare.end_s <= 2.4
    assert_unloaded(tare)


def test_a_flight_of_a_third_of_a_second_is_enough() -> None:
    for begin in range(1000, 1040, 7):
        forces_n = noise(2500, seed=begin) + 30.0
        forces_n[begin : begin + 165] -= 30.0
        assert_unloaded(flight_of(loaded_frames(forces_n)))


def test_where_the_frames_begin_in_time_does_not_matter() -> None:
    frames = loaded_frames(stretches(["pressed", "unloaded", "pressed"]))
    later = replace(frames, t_ns=frames.t_ns + 10**15, t_mono_ns=frames.t_mono_ns + 10**15)
    one, two = flight_of(frames), flight_of(later)
    assert one.baseline_kpa.tobytes() == two.baseline_kpa.tobytes()
    assert two.t_ns - one.t_ns == 10**15
    assert HISTORY_NS >= 4 * WINDOW_NS


def test_a_preset_without_a_bench_takes_what_is_lowest() -> None:
    frames = loaded_frames(stretches(["pressed", "unloaded", "moving"]))
    for before in (None, present()):
        tare = flight_of(frames, calibration=make_paper_shape_preset(), present=before)
        assert 1.0 <= tare.begin_s < tare.end_s <= 2.0
        assert_unloaded(tare)


def test_a_tile_may_be_colder_than_at_the_last_tare_and_on_the_bench() -> None:
    tare = flight_of(loaded_frames(noise(1000) - 60.0), present=present())
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA - 60 * COUNT_KPA] * 2, abs=0.05)


# --- refused --------------------------------------------------------------------------------------


@pytest.mark.parametrize("counts", [25.0, 100.0])
@pytest.mark.parametrize("known", ["bench", "present"])
def test_a_foot_that_is_loaded_all_the_time_is_refused_with_a_remedy(
    known: str, counts: float
) -> None:
    # 3 kPa are 23.6 counts
    options: dict[str, Any] = {} if known == "bench" else {"baseline_kpa": None}
    before = None if known == "bench" else present()
    with pytest.raises(TareError, match="seems to be loaded") as caught:
        flight_of(loaded_frames(noise(2000) + counts), present=before, **options)
    assert "T0" in str(caught.value)
    assert caught.value.remedy


@pytest.mark.parametrize("tile", [0, 1])
def test_a_tile_above_the_present_tare_is_refused_by_name_and_the_tare_can_be_undone(
    tile: int,
) -> None:
    # 1.5 kPa are 11.8 counts
    for counts, taken in ((11.0, True), (12.6, False)):
        forces_n = noise(1000)
        forces_n[:, tile] += counts
        frames = loaded_frames(forces_n)
        if taken:
            assert flight_of(frames, present=present()).source == "unloaded"
            continue
        with pytest.raises(TareError, match=rf"T0{tile + 1} reads 1\.\d\d kPa more") as caught:
            flight_of(frames, present=present())
        assert "1.5 kPa" in caught.value.expected
        assert "undo the last tare" in caught.value.remedy
        assert flight_of(frames).source == "unloaded"  # once it is undone


@pytest.mark.parametrize("hertz", [2.0, 3.0, 8.0, 13.0, 40.0])
@pytest.mark.parametrize("known", ["bench", "present", "preset and present"])
def test_a_foot_that_moves_all_the_time_is_refused(hertz: float, known: str) -> None:
    t_s = np.arange(3000) / RATE_HZ
    frames = loaded_frames(noise(3000) + (10.0 * np.sin(2 * np.pi * hertz * t_s))[:, None])
    options: dict[str, Any] = {"present": None if known == "bench" else present()}
    if known == "preset and present":
        options["calibration"] = make_paper_shape_preset()
    with pytest.raises(TareError, match=MOVED) as caught:
        flight_of(frames, **options)
    assert "Lift the foot" in caught.value.remedy


@pytest.mark.parametrize("hertz", [2.0, 3.0, 8.0, 13.0, 40.0])
def test_with_a_preset_and_without_a_tare_a_foot_that_moves_is_refused_too(hertz: float) -> None:
    # Steps of 40 N: nothing is known of the tiles but these frames, and they never rest.
    t_s = np.arange(3000) / RATE_HZ
    frames = loaded_frames(noise(3000) + (20.0 + 20.0 * np.sin(2 * np.pi * hertz * t_s))[:, None])
    with pytest.raises(TareError, match=MOVED):
        flight_of(frames, calibration=make_paper_shape_preset())


@pytest.mark.parametrize("newtons_per_second", [1.0, -1.0])
def test_a_load_that_moves_slowly_all_the_time_is_refused(newtons_per_second: float) -> None:
    # 0.63 kPa/s, 1.2 counts in a window: more than the mean of its halves can differ by chance
    forces_n = noise(3000) + np.linspace(0.0, newtons_per_second * 60.0, 3000)[:, None]
    with pytest.raises(TareError, match=MOVED):
        flight_of(loaded_frames(forces_n), present=present(100.0))


@pytest.mark.parametrize("silent", [(0,), (1,), (0, 1)])
def test_a_tile_without_readings_is_refused_by_name(silent: tuple[int, ...]) -> None:
    forces_n = noise(1000)
    forces_n[:, list(silent)] = np.nan
    named = ", ".join(f"T0{i + 1}" for i in silent)
    with pytest.raises(TareError, match=f"tile {named} gave no readings") as caught:
        flight_of(loaded_frames(forces_n))
    assert caught.value.remedy


def test_windows_in_which_a_tile_was_silent_do_not_count() -> None:
    forces_n = noise(2000)
    forces_n[1000:, 1] = np.nan
    assert flight_of(loaded_frames(forces_n)).end_s <= 2.0


def test_no_frames_or_too_few_are_refused() -> None:
    for n in (0, 1, FRAMES_MIN - 1, FRAMES_MIN, WINDOW - 1):
        with pytest.raises(TareError):
            flight_of(loaded_frames(noise(n)))
    assert flight_of(loaded_frames(noise(WINDOW + 1))).frames == WINDOW + 1


@pytest.mark.parametrize(("period_ms", "seconds"), [(4, 0.25), (15, 0.375), (39, 0.975)])
def test_a_slow_array_has_a_longer_window(period_ms: int, seconds: float) -> None:
    n = 400
    tare = flight_of(loaded_frames(noise(n), t_mono_ns=1_000_000 * period_ms * np.arange(n)))
    assert tare.frames >= FRAMES_MIN
    assert tare.end_s - tare.begin_s == pytest.approx(seconds, abs=1e-3 * period_ms)


def test_frames_far_apart_are_too_few_for_a_window() -> None:
    n = 300
    slow = loaded_frames(noise(n), t_mono_ns=60_000_000 * np.arange(n))  # 16 frames a second
    with pytest.raises(TareError):
        flight_of(slow)


def test_when_never_all_tiles_are_unloaded_at_once_it_is_refused() -> None:
    forces_n = noise(2000)
    forces_n[:1000, 0] += 8.0
    forces_n[1000:, 1] += 8.0
    with pytest.raises(TareError, match="no tile was unloaded while all others were") as caught:
        flight_of(loaded_frames(forces_n))
    assert "whole foot" in caught.value.remedy


def test_a_tile_that_hangs_is_refused_by_name() -> None:
    forces_n = noise(1000)
    forces_n[:, 1] = 0.0
    with pytest.raises(TareError, match=r"T02 gave 500 counts 126 times"):
        flight_of(loaded_frames(forces_n), present=present())


def test_while_the_temperature_moves_there_is_no_tare_because_the_gas_is_behind() -> None:
    frames = loaded_frames(noise(1000))
    fall = np.linspace(0.0, 10.0, 1000)[:, None].astype(np.uint16)
    moving = replace(
        frames, temperature_raw=frames.temperature_raw + fall * np.array([0, 1], dtype=np.uint16)
    )
    with pytest.raises(TareError, match=r"temperature of tile T02 has moved by \d+ counts") as one:
        flight_of(moving, present=present())
    assert "Wait" in one.value.remedy
    assert flight_of(frames, present=present()).frames > 0
