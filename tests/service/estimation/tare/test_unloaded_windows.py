"""The tare of a recording: its interval, its figures, and refusals.

Chips read one count per 130/1023 kPa (see tests/builders), so baselines are worked out in counts.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.chips.pressure_chips import Compensation
from devices.errors import TareError
from devices.flags import FrameFlag, TileFlag
from devices.frames import FrameBatch
from service.estimation.calibration import Calibration, make_paper_shape_preset
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import (
    compute_nonempty_window_starts,
    compute_recording_tare,
)
from tests.builders.arrays import COUNT_KPA, DATA_SHEET_CHIP, UNLOADED_KPA, array_at, make_array
from tests.builders.calibrations import make_calibration, newton_tile
from tests.builders.frames import laid_out, loaded_frames
from tests.service.estimation.tare.stretches import KINDS, draw_stretches

PRESET = make_paper_shape_preset()
NOISE_KPA = 0.165
ROUNDING_KPA = COUNT_KPA / np.sqrt(12)


def tare_recording(
    forces_n: np.ndarray | FrameBatch,
    interval_s: tuple[float, float] | None = None,
    *,
    calibration: Calibration | None = None,
    **on_rig: Any,
) -> Tare:
    """Tare a recording; on the rig every tile read 500 counts with one count of noise.

    With a named interval it had hardly any noise, so that readings may be chosen at will.
    """
    frames = loaded_frames(forces_n) if isinstance(forces_n, np.ndarray) else forces_n
    info = make_array(frames.tile_count)
    if calibration is None:
        on_rig = ({} if interval_s is None else {"noise_kpa": 0.29 * COUNT_KPA}) | on_rig
        calibration = make_calibration(*(newton_tile(s, **on_rig) for s in info.serials))
    compensation = Compensation(info.tiles)
    return compute_recording_tare(
        frames, compensation, calibration, info.serials, interval_s=interval_s
    )


def draw_counts(n: int, tiles: int = 2, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, 1.0, (n, tiles))


# --- figures --------------------------------------------------------------------------------------


def test_baseline_and_noise_are_mean_and_deviation_of_the_interval() -> None:
    # 40 readings of 497 and 503 counts in turn: mean 500, deviation 3, times sqrt(40 / 39)
    tare = tare_recording(np.tile([[3.0, 3.0], [-3.0, -3.0]], (20, 1)), (0.0, 1.0))
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA] * 2, abs=1e-12)
    noise_kpa = 3 * COUNT_KPA * np.sqrt(40 / 39)
    assert tare.noise_kpa == pytest.approx([noise_kpa] * 2, rel=1e-12)
    assert tare.baseline_sigma_kpa == pytest.approx([noise_kpa / np.sqrt(40)] * 2, rel=1e-12)


def test_a_tare_describes_its_interval_and_uses_no_other_frame() -> None:
    # 500 frames/s; unloaded from 0.2 s (frame 100) to 0.4 s (frame 200), both ends included
    forces_n = np.full((500, 2), 20.0)
    forces_n[100:201] = 0.0
    frames = loaded_frames(forces_n, frame_flags=make_lead(500, 50))
    tare = tare_recording(frames, (0.2, 0.4))
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA] * 2, abs=1e-12)
    assert (tare.frames, tare.source, tare.t_ns) == (101, "interval", frames.t_ns[200])
    assert (tare.begin_s, tare.end_s) == pytest.approx((0.2, 0.4))


def test_a_constant_reading_has_the_noise_of_rounding() -> None:
    tare = tare_recording(np.zeros((100, 2)), (0.0, 1.0))
    assert tare.noise_kpa == pytest.approx([ROUNDING_KPA] * 2, rel=1e-12)
    assert tare.baseline_sigma_kpa == pytest.approx([ROUNDING_KPA / 10] * 2, rel=1e-12)


def test_a_temperature_is_the_mean_of_usable_readings() -> None:
    # Both tiles warm by two counts halfway; T02 was not readable before.
    temperature_raw = np.where(np.arange(100) < 50, 480, 478)[:, None]
    forces_n = draw_counts(100)
    forces_n[:50, 1] = np.nan
    tare = tare_recording(loaded_frames(forces_n, temperature_raw=temperature_raw), (0.0, 1.0))
    assert tare.temperature_raw_counts == pytest.approx([479.0, 478.0], abs=1e-12)


@pytest.mark.parametrize(
    ("force_n", "flag"),
    [
        *((400.0, flag) for flag in TileFlag if flag & TileFlag.UNUSABLE),
        # A file from elsewhere may have a null count and no flag.
        (np.nan, TileFlag(0)),
    ],
)
def test_an_unusable_reading_is_in_no_baseline(force_n: float, flag: TileFlag) -> None:
    forces_n, flags = np.zeros((100, 2)), np.zeros((100, 2))
    forces_n[::4, 1], flags[::4, 1] = force_n, flag
    tare = tare_recording(loaded_frames(forces_n, tile_flags=flags), (0.0, 1.0))
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA] * 2, abs=1e-12)
    assert tare.baseline_sigma_kpa[1] == pytest.approx(ROUNDING_KPA / np.sqrt(75))


def test_a_tile_that_is_silent_every_other_frame_has_the_noise_of_its_readings() -> None:
    # The data sheet's part: a count is 0.1255 kPa at temperature_raw 500, by its c12.
    info = array_at([(0.0, 0.0, -0.15)], chips=[DATA_SHEET_CHIP])
    frames = loaded_frames(np.tile([[1.0], [np.nan], [-1.0], [np.nan]], (50, 1)))
    calibration, chips = make_calibration("T01"), Compensation(info.tiles)
    tare = compute_recording_tare(frames, chips, calibration, info.serials, interval_s=(0.0, 1.0))
    count_kpa = (2.3758544921875 - 0.00079011917 * 480) * 65 / 1023
    assert tare.noise_kpa[0] == pytest.approx(count_kpa * np.sqrt(100 / 99), rel=1e-6)


@pytest.mark.parametrize("readable", [0, 19])
def test_a_tile_with_fewer_than_twenty_readings_is_refused_by_serial(readable: int) -> None:
    forces_n = np.zeros((200, 2))
    forces_n[readable:, 1] = np.nan
    with pytest.raises(TareError, match=rf"T02 has {readable} .*--tare-s"):
        tare_recording(forces_n, (0.0, 1.0))


@pytest.mark.parametrize("interval_s", [(0.0, 0.036), (5.0, 6.0), (-2.0, -1.0)])
def test_an_interval_with_fewer_than_twenty_frames_is_refused(
    interval_s: tuple[float, float],
) -> None:
    with pytest.raises(TareError, match="at least 20"):
        tare_recording(np.zeros((200, 2)), interval_s)
    assert tare_recording(np.zeros((200, 2)), (0.0, 0.038)).frames == 20


def test_a_tare_does_not_depend_on_the_memory_order() -> None:
    frames = loaded_frames(draw_counts(99, 5))
    one, two = (tare_recording(each, (0.0, 1.0)) for each in (frames, laid_out(frames, "fortran")))
    assert one.baseline_kpa.tobytes() == two.baseline_kpa.tobytes()
    assert one.noise_kpa.tobytes() == two.noise_kpa.tobytes()


# --- the lead -------------------------------------------------------------------------------------


def make_lead(n: int, first: int) -> np.ndarray:
    """Make frame flags with the lead bit in the `first` frames, among others without effect."""
    return np.where(np.arange(n) < first, FrameFlag.LEAD, 0) | FrameFlag.SERVO_STALE


def test_the_lead_is_the_tare_without_a_named_interval() -> None:
    forces_n = np.full((300, 2), 20.0)
    forces_n[:120] = 5.0 + np.tile([[1.0], [-1.0]], (60, 1))
    tare = tare_recording(loaded_frames(forces_n, frame_flags=make_lead(300, 120)))
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA + 5 * COUNT_KPA] * 2, abs=1e-12)
    assert (tare.source, tare.frames) == ("lead", 120)


def test_a_lead_in_the_middle_of_a_recording_is_none() -> None:
    # Of two joined recordings; their first minute alone must give the same tare.
    forces_n = draw_counts(1000)
    forces_n[300:500] += 30.0
    again = np.where((np.arange(1000) >= 300) & (np.arange(1000) < 500), FrameFlag.LEAD, 0)
    tare = tare_recording(loaded_frames(forces_n, frame_flags=make_lead(1000, 200) | again))
    assert (tare.source, tare.frames) == ("lead", 200)
    tare = tare_recording(loaded_frames(forces_n, frame_flags=again))
    assert (tare.source, tare.begin_s) == ("recognised", 0.0)


@pytest.mark.parametrize("readings", [20, 120])
def test_a_stuck_tile_is_refused_in_the_lead_and_in_a_named_interval(readings: int) -> None:
    forces_n = draw_counts(300)
    forces_n[:readings, 1] = 2.0
    forces_n[readings:120, 1] = np.nan
    frames = loaded_frames(forces_n, frame_flags=make_lead(300, 120))
    with pytest.raises(TareError, match=rf"T02 gave 498 counts {readings} times") as caught:
        tare_recording(frames)
    assert "plug" in caught.value.remedy
    with pytest.raises(TareError, match="T02 gave 498 counts"):
        tare_recording(frames, (0.0, 0.238), noise_kpa=NOISE_KPA)


def test_a_tile_that_is_stuck_for_half_of_the_interval_is_refused() -> None:
    forces_n = draw_counts(100)
    forces_n[10:70, 1] = 2.0
    with pytest.raises(TareError, match=r"T02 gave 498 counts \d+ times in a row, of 100"):
        tare_recording(forces_n, (0.0, 0.199), noise_kpa=NOISE_KPA)
    forces_n[20:60:3, 1] = 1.0
    assert tare_recording(forces_n, (0.0, 0.199), noise_kpa=NOISE_KPA).frames == 100


def test_a_tile_without_noise_on_the_rig_may_stand_still_in_the_lead() -> None:
    frames = loaded_frames(np.zeros((120, 2)), frame_flags=make_lead(120, 120))
    assert tare_recording(frames, noise_kpa=0.29 * COUNT_KPA).source == "lead"
    with pytest.raises(TareError, match="in a row"):
        tare_recording(frames, calibration=PRESET)


@pytest.mark.parametrize("source", ["interval", "lead"])
def test_a_loaded_tile_is_refused_in_the_lead_and_in_a_named_interval(source: str) -> None:
    # 3 kPa are 23.6 counts; far below the rig's baseline it may be, for a colder tile is.
    def tare(*counts: float) -> Tare:
        forces_n = np.tile(counts, (100, 1)) + np.tile([[1.0], [-1.0]], (50, 1))
        frames = loaded_frames(forces_n, frame_flags=make_lead(100, 100))
        return tare_recording(frames, (0.0, 0.1) if source == "interval" else None)

    assert tare(23.0, -60.0).source == source
    match = r"T02 reads 103\.0[56] kPa .*100\.00 kPa unloaded.*--tare-s"
    with pytest.raises(TareError, match=match):
        tare(0.0, 24.0)


def test_a_preset_tares_any_named_interval() -> None:
    assert tare_recording(60.0 + draw_counts(100), (0.0, 0.1), calibration=PRESET).frames > 0


# --- recognised -----------------------------------------------------------------------------------


def test_the_first_unloaded_half_second_is_recognised() -> None:
    # 2 s on the ground, then 1.5 s in flight
    forces_n = draw_counts(1750)
    forces_n[:1000] += 30.0
    tare = tare_recording(forces_n)
    assert (tare.source, tare.frames) == ("recognised", 250)
    assert (tare.begin_s, tare.end_s) == pytest.approx((2.0, 2.498))
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA] * 2, abs=3 * COUNT_KPA / 250**0.5)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from([*KINDS, "sucked at", "swinging"]), min_size=1, max_size=6))
def test_only_an_unloaded_stretch_is_recognised(kinds: list[str]) -> None:
    forces_n = draw_stretches(kinds, seed=len(kinds))
    if "unloaded" not in kinds:
        with pytest.raises(TareError, match=r"no interval can be recognised.*--tare-s"):
            tare_recording(forces_n)
        return
    tare = tare_recording(forces_n)
    first, last = int(tare.begin_s), int(tare.end_s - 1e-9)
    assert {kinds[first], kinds[last]} == {"unloaded"}
    assert first == kinds.index("unloaded")


def test_a_standing_leg_is_not_in_flight() -> None:
    # The paper's leg weighs 8.92 N (0.909 kg): 2.23 N on each of four tiles, which by eq. 2 at the
    # assumed scale is 1.41 kPa, 11 counts. It stands for two seconds, then is lifted for two.
    slope_n_per_kpa = PRESET.tiles[0].f_scale_n * 0.5702 / 15.0
    forces_n = draw_counts(2000, 4)
    forces_n[:1000] += 8.92 / 4 / slope_n_per_kpa / COUNT_KPA
    assert tare_recording(forces_n).baseline_kpa == pytest.approx([UNLOADED_KPA] * 4, abs=0.05)


def test_a_slowly_lowered_foot_is_not_unloaded() -> None:
    # From the first frame on, a newton a second on each tile, 0.63 kPa/s; flight only at the end.
    forces_n = draw_counts(1500)
    forces_n[:1000] += np.linspace(0.0, 2.0 * 0.63 / COUNT_KPA, 1000)[:, None]
    tare = tare_recording(forces_n)
    assert (np.abs(tare.baseline_kpa - UNLOADED_KPA) < 6 * tare.baseline_sigma_kpa).all()


@pytest.mark.parametrize("newtons_per_second", [1.0, -1.0])
def test_a_slowly_moving_load_is_refused(newtons_per_second: float) -> None:
    # Half a newton in a window is less than the noise of single readings.
    slope_n = np.linspace(0.0, newtons_per_second * 2.0 * 0.63 / COUNT_KPA, 1000)
    with pytest.raises(TareError, match="no interval can be recognised"):
        tare_recording(draw_counts(1000) + slope_n[:, None])


def test_an_interval_may_begin_at_every_quarter_of_a_second() -> None:
    forces_n = draw_counts(750) + 30.0
    forces_n[125:376] -= 30.0  # 0.25 to 0.75 s
    assert tare_recording(forces_n).begin_s == pytest.approx(0.25)


def test_a_tile_noisier_than_on_the_rig_is_not_at_rest() -> None:
    # one count on the rig; up to one and a half is at rest
    noise = draw_counts(500, seed=8)
    assert tare_recording(1.3 * noise).source == "recognised"
    with pytest.raises(TareError):
        tare_recording(noise * [1.0, 1.75])


def test_a_baseline_may_have_drifted_by_some_kelvin_since_the_rig() -> None:
    assert tare_recording(draw_counts(500), baseline_kpa=UNLOADED_KPA + 1.4).frames == 250
    with pytest.raises(TareError):
        tare_recording(draw_counts(500), baseline_kpa=UNLOADED_KPA + 1.6)


@pytest.mark.parametrize(
    ("calibration", "match"),
    [
        (PRESET, r"paper-eq2-shape .*--tare-s"),
        *(
            (
                make_calibration("T01", newton_tile("T02", **{missing: None})),
                "does not say where an unloaded tile lies",
            )
            for missing in ("baseline_kpa", "noise_kpa")
        ),
    ],
)
def test_no_interval_is_recognised_without_rig_baselines_of_all_tiles(
    calibration: Calibration, match: str
) -> None:
    with pytest.raises(TareError, match=match):
        tare_recording(draw_counts(500), calibration=calibration)


def test_a_recording_of_too_few_readings_is_refused() -> None:
    for n in (1, 2, 19):
        with pytest.raises(TareError, match="no interval can be recognised"):
            tare_recording(draw_counts(n))
    assert tare_recording(draw_counts(20)).frames == 20
    forces_n = draw_counts(60)
    forces_n[:, 1] = np.nan
    with pytest.raises(TareError):
        tare_recording(forces_n)


# --- windows --------------------------------------------------------------------------------------


@given(
    steps_ns=st.lists(st.integers(1, 400), min_size=1, max_size=30),
    begin_ns=st.integers(-500, 3000),
    step_ns=st.integers(1, 100),
    length_ns=st.integers(1, 400),
)
def test_window_starts_are_all_of_the_lattice_with_a_frame(
    steps_ns: list[int], begin_ns: int, step_ns: int, length_ns: int
) -> None:
    since_ns = np.cumsum([0, *steps_ns])
    lattice = np.arange(begin_ns % step_ns, since_ns[-1] + 1, step_ns)
    full = {at for at in lattice.tolist() if ((since_ns >= at) & (since_ns < at + length_ns)).any()}
    found = compute_nonempty_window_starts(since_ns, begin_ns, step_ns, length_ns).tolist()
    assert full <= set(found) <= set(lattice.tolist())


@pytest.mark.parametrize("gap_ns", [10**12, 10**18])
def test_a_step_of_the_clock_has_no_windows(gap_ns: int) -> None:
    since_ns = np.array([0, 10, 20, gap_ns, gap_ns + 10])
    assert len(compute_nonempty_window_starts(since_ns, 0, 5, 10)) < 20
