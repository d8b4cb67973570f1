"""The tare: which interval is taken, what is computed from it, and when there is none.

Chips read one count per 130/1023 kPa (see tests/builders), so baselines are worked out in counts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.chips.compensation import Compensation
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
from tests.builders.frames import loaded_frames

PAIR = [(0.0, 0.0, -0.15), (0.014, 0.0, -0.15)]
NOISE_KPA = 0.165
QUIET_KPA = 0.29 * COUNT_KPA  # of a part that shows no noise but rounding


def tare_of(
    frames: FrameBatch,
    interval_s: tuple[float, float] | None = None,
    *,
    calibration: Calibration | None = None,
    **bench: Any,
) -> Tare:
    """The tare of frames; the bench saw every tile at 500 counts with one count of noise.

    With a named interval it saw hardly any, so that readings may be chosen at will.
    """
    info = make_array(frames.tile_count)
    if calibration is None:
        bench = ({"noise_kpa": QUIET_KPA} if interval_s is not None else {}) | bench
        calibration = make_calibration(*(newton_tile(s, **bench) for s in info.serials))
    return compute_recording_tare(
        frames, Compensation(info.tiles), calibration, info.serials, interval_s=interval_s
    )


def noise_counts(n: int, tiles: int, seed: int = 0) -> np.ndarray:
    """Rounded noise of about one count."""
    return np.random.default_rng(seed).normal(0.0, 1.0, (n, tiles))


# --- what is computed -----------------------------------------------------------------------------


def test_baseline_and_noise_are_mean_and_standard_deviation_of_the_interval() -> None:
    # 40 readings of 497 and 503 counts in turn: mean 500, deviation 3, times sqrt(40 / 39)
    frames = loaded_frames(np.tile([[3.0, 3.0], [-3.0, -3.0]], (20, 1)))
    tare = tare_of(frames, (0.0, 1.0))
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA] * 2, abs=1e-12)
    noise_kpa = 3 * COUNT_KPA * np.sqrt(40 / 39)
    assert tare.noise_kpa == pytest.approx([noise_kpa] * 2, rel=1e-12)
    assert tare.baseline_sigma_kpa == pytest.approx([noise_kpa / np.sqrt(40)] * 2, rel=1e-12)


def test_only_the_interval_counts_and_it_is_described() -> None:
    # 500 frames/s; unloaded from 0.2 s (frame 100) to 0.4 s (frame 200), both ends included
    forces_n = np.full((500, 2), 20.0)
    forces_n[100:201] = 0.0
    frames = loaded_frames(forces_n)
    tare = tare_of(frames, (0.2, 0.4))
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA] * 2, abs=1e-12)
    assert (tare.frames, tare.source) == (101, "interval")
    assert (tare.begin_s, tare.end_s) == pytest.approx((0.2, 0.4))
    assert tare.t_ns == frames.t_ns[200]


def test_a_reading_that_never_moves_still_has_the_noise_of_rounding() -> None:
    tare = tare_of(loaded_frames(np.zeros((100, 2))), (0.0, 1.0))
    assert tare.noise_kpa == pytest.approx([COUNT_KPA / np.sqrt(12)] * 2, rel=1e-12)
    assert tare.baseline_sigma_kpa == pytest.approx([COUNT_KPA / np.sqrt(1200)] * 2, rel=1e-12)


def test_the_temperature_is_the_mean_of_the_readings_that_count() -> None:
    # T01 warms by two counts halfway; T02 does so too, but was not readable before
    temperature_raw = np.full((100, 2), 480)
    temperature_raw[50:] = 478
    forces_n = noise_counts(100, 2)
    forces_n[:50, 1] = np.nan
    tare = tare_of(loaded_frames(forces_n, temperature_raw=temperature_raw), (0.0, 1.0))
    assert tare.temperature_raw_counts == pytest.approx([479.0, 478.0], abs=1e-12)


@pytest.mark.parametrize(
    "bit",
    [TileFlag.NO_ANSWER, TileFlag.STALE, TileFlag.IMPLAUSIBLE, TileFlag.NOT_CONVERTED],
)
def test_readings_of_a_faulty_tile_are_left_out(bit: TileFlag) -> None:
    forces_n, status = np.zeros((100, 2)), np.zeros((100, 2))
    forces_n[::4, 1], status[::4, 1] = 400.0, bit
    tare = tare_of(loaded_frames(forces_n, tile_flags=status), (0.0, 1.0))
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA] * 2, abs=1e-12)
    assert tare.baseline_sigma_kpa[1] == pytest.approx(COUNT_KPA / np.sqrt(12 * 75))


def test_counts_that_were_not_read_are_left_out_whatever_their_status_says() -> None:
    # A file from elsewhere may have a null count and no flag; the estimate calls such a tile
    # missing, so it must not be in the baseline either.
    forces_n = np.zeros((100, 2))
    forces_n[::4, 1] = np.nan
    frames = loaded_frames(forces_n)
    tare = tare_of(replace(frames, tile_flags=np.zeros_like(frames.tile_flags)), (0.0, 1.0))
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA] * 2, abs=1e-12)


def test_a_tile_that_is_silent_half_of_the_time_has_the_noise_of_its_other_half() -> None:
    # The data sheet's part: a count is 0.1255 kPa at temperature_raw 500; c12 makes it depend on
    # temperature_raw.
    info = array_at(PAIR[:1], chips=[DATA_SHEET_CHIP])
    forces_n = np.tile([[1.0], [np.nan], [-1.0], [np.nan]], (50, 1))
    tare = compute_recording_tare(
        loaded_frames(forces_n),
        Compensation(info.tiles),
        make_calibration(newton_tile("T01")),
        info.serials,
        interval_s=(0.0, 1.0),
    )
    count_kpa = (2.3758544921875 - 0.00079011917 * 480) * 65 / 1023
    assert tare.noise_kpa[0] == pytest.approx(count_kpa * np.sqrt(100 / 99), rel=1e-6)


@pytest.mark.parametrize("readable", [0, 19])
def test_fewer_than_twenty_readings_of_a_tile_are_refused_with_its_serial(readable: int) -> None:
    forces_n = np.zeros((200, 2))
    forces_n[readable:, 1] = np.nan
    with pytest.raises(TareError, match=rf"T02 has {readable} .*--tare-s"):
        tare_of(loaded_frames(forces_n), (0.0, 1.0))


def test_twenty_readings_will_do() -> None:
    assert tare_of(loaded_frames(np.zeros((200, 2))), (0.0, 0.038)).frames == 20


@pytest.mark.parametrize("interval_s", [(0.0, 0.03), (5.0, 6.0), (-2.0, -1.0)])
def test_an_interval_with_too_few_frames_is_refused(interval_s: tuple[float, float]) -> None:
    with pytest.raises(TareError, match="at least 20"):
        tare_of(loaded_frames(np.zeros((200, 2))), interval_s)


@given(st.integers(0, 2**32 - 1), st.integers(1, 9))
def test_a_tare_does_not_depend_on_how_frames_lie_in_memory(seed: int, tiles: int) -> None:
    frames = loaded_frames(noise_counts(99, tiles, seed))
    other = replace(
        frames,
        **{
            name: np.asfortranarray(getattr(frames, name))
            for name in ("pressure_raw", "temperature_raw", "tile_flags")
        },
    )
    one, two = tare_of(frames, (0.0, 1.0)), tare_of(other, (0.0, 1.0))
    assert one.baseline_kpa.tobytes() == two.baseline_kpa.tobytes()
    assert one.noise_kpa.tobytes() == two.noise_kpa.tobytes()


# --- which interval -------------------------------------------------------------------------------


def lead(n: int, first: int) -> np.ndarray:
    """Frame status with the lead bit in the `first` frames, among others that do not matter."""
    return np.where(np.arange(n) < first, FrameFlag.LEAD, 0) | FrameFlag.SERVO_STALE


def test_the_lead_is_the_tare_if_no_interval_is_named() -> None:
    forces_n = np.full((300, 2), 20.0)
    forces_n[:120] = 5.0  # wherever the tile lies in the lead, that is its baseline
    forces_n[:120] += np.tile([[1.0], [-1.0]], (60, 1))
    tare = tare_of(loaded_frames(forces_n, frame_flags=lead(300, 120)))
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA + 5 * COUNT_KPA] * 2, abs=1e-12)
    assert (tare.source, tare.frames) == ("lead", 120)


def test_a_tile_that_hangs_for_half_of_the_interval_is_not_tared() -> None:
    forces_n = noise_counts(100, 2)
    forces_n[10:70, 1] = 2.0
    with pytest.raises(TareError, match=r"T02 gave 498 counts \d+ times in a row, of 100"):
        tare_of(loaded_frames(forces_n), (0.0, 0.199), noise_kpa=NOISE_KPA)
    forces_n[20:60:3, 1] = 1.0
    assert tare_of(loaded_frames(forces_n), (0.0, 0.199), noise_kpa=NOISE_KPA).frames == 100


@pytest.mark.parametrize("readings", [20, 120])
def test_a_tile_that_hangs_is_not_tared_by_itself(readings: int) -> None:
    # The same count again and again, in the lead: the part is stuck, and says nothing of a load.
    forces_n = noise_counts(300, 2)
    forces_n[:readings, 1] = 2.0
    forces_n[readings:120, 1] = np.nan
    frames = loaded_frames(forces_n, frame_flags=lead(300, 120))
    with pytest.raises(TareError, match=rf"T02 gave 498 counts {readings} times") as caught:
        tare_of(frames)
    assert "plug" in caught.value.remedy
    with pytest.raises(TareError, match="T02 gave 498 counts"):
        tare_of(frames, (0.0, 0.238), noise_kpa=NOISE_KPA)  # who names it cannot know better


def test_a_tile_without_noise_on_the_bench_may_stand_still_in_the_lead() -> None:
    frames = loaded_frames(np.zeros((120, 2)), frame_flags=lead(120, 120))
    assert tare_of(frames, noise_kpa=0.29 * COUNT_KPA).source == "lead"
    with pytest.raises(TareError, match="in a row"):
        tare_of(frames, calibration=make_paper_shape_preset())


def test_frames_marked_as_lead_later_on_are_none() -> None:
    # A lead is what a recording begins with. Two recordings that were joined have one in the
    # middle, and whoever looks at the first minute only must come to the same tare.
    forces_n = noise_counts(1000, 2)
    forces_n[300:500] += 30.0
    first, status = loaded_frames(forces_n), lead(1000, 200)
    again = np.where((np.arange(1000) >= 300) & (np.arange(1000) < 500), FrameFlag.LEAD, 0)
    tare = tare_of(replace(first, frame_flags=(status | again).astype(np.uint8)))
    assert (tare.source, tare.frames) == ("lead", 200)
    tare = tare_of(replace(first, frame_flags=again.astype(np.uint8)))
    assert (tare.source, tare.begin_s) == ("recognised", 0.0)


def test_a_named_interval_wins_over_the_lead() -> None:
    frames = loaded_frames(np.zeros((300, 2)), frame_flags=lead(300, 120))
    assert tare_of(frames, (0.3, 0.5)).source == "interval"


def test_without_either_the_first_unloaded_half_second_is_recognised() -> None:
    # 2 s on the ground, then 1.5 s in flight: the first window of flight begins at 2.0 s
    forces_n = noise_counts(1750, 2)
    forces_n[:1000] += 30.0
    frames = loaded_frames(forces_n)
    tare = tare_of(frames)
    assert tare.source == "recognised"
    assert (tare.begin_s, tare.end_s) == pytest.approx((2.0, 2.498))
    assert tare.frames == 250
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA] * 2, abs=3 * COUNT_KPA / 250**0.5)


@pytest.mark.parametrize("how", ["interval", "lead"])
def test_a_tile_that_seems_loaded_is_no_tare_even_if_somebody_says_so(how: str) -> None:
    # 3 kPa are 23.6 counts; far below the bench's baseline it may be, for a colder tile is
    def take(*counts: float) -> Tare:
        forces_n = np.tile(counts, (100, 1))
        forces_n += np.tile([[1.0], [-1.0]], (50, 1))
        frames = loaded_frames(forces_n, frame_flags=lead(100, 100))
        return tare_of(frames, (0.0, 0.1) if how == "interval" else None)

    assert take(23.0, -60.0).source == how
    with pytest.raises(
        TareError, match=r"T02 reads 103\.0[56] kPa .*100\.00 kPa unloaded.*--tare-s"
    ):
        take(0.0, 24.0)


def test_a_preset_does_not_know_what_an_unloaded_tile_reads() -> None:
    loaded = loaded_frames(np.full((100, 2), 60.0) + noise_counts(100, 2))
    assert tare_of(loaded, (0.0, 0.1), calibration=make_paper_shape_preset()).source == "interval"


def stretches(kinds: list[str]) -> np.ndarray:
    """Forces on two tiles, one second each, at 500 frames/s."""
    rng = np.random.default_rng(len(kinds))
    t_s = np.arange(500) / 500
    made = []
    for kind in kinds:
        forces_n = rng.normal(0.0, 0.9, (500, 2))
        if kind == "one tile loaded":
            forces_n[:, 1] += 15.0  # 1.9 kPa
        elif kind == "both loaded":
            forces_n += 100.0
        elif kind == "sucked at":
            forces_n -= 15.0
        elif kind == "moving":
            forces_n[:, 0] += 6.0 * np.sin(2 * np.pi * 3.0 * t_s)
        elif kind == "silent":
            forces_n[::50, 1] = np.nan
        made.append(forces_n)
    return np.concatenate(made)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.sampled_from(
            ["unloaded", "one tile loaded", "both loaded", "sucked at", "moving", "silent"]
        ),
        min_size=1,
        max_size=6,
    )
)
def test_no_loaded_moving_or_faulty_stretch_is_recognised_as_unloaded(kinds: list[str]) -> None:
    frames = loaded_frames(stretches(kinds))
    if "unloaded" not in kinds:
        with pytest.raises(TareError, match=r"no interval can be recognised.*--tare-s"):
            tare_of(frames)
        return
    tare = tare_of(frames)
    first, last = int(tare.begin_s), int(tare.end_s - 1e-9)
    assert {kinds[first], kinds[last]} == {"unloaded"}
    assert first == kinds.index("unloaded")


def test_a_leg_that_stands_still_is_not_in_flight() -> None:
    # The paper's leg weighs 8.92 N (0.909 kg): 2.23 N on each of four tiles, which by eq. 2 at the
    # assumed scale is 1.41 kPa, 11 counts. It stands for two seconds, then is lifted for two.
    paper = make_paper_shape_preset().tiles[0]
    slope_n_per_kpa = paper.f_scale_n * 0.5702 / 15.0
    counts = 8.92 / 4 / slope_n_per_kpa / COUNT_KPA
    forces_n = noise_counts(2000, 4)
    forces_n[:1000] += counts
    tare = tare_of(loaded_frames(forces_n))
    assert tare.baseline_kpa == pytest.approx([UNLOADED_KPA] * 4, abs=0.05)


def test_a_foot_that_is_slowly_let_down_is_not_unloaded() -> None:
    # From the first frame on, a newton a second on each tile, 0.63 kPa/s; flight only at the end.
    forces_n = noise_counts(1500, 2)
    forces_n[:1000] += np.linspace(0.0, 2.0 * 0.63 / COUNT_KPA, 1000)[:, None]
    tare = tare_of(loaded_frames(forces_n))
    off_kpa = np.abs(tare.baseline_kpa - UNLOADED_KPA)
    assert (off_kpa < 6 * tare.baseline_sigma_kpa).all()


@pytest.mark.parametrize("newtons_per_second", [1.0, -1.0])
def test_a_load_that_moves_slowly_all_the_time_is_refused(newtons_per_second: float) -> None:
    # No window is unloaded, and half a newton in one hides in the noise of single readings.
    forces_n = noise_counts(1000, 2)
    forces_n += np.linspace(0.0, newtons_per_second * 2.0 * 0.63 / COUNT_KPA, 1000)[:, None]
    with pytest.raises(TareError, match="no interval can be recognised"):
        tare_of(loaded_frames(forces_n))


def test_an_interval_of_half_a_second_is_found_at_every_quarter_of_a_second() -> None:
    forces_n = noise_counts(750, 2) + 30.0
    forces_n[125:376] -= 30.0  # 0.25 to 0.75 s
    assert tare_of(loaded_frames(forces_n)).begin_s == pytest.approx(0.25)


def test_a_tile_that_is_noisier_than_on_the_bench_is_not_quiet() -> None:
    # one count on the bench; up to one and a half is let pass
    noise = np.random.default_rng(8).normal(0.0, 1.0, (500, 2))
    assert tare_of(loaded_frames(1.3 * noise)).source == "recognised"
    with pytest.raises(TareError):
        tare_of(loaded_frames(noise * [1.0, 1.75]))


def test_one_tile_without_a_bench_baseline_is_enough_to_recognise_nothing() -> None:
    for missing in ("baseline_kpa", "noise_kpa"):
        mixed = make_calibration(newton_tile("T01"), newton_tile("T02", **{missing: None}))
        with pytest.raises(TareError, match="does not say where an unloaded tile lies"):
            tare_of(loaded_frames(noise_counts(500, 2)), calibration=mixed)


def test_a_calibration_without_bench_baselines_cannot_recognise_anything() -> None:
    with pytest.raises(TareError, match=r"paper-eq2-shape .*--tare-s"):
        tare_of(loaded_frames(np.zeros((500, 2))), calibration=make_paper_shape_preset())


def test_a_baseline_may_have_drifted_by_some_kelvin_since_the_bench() -> None:
    frames = loaded_frames(noise_counts(500, 2))
    assert tare_of(frames, baseline_kpa=UNLOADED_KPA + 1.4).source == "recognised"
    with pytest.raises(TareError):
        tare_of(frames, baseline_kpa=UNLOADED_KPA + 1.6)


def test_a_recording_of_too_few_frames_for_a_window_is_refused() -> None:
    with pytest.raises(TareError, match="no interval can be recognised"):
        tare_of(loaded_frames(noise_counts(19, 2)))
    assert tare_of(loaded_frames(noise_counts(20, 2))).frames == 20


@pytest.mark.parametrize("n", [1, 2])
def test_of_a_frame_or_two_there_is_no_tare_and_nothing_else_to_complain_of(n: int) -> None:
    with pytest.raises(TareError):
        tare_of(loaded_frames(np.zeros((n, 2))))


def test_a_tile_that_never_answers_is_no_tare_and_nothing_else_to_complain_of() -> None:
    status = np.zeros((60, 2))
    status[:, 1] = TileFlag.NO_ANSWER
    with pytest.raises(TareError):
        tare_of(loaded_frames(noise_counts(60, 2), tile_flags=status))


# --- windows --------------------------------------------------------------------------------------


@given(
    steps_ns=st.lists(st.integers(1, 400), min_size=1, max_size=30),
    begin_ns=st.integers(-500, 3000),
    step_ns=st.integers(1, 100),
    length_ns=st.integers(1, 400),
)
def test_windows_are_those_of_the_lattice_that_hold_a_frame(
    steps_ns: list[int], begin_ns: int, step_ns: int, length_ns: int
) -> None:
    since_ns = np.cumsum([0, *steps_ns])
    lattice = np.arange(begin_ns % step_ns, since_ns[-1] + 1, step_ns)
    held = [at for at in lattice.tolist() if ((since_ns >= at) & (since_ns < at + length_ns)).any()]
    found = compute_nonempty_window_starts(since_ns, begin_ns, step_ns, length_ns).tolist()
    assert set(held) <= set(found) <= set(lattice.tolist())


@pytest.mark.parametrize("gap_ns", [10**12, 10**18])
def test_a_clock_that_was_set_makes_no_windows(gap_ns: int) -> None:
    since_ns = np.array([0, 10, 20, gap_ns, gap_ns + 10])
    assert len(compute_nonempty_window_starts(since_ns, 0, 5, 10)) < 20
